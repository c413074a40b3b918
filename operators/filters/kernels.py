"""Kernels to compile ahead (`core.compilation.compile_ahead`); `python benchmarks/startup.py
--kernels` writes this file.
"""

KERNELS = (
    "23 0.5 zonda.operators.filters.brick_wall _spread f4:2C i8:1C f4:3C f8:2C",
    "24 0.3 zonda.operators.filters.brick_wall _subtract f4:2C i8:1C f4:3C f4:2C",
    "25 2.1 zonda.operators.filters.gram _products f4:2C i8 i8 f8:1C i8:1C f8:1C b1 f8:3C",
    "26 0.1 zonda.operators.filters.common_mode _remove f4:2C f8:1C f8:1C",
)
