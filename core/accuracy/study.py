"""Study of one pipeline and metric: every knob alone, the Pareto front, and the setting
that is recommended.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..errors import InputError
from .bands import metric_of
from .measure import BETWEEN, Measured, Request, measure
from .pareto import Point, cheapest, pareto, point, search
from .settings import PipelineKnob, Setting, overrides
from .sweep import Bench, Run, Sweep, sweep, tightest

if TYPE_CHECKING:
    from ..campaign.engines import Pool
    from ..configuration.pipeline_file import PipelineFile


REFERENCE_RUNS = 2
"""Timed runs of the reference at the least: their spread is that of all single runs."""
JOINT = 40
"""Joint settings at the most."""


@dataclass(frozen=True)
class Setup:
    """Subject of a study, and how it is measured.

    Attributes
    ----------
    pipeline, settings
        Path or shipped name, and the overrides it is loaded with.
    metric, target
        A metric's name, and the error that it may have.
    shorter
        Overrides that shorten the scans (`settings.shortened`).
    repeats, seeds, threads
        Timed runs of each setting (of the reference `REFERENCE_RUNS`, if that is more); seeds for
        the realization scatter and for knobs that redraw; threads of each run.
    budget
        Largest number of runs, and of CPU seconds in units of one run of the reference.
    pool
        The process that measures (`measure.measuring`); None: each setting in one of its own.
    """

    pipeline: str
    settings: tuple[str, ...]
    metric: str
    target: float
    shorter: Setting
    repeats: int = 1
    seeds: tuple[int | None, ...] = (None,)
    threads: int = 1
    budget: float = math.inf
    pool: Pool | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if not self.target > 0:
            raise InputError(
                f"the target must be above 0, got {100 * self.target:g} %",
                place="--target",
                cure="e.g. 1 %",
            )

    def run(
        self, setting: Setting, seeds: Sequence[int | None], yardstick: Setting | None
    ) -> Measured:
        """Measure a setting."""
        mine, other = (
            () if s is None else (*self.settings, *overrides(self.shorter), *overrides(s))
            for s in (setting, yardstick)
        )
        repeats = 0 if yardstick is None else self.repeats
        if setting == yardstick:
            repeats = max(repeats, REFERENCE_RUNS)
        request = Request(
            self.pipeline, mine, self.metric, other, tuple(seeds), repeats, self.threads
        )
        return measure(request, self.pool)

    def planned(self, knobs: Sequence[PipelineKnob]) -> int:
        """Largest number of runs: of every rung, of the reference beside them, and of joint
        settings, within the budget.
        """
        seeds = len(self.seeds)
        turned = sum(len(k.ladder) - 1 for k in knobs if not k.redraws)
        redrawn = seeds * sum(len(k.ladder) - (k.present in k.ladder) for k in knobs if k.redraws)
        reference = max(self.repeats, REFERENCE_RUNS) + seeds - 1
        runs = reference + self.repeats * (turned + JOINT + 1) + redrawn
        return min(runs + runs // BETWEEN, int(min(self.budget, 10**6)))


@dataclass(frozen=True)
class Study:
    """Results of a study.

    Attributes
    ----------
    says
        What the metric's error is.
    sweep
        Each knob alone.
    present
        The file's own setting.
    points
        Every joint setting that was measured, ``present`` among them.
    chosen
        Of those that meet the target, see `pareto.cheapest`; None where none does.
    floor, scatter
        Instrument noise and realization scatter in units of the error; None where they have no
        meaning or were not measured.
    first
        CPU seconds of the first run of the reference: compilation, imports and caches included.
    runs
        Number of runs that were made.
    interrupted
        Whether the study was stopped before its end.
    """

    setup: Setup
    says: str
    sweep: Sweep
    present: Point
    points: tuple[Point, ...]
    chosen: Point | None
    floor: float | None
    scatter: float | None
    first: float
    runs: int = 0
    interrupted: bool = False

    @property
    def front(self) -> list[Point]:
        """Points that no other beats."""
        return pareto(self.points)


def study(
    file: PipelineFile,
    setup: Setup,
    knobs: Sequence[PipelineKnob],
    *,
    run: Run | None = None,
    say: Callable[[str], None] = lambda what: None,
) -> Study:
    """Sweep, search, choose. ``run`` measures a setting; default: as ``setup`` says.

    Ctrl-C ends the study with what is measured by then, if the reference is.

    Raises
    ------
    InputError, PipelineError
        Where there is no knob, or the pipeline cannot have the metric.
    ZondaError
        Where the tightest setting cannot be run.
    """
    metric = metric_of(file, setup.metric)
    metric.check(file.operators, file.runs)
    if not knobs:
        raise InputError(
            "no step declares a knob",
            place=file.place,
            cure="docs/accuracy.md says how an operator does",
        )
    bench = Bench(run or setup.run, metric, tightest(knobs), setup.seeds, say, setup.budget)
    found = Sweep(bench.yardstick)
    reference = bench.measure(found.reference)
    own = {k.key: k.present for k in knobs if not k.redraws}
    bench.names.setdefault(frozenset(own.items()), "as in the file")
    interrupted = False
    try:
        bench.measure(own)
        found = sweep(bench, knobs)
        allowed = setup.target - found.left
        search(bench, found, allowed if allowed > 0 else setup.target, JOINT)
    except KeyboardInterrupt:
        interrupted = True
        found.note(bench, knobs)
    points = tuple(point(bench, s, found.reference) for s in found.joint(bench, own))
    present = next((p for p in points if p.setting == own), points[0])
    return Study(
        setup,
        metric.says,
        found,
        present,
        points,
        cheapest(points, setup.target, found.left),
        metric.floor(reference.found[0]),
        bench.scatter(found.reference),
        reference.first,
        bench.runs,
        interrupted,
    )
