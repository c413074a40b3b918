"""Make `operators/atmosphere/data/spline_error.npz`: equation (2) of `zonda.operators.atmosphere.turbulence.nodes` on its grid.

python benchmarks/atmosphere_data/tabulate_spline_error.py operators/atmosphere/data/spline_error.npz
"""

from __future__ import annotations

import sys

import numpy as np

from zonda.operators.atmosphere.turbulence.nodes import spline_table

if __name__ == "__main__":
    log_q, log_g = spline_table()
    np.savez(sys.argv[1], log_q=log_q, log_g=log_g)
