"""Executes all scans of a run, each with all bands of the camera: together where that fits
(`budget.divide`), else band after band.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..hooks import manager
from .budget import divide
from .execution import Execution
from .prefetch import Ahead
from .settings import Settings, Timer
from .views import Band, View


def execute(bands: Sequence[Band], settings: Settings, timer: Timer) -> None:
    """Run all scans in order; the next one is prepared while one is executed."""
    hooks = manager().hook.zonda_before_operator, manager().hook.zonda_after_operator
    heard = any(
        hook.get_hookimpls() for hook in hooks
    )  # who listens hears of one observation after the other
    several = len(bands) + len(bands[0].data.observations) > 2
    ahead = Ahead(settings.threads > 1 and several and not heard)
    groups = divide(bands, settings, ahead)
    turns = [
        (these, Execution([View(b.chain, b.data.observations[k], b.data) for b in these], own,
                          timer, *hooks))
        for k in range(len(bands[0].data.observations))
        for these, own in groups
    ]  # fmt: skip
    following = [*(execution for _, execution in turns[1:]), None]
    try:
        for (these, execution), after in zip(turns, following, strict=True):
            execution.run(ahead, after)
            for band, view in zip(these, execution.views, strict=True):
                band.data.log.update(view.observation.log)
                if band is bands[-1] and view.observation.common is not None:
                    view.observation.common.clear()  # the last that may need it
                band.watch("scan")
    finally:
        ahead.close()
