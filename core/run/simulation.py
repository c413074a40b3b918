"""Simulates a pipeline's runs, one after the other, over all observations."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Sequence
from typing import Any

from ..data import Data, Observation, Tally
from .ahead import Ahead
from .execution import Execution
from .frozen import Frozen
from .repeated import Repeated, affordable, alike
from .selection import Selection
from .settings import Settings, Timer


class Simulation:
    """What runs of the same observations have in common.

    Parameters
    ----------
    selection, order
        The runs and their order, the main run first.
    derived
        Runs that are probably not simulated.
    keep
        Streams of the main run to keep in the observations.
    hooks
        Whom to tell (`core.hooks`).
    """

    def __init__(
        self,
        selection: Selection,
        order: Sequence[str],
        derived: Collection[str],
        data: Data,
        keep: Sequence[str],
        hooks: Any,
        settings: Settings,
        timer: Timer,
        ahead: Ahead,
    ) -> None:
        self._selection, self._order, self._derived = selection, order, derived
        self._data, self._keep, self._hooks = data, keep, hooks
        self._settings, self._timer, self._ahead = settings, timer, ahead
        self._pristine = [(o.focalplane, o.flags, o.detector_flags) for o in data.observations]
        freeze = any(run.modes == "full" for run in selection.runs.values())
        self._frozen = [Frozen() if freeze else None for _ in data.observations]
        self._main = [_left(o) for o in data.observations]
        self._repeated, self._last_repeat = self._keep_for_later_runs()
        self._following: Execution | None = None
        """What is begun of the next scan, or of the first scan of the next run."""

    def make(self, run: str, after_scan: Callable[[], None]) -> None:
        """One run; what comes next is prepared meanwhile."""
        data, hooks = self._data, self._hooks
        for number, observation in enumerate(data.observations, 1):
            execution = self._following or self._begin(run, number - 1, observation)
            observation = data.observations[number - 1] = execution.observation
            last = number == len(data.observations)
            self._following = self._next_run(run) if last else self._begin(run, number, data.observations[number])
            execution.run(data, hooks.zonda_before_operator, hooks.zonda_after_operator, self._ahead, self._following)
            data.tally.update(observation.tally, prefix=f"{run}/" if run else "")
            if not run:
                self._main[number - 1] = _left(observation)
            if (repeated := self._repeated[number - 1]) is not None and run == self._last_repeat:
                repeated.forget(self._settings)
                self._repeated[number - 1] = None
            after_scan()

    @property
    def kept_out(self) -> frozenset[str]:
        """Labels of the steps that left out single samples of the main run."""
        return frozenset().union(*(found.kept_out for found in self._frozen if found))

    def leave_main(self) -> None:
        """Let observations carry what the main run left of detectors, flags, smooth fields and tallies."""
        for observation, found in zip(self._data.observations, self._main, strict=True):
            for name, value in found.items():
                setattr(observation, name, value)

    def _keep_for_later_runs(self) -> tuple[list[Repeated | None], str]:
        """What the main run keeps of each scan, for which less is left of ``settings.memory``; the last run to copy it."""
        steps, observations, settings = self._selection.steps(""), self._data.observations, self._settings
        names, users = alike(steps), list[str]()
        for run in (r for r in self._order if r and r not in self._derived):
            if any(o.label in names for o in self._selection.steps(run)):
                users.append(run)
        later = {o.label for run in users for o in self._selection.steps(run)}
        names = {label: streams for label, streams in names.items() if label in later}
        sizes = affordable(steps, names, observations, settings)
        settings.memory -= sum(sizes)
        if settings.ceiling is not None:
            settings.ceiling -= sum(sizes)
        return [Repeated(names) if size else None for size in sizes], users[-1] if users else ""

    def _next_run(self, run: str) -> Execution | None:
        """The first scan of the run after this one, unless it is the scan that is being executed, or is probably derived.

        A copy of it: until this run is finished, operators find there what this run left.
        """
        later = self._order[self._order.index(run) + 1 :]
        if len(self._data.observations) < 2 or not later or later[0] in self._derived:
            return None
        return self._begin(later[0], 0, copy.copy(self._data.observations[0]))

    def _begin(self, run: str, number: int, observation: Observation) -> Execution:
        focalplane, flags, detector_flags = self._pristine[number]
        before, observation.tally = observation.tally, Tally()
        if not run:
            observation.tally.update(before)  # what pointing steps said belongs to the scan, and to its files
        observation.focalplane, observation.smooth = focalplane.copy(), {}
        if run:  # the scene's levels, for the weights of a run without noise too
            observation.focalplane.net = self._main[number]["focalplane"].net.copy()
        observation.output, observation.components = self._data.output, self._selection.streams(run)
        observation.flags, observation.detector_flags = flags.copy(), detector_flags.copy()
        kept = self._frozen[number] if not run or self._selection.runs[run].modes == "full" else None
        steps, keep = self._selection.steps(run), self._keep if not run else ()
        return Execution(steps, observation, self._settings, self._timer, keep, kept, self._repeated[number])


def _left(observation: Observation) -> dict[str, Any]:
    """What a run leaves behind in an observation."""
    names = ("focalplane", "flags", "detector_flags", "smooth", "tally", "components")
    return {name: getattr(observation, name) for name in names}
