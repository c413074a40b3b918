"""Executes all scans of a run, each with all bands of the camera; what these share of a scan is released after the last.

Bands follow each other, or are in step where a filter measures all of them together (`in_step`).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ..data import Data
from ..hooks import manager
from ..machine import available_memory
from ..output import Progress
from .ahead import Ahead
from .budget import check_kept_memory, divided, held_of, longest_of, with_scan_ahead
from .execution import Execution
from .in_step import joins, run_in_step
from .schedule import Chain
from .settings import Settings, Timer


@dataclass(frozen=True)
class Band:
    """What observes with one band, or with a camera that has one: the steps, the data, and who is told when a scan is done."""

    chain: Chain
    data: Data
    watch: Callable[[Data, Progress], None]

    def held(self, in_step: bool) -> int:
        """Bytes that it holds while another band acts: what is added up over all scans; ``in_step``: all that its steps hold."""
        return held_of(self.chain, longest_of(self.data.observations), in_step)


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
    in_step = len(bands) > 1 and any(map(joins, bands[0].chain.steps))
    ahead = Ahead(settings.threads > 1 and several and not in_step and not any(hook.get_hookimpls() for hook in hooks))
    every = [o for band in bands for o in band.data.observations]
    settings = replace(settings, kept=8 * len(bands[0].chain.keep) * sum(o.n_detectors * o.n_samples for o in every))
    held = [band.held(in_step) for band in bands]
    executions = []
    for band, mine in zip(bands, held, strict=True):
        own = _divided(band, replace(settings, others=sum(held) - mine), ahead, budget)
        if in_step:  # their streams are held side by side, and once more together
            own = replace(own, memory=max(own.memory // (2 * len(bands)), min(own.least, own.memory)))
        executions.append([Execution(band.chain, o, own, timer, *hooks) for o in band.data.observations])
    turns = [turn for scan in zip(*executions, strict=True) for turn in zip(scan, bands, strict=True)]
    try:
        if in_step:
            _run_in_step(executions, bands, timer)
            return
        for (execution, band), (following, _) in zip(turns, [*turns[1:], (None, None)], strict=True):
            execution.run(band.data, ahead, following)
            _done(execution, band, band is bands[-1])
    finally:
        ahead.close()


def _run_in_step(executions: Sequence[Sequence[Execution]], bands: Sequence[Band], timer: Timer) -> None:
    """Run all observations in order, each with all bands in step (`core.run.in_step`)."""
    for scan in zip(*executions, strict=True):
        run_in_step([one.turns(band.data, in_step=True) for one, band in zip(scan, bands, strict=True)], timer)
        for execution, band in zip(scan, bands, strict=True):
            _done(execution, band, band is bands[-1])


def _done(execution: Execution, band: Band, last: bool) -> None:
    """Tell that a band has observed a scan; release what bands share of it after the last."""
    observation = execution.observation
    band.data.tally.update(observation.tally)
    if observation.shared is not None and last:
        observation.shared.forget()
    band.watch(band.data, "scan")


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
