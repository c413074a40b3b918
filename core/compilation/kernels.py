"""Kernels that the shipped pipelines use, in the order of their first use: seconds [s] that each takes to compile, with what it
calls, module, name, types (`compile_ahead.text_of`).

`python benchmarks/startup.py --kernels` writes this file.
"""

KERNELS = (
    "0.8 zonda.core.numerics.smooth _prefilter f8:2C f8:1C f8:2C",
    "0.4 zonda.core.numerics.smooth _lines f8:2C f8:2C i8 f8:2C",
    "0.5 zonda.core.numerics.smooth _evaluate f8:2C i8 f8:1C i8 f8:2C",
    "3.0 zonda.core.numerics.random fill_normals u4:1C i8 i8 f4:1C",
    "0.5 zonda.operators.atmosphere.turbulence.lines_of_sight _on_plane f8:2C i8 f8:1C f8:1C f8:1C f8:2C f8:2C f8:2C",
    "0.4 zonda.operators.atmosphere.turbulence.sampling _boxes f8:2C f8:2C",
    "0.4 zonda.operators.atmosphere.turbulence.sampling _extent f8:1C f8:3C f8:1C f8:1C",
    "0.8 zonda.core.numerics.random fill_lattice_normals u4:1C i8 i8 f4:2C",
    "1.8 zonda.operators.atmosphere.turbulence.lattice _convolve f4:2C f4:2C f4:2C",
    "0.7 zonda.operators.atmosphere.turbulence.lattice _upsample f4:2C i8 i8 f4:1C f4:2C i8 i8",
    "0.7 zonda.operators.atmosphere.turbulence.lattice _prefilter f4:2C f4:1C f4:2C",
    "1.7 zonda.operators.atmosphere.turbulence.sampling _interpolate "
    "f8:1C f8:2C f8:2C f8:1C f8:1C i8 i8 i8 i8 i8 u8:2C f8:1C f8:2C",
    "0.7 zonda.operators.atmosphere.response _polynomials f8:2C f8:2C f8:2C f8 f8 f8 f8 f8 f8 f8:2C",
    "0.5 zonda.core.numerics.smooth _lines f8:2C f8:2C i8 f4:2C",
    "2.7 zonda.operators.noise.streams _filter u4:1C i8 i8 i8 f4:2C f4:1C f4:1C i8 f4:2C i8 f4:1C f4:1C f4:1C b1 f4:2C",
    "1.7 zonda.operators.sky.sampling _point f8:2C f8:2C i8 i8 f8:1C f4:3C f8:3C f4:2C i4:2C",
    "3.3 zonda.operators.sky.sampling add_splines f4:3C f8:3C f4:2C i4:2C f4:1C f4:1C i8:1C f4:1C i8 u1:2C f4:1C b1 f4:2C",
    "0.2 zonda.core.numerics.smooth _evaluate f4:2C i8 f4:1C i8 f4:2C",
    "0.8 zonda.operators.noise.white _add_normals u4:1C i8 i8 f4:2C i8 f4:1C b1 f4:2C",
    "1.4 zonda.operators.optics.efficiency _calibrate f4:2C f4:2C f4:2C f4:2C f4:2C i8:1C f4:2C f4:1C f4:2C f4:1C f4:2C b1 f4:2C",
    "0.7 zonda.operators.filters.brick_wall _spread f4:2C i8:1C f4:3C f8:2C",
    "0.6 zonda.operators.filters.brick_wall _subtract f4:2C i8:1C f4:3C f4:2C",
    "3.9 zonda.operators.filters.gram _products f4:2C i8 i8 f8:1C i8:1C f8:1C b1 f8:3C",
    "0.2 zonda.operators.filters.common_mode _remove f4:2C f8:1C f8:1C",
    "4.4 zonda.operators.maps.sums add_image f4:2C f8:2C i8 f8:1C f8:1C i8 i8 b1:1C u1:1C f8:1C f8:1C b1 f8 i8:2C i8:1C f8:1C",
    "0.7 zonda.operators.maps.sums _fold i8:2C i8 i8 i8 i8 i8:2C",
)
