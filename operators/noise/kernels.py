"""Kernels to compile ahead (`core.compilation.compile_ahead`); `python benchmarks/startup.py
--kernels` writes this file.
"""

KERNELS = (
    (
        "15 1.9 zonda.operators.noise.streams _filter u4:1C i8 i8 i8 f4:2C f4:1C f4:1C f4:2C i8"
        " f4:2C i8 f4:1C f4:1C f4:1C b1 f4:2C"
    ),
    "19 0.7 zonda.operators.noise.white _add_normals u4:1C i8 i8 f4:2C i8 f4:1C b1 f4:2C",
)
