"""Realizations of maria's water for a stare, and what its layers should give: python
maria_statistics.py CASE.npz OUT.npz N

y: (realizations, detectors, times), fluctuation of the water, relative to its mean. Per layer:
amplitude (rms of y before the beam), sigma of the beam [m], outer scale r0 of the von Karman
covariance [m], positions (detectors, 2) and speed, in the plane in which maria measures distances
(horizontal, at the layer's height).
"""

from __future__ import annotations

import sys

import maria
import numpy as np
from common import case
from maria.sim import Simulation
from maria_observation import atmosphere_options, instrument, plan, quiet, site

NU = 5 / 6


def main() -> None:
    quiet()
    c = case()
    where = site(c)
    simulation = Simulation(
        instrument=instrument(c),
        plans=[plan(c, where)],
        site=where,
        atmosphere="2d",
        noise=False,
        progress_bars=False,
        atmosphere_kwargs=atmosphere_options(c),
    )
    (o,) = simulation.obs_list
    air = o.atmosphere
    air.initialize(o)
    np.random.seed(1)  # noqa: NPY002, the stream that maria draws from
    y = []
    for _ in range(int(sys.argv[3])):
        air.simulate_pwv(instrument=o.instrument)
        y.append(np.asarray(air.zenith_scaled_pwv) / air.weather.pwv - 1)
    unit_height = np.asarray(air.coords.project(z=1))[:, 0, :2]
    layers = [(p, layer) for p in air.processes.values() for _, layer in p.layers.iterrows()]
    np.savez(
        sys.argv[2],
        version=maria.__version__,
        y=np.array(y, np.float32),
        step=air.timestep,
        amplitude=[layer.pwv_rms / air.weather.pwv for _, layer in layers],
        sigma=[
            o.instrument.dets.physical_fwhm(layer.z).mean().meters / 2.355 for _, layer in layers
        ],
        outer_scale=[p.callback_kwargs["r0"] / np.sqrt(2 * NU) for p, _ in layers],
        positions=[layer.h * unit_height for _, layer in layers],
        speed=[float(np.hypot(p.vx, p.vy).mean()) for p, _ in layers],
    )


if __name__ == "__main__":
    main()
