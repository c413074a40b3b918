"""Kernels to compile ahead (`core.compilation.compile_ahead`); `python benchmarks/startup.py --kernels` writes this file."""

KERNELS = (
    "21 0.7 zonda.operators.filters.brick_wall _spread f4:2C i8:1C f4:3C f8:2C",
    "22 0.6 zonda.operators.filters.brick_wall _subtract f4:2C i8:1C f4:3C f4:2C",
    "23 3.9 zonda.operators.filters.gram _products f4:2C i8 i8 f8:1C i8:1C f8:1C b1 f8:3C",
    "24 0.2 zonda.operators.filters.common_mode _remove f4:2C f8:1C f8:1C",
)
