"""Kernels to compile ahead (`core.compilation.compile_ahead`); `python benchmarks/startup.py
--kernels` writes this file.
"""

KERNELS = (
    (
        "27 3.0 zonda.operators.maps.sums add_image f4:2C*2 f8:2C i8 f8:1C f8:1C i8 i8 b1:1C u1:1C"
        " f8:1C f8:1C f8:1C b1 f8 i8:2C i8:1C f8:1C"
    ),
    "28 0.3 zonda.operators.maps.sums _fold i8:2C i8 i8 i8 i8 i8:2C i8:2C",
)
