"""zonda's water for a stare, as `maria_statistics.py`: python zonda_statistics.py CASE.npz OUT.npz
N

Distances are those across the line of sight.
"""

from __future__ import annotations

import math
import sys

import numpy as np
from common import case
from zonda_atmosphere import observation

import zonda
from zonda.core.data import Block
from zonda.core.instrument import SPEED_OF_LIGHT
from zonda.core.numerics.sphere import FWHM_PER_SIGMA
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.atmosphere.turbulence.beams import widened

OUTER_SCALE = 1000 / math.sqrt(5 / 3)
"""m: maria's layers have r0 = 1000 m in its definition, sqrt(2 nu) times ours."""


def main() -> None:
    c = case()
    rms = c["pwv_rms"]
    operator = AtmosphereLayers(
        pwv=f"{c['pwv']} m",
        pwv_rms=f"{100 * rms} %",
        outer_scale=f"{OUTER_SCALE} m",
        outputs=["pwv"],
        tolerance="0.1 %",
    )
    y = []
    for seed in range(int(sys.argv[3])):
        o = observation(c)
        o.seed = seed
        state = operator.prepare(o)
        block = Block(o, slice(0, o.n_detectors), slice(0, o.n_samples))
        operator.exec(block, state)
        y.append(block.detdata["pwv"] * math.sin(c["elevation"][0]) / c["pwv"])
    layers = operator.model(o).layers
    sin, azimuth = math.sin(c["elevation"][0]), c["azimuth"][0]
    along = np.array([layer.wind @ [np.sin(azimuth), np.cos(azimuth)] for layer in layers])
    across = np.array([layer.wind @ [np.cos(azimuth), -np.sin(azimuth)] for layer in layers])
    offsets = np.stack([c["xi"], c["eta"]], axis=-1)
    np.savez(
        sys.argv[2],
        version=zonda.__version__,
        y=np.array(y, np.float32),
        step=1 / c["rate"],
        amplitude=[rms * layer.amplitude for layer in layers],
        sigma=[
            widened(c["diameter"], SPEED_OF_LIGHT / c["band_centre"], layer.height / sin)
            / FWHM_PER_SIGMA
            for layer in layers
        ],
        outer_scale=[OUTER_SCALE] * len(layers),
        positions=[layer.height / sin * offsets for layer in layers],
        speed=np.hypot(across, along * sin),
    )


if __name__ == "__main__":
    main()
