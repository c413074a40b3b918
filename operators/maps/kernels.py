"""Kernels to compile ahead (`core.compilation.compile_ahead`); `python benchmarks/startup.py --kernels` writes this file."""

KERNELS = (
    "25 4.4 zonda.operators.maps.sums add_image f4:2C f8:2C i8 f8:1C f8:1C i8 i8 b1:1C u1:1C f8:1C f8:1C b1 f8 i8:2C i8:1C f8:1C",
    "26 0.7 zonda.operators.maps.sums _fold i8:2C i8 i8 i8 i8 i8:2C",
)
