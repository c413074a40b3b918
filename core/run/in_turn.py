"""Executes all scans of a run, each with all bands of the camera; what these share of a scan is released after the last."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ..data import Data
from ..hooks import manager
from ..machine import available_memory
from ..output import Progress
from .ahead import Ahead
from .budget import check_kept_memory, divided, longest_of, products_of, with_scan_ahead
from .execution import Execution
from .schedule import Chain
from .settings import Settings, Timer


@dataclass(frozen=True)
class Band:
    """What observes with one band, or with a camera that has one: the steps, the data, and who is told when a scan is done."""

    chain: Chain
    data: Data
    watch: Callable[[Data, Progress], None]

    @property
    def products(self) -> int:
        """Bytes of what is added up over all scans."""
        return products_of(self.chain, longest_of(self.data.observations))


@dataclass(frozen=True)
class Budget:
    """The memory that a run was given, to be divided.

    Attributes
    ----------
    memory
        Bytes for streams and blocks that were asked for; None: what the ceiling leaves.
    fresh
        False in a worker (`budget.divided`).
    place
        The pipeline's name, for errors.
    """

    memory: int | None
    fresh: bool
    place: str


def execute(bands: Sequence[Band], settings: Settings, timer: Timer, budget: Budget) -> None:
    """Run all observations in order, each with all bands; the next one is prepared while one is executed."""
    hooks = manager().hook.zonda_before_operator, manager().hook.zonda_after_operator
    # who listens hears of one observation after the other
    several = sum(len(band.data.observations) for band in bands) > 1
    ahead = Ahead(settings.threads > 1 and several and not any(hook.get_hookimpls() for hook in hooks))
    every = [o for band in bands for o in band.data.observations]
    settings = replace(settings, kept=8 * len(bands[0].chain.keep) * sum(o.n_detectors * o.n_samples for o in every))
    products = [band.products for band in bands]
    executions = []
    for band, mine in zip(bands, products, strict=True):
        own = _divided(band, replace(settings, others=sum(products) - mine), ahead, budget)
        executions.append([Execution(band.chain, o, own, timer, *hooks) for o in band.data.observations])
    turns = [turn for scan in zip(*executions, strict=True) for turn in zip(scan, bands, strict=True)]
    try:
        for (execution, band), (following, _) in zip(turns, [*turns[1:], (None, None)], strict=True):
            execution.run(band.data, ahead, following)
            observation = execution.observation
            band.data.tally.update(observation.tally)
            if observation.shared is not None and band is bands[-1]:
                observation.shared.forget()
            band.watch(band.data, "scan")
    finally:
        ahead.close()


def _divided(band: Band, settings: Settings, ahead: Ahead, budget: Budget) -> Settings:
    """The settings with the memory that is left for streams and blocks."""
    chain, data = band.chain, band.data
    if budget.memory is not None and settings.asked is None:
        check_kept_memory(settings.kept, available_memory(), budget.place)
        return settings
    longest, most = longest_of(data.observations), settings.memory
    settings = divided(chain, longest, settings, budget.place, budget.fresh)
    if budget.memory is not None:
        settings = replace(settings, memory=min(settings.memory, most))
    if ahead.on:
        less = with_scan_ahead(chain, longest, settings)
        ahead.on, settings = less is not None, less or settings
    if settings.threads < data.threads and budget.fresh:
        text = f"{settings.threads} of {data.threads} threads work: more do not fit in the memory budget"
        warnings.warn(f"{budget.place}: {text}", stacklevel=4)
    data.threads = settings.threads
    return settings
