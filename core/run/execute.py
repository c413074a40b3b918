"""Executes all scans of a run, each with all bands of the camera.

Bands that share pixels, or that a filter measures together, are executed together (`scan`), if
their streams fit in memory side by side; others follow each other, scan by scan.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..hooks import manager
from ..mapmaker import joins
from .bands import Band
from .budget import Budget, divide
from .execution import Execution
from .prefetch import Ahead
from .scan import run
from .settings import Settings, Timer


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
    divided = divide(bands, settings, budget, ahead, not heard)
    executions = [
        [Execution(band.chain, o, own, timer, *hooks) for o in band.data.observations]
        for band, own in zip(bands, divided.settings, strict=True)
    ]
    numbers = list(range(len(bands)))
    groups = [numbers] if divided.together else [[k] for k in numbers]
    scans = list(zip(*executions, strict=True))
    turns = [([scan[k] for k in group], group) for scan in scans for group in groups]
    following = [*(these for these, _ in turns[1:]), []]
    try:
        for (these, group), then in zip(turns, following, strict=True):
            run(these, [bands[k].data for k in group], ahead, then, divided.blockwise)
            for execution, k in zip(these, group, strict=True):
                _done(execution, bands[k], k == numbers[-1])
    finally:
        ahead.close()


def _done(execution: Execution, band: Band, last: bool) -> None:
    """Report that a band has observed a scan; after the last band, free what its views share."""
    observation = execution.observation
    band.data.tally.update(observation.tally)
    if observation.common is not None and last:
        observation.common.clear()
    band.watch(band.data, "scan")
