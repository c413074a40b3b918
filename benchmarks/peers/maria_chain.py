"""maria's whole MUSTANG-2 chain for one case, sky to map: python maria_chain.py CASE.npz

A map, layers, white and 1/f noise; then the filter at 0.08 Hz, the first mode removed, and the
binned map, as in maria's tests.
"""

from __future__ import annotations

from typing import Any

import maria
import numpy as np
from common import case, cpu, peak, report
from maria.map import ProjectionMap
from maria.mappers import BinMapper
from maria.plan import Plan
from maria.sim import Simulation
from maria_observation import atmosphere_options, instrument, quiet, site

CENTRE = 260.0, -23.0
"""Degrees: high above Chajnantor at the time of the cases."""


def run(c: dict[str, Any]) -> dict[str, float]:
    x = np.linspace(-5, 5, 600)
    sky = 1e-3 * np.exp(-(x[:, None] ** 2 + x**2) / 2)
    start = cpu()
    where = site(c)
    path = Plan.generate(
        start_time=c["start"],
        duration=c["duration"],
        sample_rate=c["rate"],
        site=where,
        scan_center=CENTRE,
        frame="ra/dec",
        scan_pattern="daisy",
        scan_options={"radius": 4 / 60, "speed": 50 / 3600},
    )
    simulation = Simulation(
        instrument=instrument(c),
        plans=[path],
        site=where,
        atmosphere="2d",
        progress_bars=False,
        map=ProjectionMap(
            data=sky,
            nu=[c["band_centre"]],
            units="K_RJ",
            width=10 / 60,
            center=CENTRE,
            frame="ra/dec",
        ),
        atmosphere_kwargs=atmosphere_options(c),
    )
    tods = simulation.run()
    simulated = cpu()
    filters = {"filter": {"f_lower": 0.08}, "remove_modes": {"modes_to_remove": 1}}
    size = {
        "center": CENTRE,
        "frame": "ra/dec",
        "width": 15 / 60,
        "height": 15 / 60,
        "resolution": 2 / 3600,
    }
    BinMapper(tods=tods, units="K_RJ", progress_bars=False, tod_preprocessing=filters, **size).run()
    return {"simulation": simulated - start, "mapping": cpu() - simulated}


if __name__ == "__main__":
    quiet()
    report(before=peak(), **run(case()), peak=peak(), version=maria.__version__)
