"""What a process may hold, divided among operators, streams and blocks, scans prepared ahead, and what runs are derived from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..data import Observation
from ..machine import available_memory, resident_memory
from ..operator import Operator
from ..plan.planning import planning_of
from . import ahead as preparation
from .ahead import Ahead
from .derived import parts_of
from .forecast import need, room
from .settings import Settings

if TYPE_CHECKING:
    from ..pipeline import Pipeline


def divide(
    operators: Sequence[Operator],
    observations: Sequence[Observation],
    settings: Settings,
    ahead: Ahead,
    ceiling: int | None,
    memory: int | None,
    parts: int,
    place: str,
    fresh: bool = True,
) -> None:
    """Set ``settings.memory``, ``ceiling`` and, where all of them do not fit, ``threads``; turn ``ahead`` off where there is no
    room for it.

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
    fresh
        False in a worker, which still holds what tasks before this one have left: that is no part of the forecast.

    Raises
    ------
    PipelineError
        Where the run does not fit.
    """
    budget = ceiling or resident_memory() + available_memory() // 2
    longest = max(observations, key=lambda o: o.n_detectors * o.n_samples)
    kept = parts * _summed(operators, longest)
    left, products = room(operators, observations, settings, budget, place, kept, fresh)
    settings.memory = min(left, memory or left)
    if ahead.on and len(observations) > 1:
        size = preparation.affordable(operators, observations, settings)
        ahead.on = size is not None
        settings.memory, products = settings.memory - (size or 0), products + (size or 0)
    settings.ceiling, settings.asked = budget - products, budget


def least(pipeline: Pipeline, observations: Sequence[Observation]) -> int:
    """Bytes with which a process runs a pipeline over these observations on one thread, libraries included."""
    steps, longest = pipeline.selection.steps(""), max(observations, key=lambda o: o.n_detectors * o.n_samples)
    kept = len(parts_of(pipeline.derived)) * _summed(steps, longest)
    return need(steps, observations, Settings(dtype=np.float64 if pipeline.precision == "float64" else np.float32), kept)


def _summed(operators: Sequence[Operator], observation: Observation) -> int:
    """Bytes of what one run keeps, to derive others from."""
    return sum(planning_of(o).memory(observation) for o in operators if type(o).subtract is not Operator.subtract)
