"""Kernels to compile ahead (`core.compilation.compile_ahead`); `python benchmarks/startup.py
--kernels` writes this file.
"""

KERNELS = (
    (
        "20 1.1 zonda.operators.optics.efficiency _calibrate f4:2C f4:2C f4:2C f4:2C f4:2C i8:1C"
        " f4:2C f4:1C f4:2C f4:1C f4:2C b1 f4:2C"
    ),
    "21 0.2 zonda.operators.optics.efficiency _calibrate_sky f4:2C f4:2C f4:1C f4:2C",
)
