"""What a process may hold, divided among operators, streams and blocks, scans prepared ahead, and what runs are derived from."""

from __future__ import annotations

from collections.abc import Sequence

from ..data import Observation
from ..machine import available_memory, resident_memory
from ..operator import Operator
from . import ahead as preparation
from .ahead import Ahead
from .forecast import room
from .settings import Settings


def divide(
    operators: Sequence[Operator],
    observations: Sequence[Observation],
    settings: Settings,
    ahead: Ahead,
    ceiling: int | None,
    memory: int | None,
    parts: int,
    place: str,
) -> None:
    """Set ``settings.memory`` and ``ceiling``; turn ``ahead`` off where there is no room for it.

    Parameters
    ----------
    operators
        Of the main run.
    ceiling, memory
        As `Pipeline.run` is given them.
    parts
        Number of runs whose partial products are kept, to derive others from.
    place
        The pipeline's name, for errors.

    Raises
    ------
    PipelineError
        Where the run does not fit.
    """
    budget = ceiling or resident_memory() + available_memory() // 2
    left, products = room(operators, observations, settings, budget, place)
    settings.memory = min(left, memory or left)
    longest = max(observations, key=lambda o: o.n_detectors * o.n_samples)
    summed = [o for o in operators if type(o).subtract is not Operator.subtract] if parts else []
    kept = min(parts * sum(o.memory(longest) for o in summed), left // 2)
    settings.memory, products = settings.memory - kept, products + kept
    if ahead.on and len(observations) > 1:
        size = preparation.affordable(operators, observations, settings)
        ahead.on = size is not None
        settings.memory, products = settings.memory - (size or 0), products + (size or 0)
    settings.ceiling = budget - products
