"""Kernels to compile ahead (`core.compilation.compile_ahead`); `python benchmarks/startup.py
--kernels` writes this file.
"""

KERNELS = (
    "1 1.0 zonda.core.numerics.smooth _prefilter f8:2C f8:1C f8:2C",
    "2 0.2 zonda.core.numerics.smooth _lines f8:2C f8:2C i8 f8:2C",
    "3 0.4 zonda.core.numerics.smooth _evaluate f8:2C i8 f8:1C i8 f8:2C",
    "4 2.2 zonda.core.numerics.random fill_normals u4:1C i8 i8 f4:1C",
    "8 0.5 zonda.core.numerics.random fill_lattice_normals u4:1C i8 i8 f4:2C",
    "14 0.3 zonda.core.numerics.smooth _lines f8:2C f8:2C i8 f4:2C",
    "18 0.1 zonda.core.numerics.smooth _evaluate f4:2C i8 f4:1C i8 f4:2C",
    "22 0.1 zonda.core.run.block_maker _finite f4:1C",
)
