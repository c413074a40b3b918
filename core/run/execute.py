"""Executes all scans of a run, each with all bands of the camera.

Bands that share pixels, or that a filter measures together, are executed together (`scan`), if
their streams fit in memory side by side; others follow each other, scan by scan.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ..data import Data
from ..hooks import manager
from ..machine import available_memory
from ..mapmaker import joins
from ..output import Progress
from .ahead import Ahead
from .budget import check_kept_memory, divided, held_of, longest_of, share_in_step, with_scan_ahead
from .execution import Execution
from .scan import run
from .schedule import Chain
from .settings import Settings, Timer


@dataclass(frozen=True)
class Band:
    """What observes with one band, or with a camera that has one: the steps, the data, and who is
    told when a scan is done.
    """

    chain: Chain
    data: Data
    watch: Callable[[Data, Progress], None]

    def held(self, in_step: bool) -> int:
        """Bytes that it holds while another band acts: what is added up over all scans;
        ``in_step``: all that its steps hold.
        """
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
    """Run all observations in order, each with all bands; the next one is prepared while one is
    executed.
    """
    hooks = manager().hook.zonda_before_operator, manager().hook.zonda_after_operator
    heard = any(
        hook.get_hookimpls() for hook in hooks
    )  # who listens hears of one observation after the other
    several = sum(len(band.data.observations) for band in bands) > 1
    joined = len(bands) > 1 and any(map(joins, bands[0].chain.steps))
    ahead = Ahead(settings.threads > 1 and several and not joined and not heard)
    every = [o for band in bands for o in band.data.observations]
    settings = replace(
        settings,
        kept=8 * len(bands[0].chain.keep) * sum(o.n_detectors * o.n_samples for o in every),
    )
    held = [band.held(joined) for band in bands]
    alone = [
        _divided(band, replace(settings, others=sum(held) - mine), ahead, budget)
        for band, mine in zip(bands, held, strict=True)
    ]
    shares = _joined_shares(alone) if joined else None if heard else _shares(bands, alone, ahead.on)
    executions = [
        [Execution(band.chain, o, own, timer, *hooks) for o in band.data.observations]
        for band, own in zip(bands, shares or alone, strict=True)
    ]
    numbers = list(range(len(bands)))
    groups = [[k] for k in numbers] if shares is None else [numbers]
    blockwise = sum(own.memory for own in shares or ()) <= alone[0].memory
    scans = list(zip(*executions, strict=True))
    turns = [(scan, group) for scan in scans for group in groups]
    together = [[scan[k] for k in group] for scan, group in turns]
    try:
        for (scan, group), these, then in zip(turns, together, [*together[1:], []], strict=True):
            run(these, [bands[k].data for k in group], ahead, then, blockwise)
            for k in group:
                _done(scan[k], bands[k], k == numbers[-1])
    finally:
        ahead.close()


def _joined_shares(alone: Sequence[Settings]) -> list[Settings]:
    """The settings of bands whose streams are held side by side, and once more together."""
    n = len(alone)
    return [
        replace(
            own, memory=max(own.memory // (2 * n), min(own.least, own.memory)), bands=n, spare=[]
        )
        for own in alone
    ]


def _shares(bands: Sequence[Band], alone: Sequence[Settings], ahead: bool) -> list[Settings] | None:
    """The settings of bands in step; None where they follow each other: they share no pixels, gain
    nothing or would keep less.
    """
    if len(bands) == 1 or not _alike(bands):
        return None
    beside = [
        (2 if ahead else 1) * (band.held(in_step=True) - band.held(in_step=False)) for band in bands
    ]
    found = [
        share_in_step(
            band.chain, longest_of(band.data.observations), own, len(bands), sum(beside) - mine
        )
        for band, own, mine in zip(bands, alone, beside, strict=True)
    ]
    shares = [one for one in found if one is not None]
    return shares if len(shares) == len(bands) else None


def _alike(bands: Sequence[Band]) -> bool:
    """Whether the detectors of all bands look through the same pixels."""
    scans = zip(*(band.data.observations for band in bands), strict=True)
    return all(one.looks_as(scan[0]) for scan in scans for one in scan)


def _done(execution: Execution, band: Band, last: bool) -> None:
    """Tell that a band has observed a scan; release what its views share after the last."""
    observation = execution.observation
    band.data.tally.update(observation.tally)
    if observation.common is not None and last:
        observation.common.clear()
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
        text = (
            f"{settings.threads} of {data.threads} threads work: more do not fit in the memory"
            " budget"
        )
        warnings.warn(f"{budget.place}: {text}", stacklevel=4)
    data.threads = settings.threads
    return settings
