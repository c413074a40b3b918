"""Kernels to compile ahead (`core.compilation.compile_ahead`); `python benchmarks/startup.py
--kernels` writes this file.
"""

KERNELS = (
    "16 0.8 zonda.operators.sky.sampling _point f8:2C f8:2C i8 i8 f8:1C f4:3C f8:3C f4:2C i4:2C",
    (
        "17 1.7 zonda.operators.sky.sampling add_splines f4:3C f8:3C f4:2C i4:2C f4:1C f4:1C i8:1C"
        " f4:1C i8 u1:2C f4:1C b1 f4:2C"
    ),
)
