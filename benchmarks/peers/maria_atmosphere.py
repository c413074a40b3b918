"""maria's layers (`atmosphere="2d"`) for one case: python maria_atmosphere.py CASE.npz"""

from __future__ import annotations

from typing import Any

import maria
import numpy as np
from common import Stopwatch, case, cpu, twice
from maria.atmosphere.process import AutoregressiveProcess
from maria.sim import Simulation
from maria_observation import atmosphere_options, instrument, plan, quiet, site

GENERATION = Stopwatch()


def run(c: dict[str, Any]) -> dict[str, Any]:
    """Set-up: planes and their turbulence. Evaluation: water, emission, and both at the rate of the
    detectors.
    """
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
    generated = GENERATION.total
    start = cpu()
    o.atmosphere.initialize(o)
    setup = cpu() - start
    start = cpu()
    simulation._simulate_atmosphere(o)
    loading = np.asarray(simulation._compute_atmospheric_loading(o))
    evaluation = cpu() - start
    generated = GENERATION.total - generated
    return {
        "setup": setup + generated,
        "evaluation": evaluation - generated,
        "step": float(o.atmosphere.timestep),
        "layers": len(o.atmosphere.layers),
        "finite": bool(np.isfinite(loading).all()),
    }


if __name__ == "__main__":
    quiet()
    given = case()
    with GENERATION.of(AutoregressiveProcess, "run"):
        twice(lambda: run(given), version=maria.__version__)
