"""Kernels to compile ahead (`core.compilation.compile_ahead`); `python benchmarks/startup.py
--kernels` writes this file.
"""

KERNELS = (
    (
        "5 0.3 zonda.operators.atmosphere.turbulence.lines_of_sight _on_plane f8:2C i8 f8:1C f8:1C"
        " f8:1C f8:2C f8:2C f8:2C"
    ),
    "6 0.2 zonda.operators.atmosphere.turbulence.interpolation boxes_of f8:2C f8:2C",
    "7 0.2 zonda.operators.atmosphere.turbulence.interpolation extent f8:1C f8:3C f8:1C f8:1C",
    "9 1.0 zonda.operators.atmosphere.turbulence.lattice _convolve f4:2C f4:3C f4:3C",
    "10 0.4 zonda.operators.atmosphere.turbulence.lattice _upsample f4:2C i8 i8 f4:1C f4:2C i8 i8",
    "11 0.4 zonda.operators.atmosphere.turbulence.lattice _prefilter f4:2C f4:1C f4:2C",
    (
        "12 0.7 zonda.operators.atmosphere.turbulence.interpolation interpolate f8:1C f8:2C f8:2C"
        " f8:1C f8:1C i8 i8 i8 i8 i8 u8:2C f8:1C i8*1 f8:3C"
    ),
    (
        "13 0.4 zonda.operators.atmosphere.response _polynomials f8:2C f8:2C f8:2C f8 f8 f8 f8 f8"
        " f8 f8:2C"
    ),
)
