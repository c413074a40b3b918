"""Study of one pipeline and metric: every knob alone, the Pareto front, and the setting
that is recommended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..errors import InputError
from .bench import BETWEEN, REFERENCE_RUNS, Bench, Run, Setup
from .measure import TimedRun, run_in
from .metrics import metric_of
from .pareto import Point, cheapest, pareto, point, search
from .settings import PipelineKnob
from .sweep import Sweep, sweep, tightest

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile
    from ..experiment.engines import Pool


JOINT = 40
"""Joint settings at the most."""


@dataclass(frozen=True)
class Study:
    """Results of a study.

    Attributes
    ----------
    says
        Meaning of the metric's error.
    sweep
        Each knob alone.
    present
        The file's own setting.
    points
        Every joint setting that was measured, ``present`` among them.
    floor, scatter
        Instrument noise and realization scatter in units of the error; None where they have no
        meaning or were not measured.
    first
        CPU seconds of the first run of the reference: compilation, imports and caches included.
    runs
        Number of runs that were made.
    interrupted
        True if the study was stopped before its end.
    """

    setup: Setup
    says: str
    sweep: Sweep
    present: Point
    points: tuple[Point, ...]
    floor: float | None = None
    scatter: float | None = None
    first: float = 0.0
    runs: int = 0
    interrupted: bool = False

    @property
    def front(self) -> list[Point]:
        """Points that no other beats."""
        return pareto(self.points)

    @property
    def chosen(self) -> Point | None:
        """The point that meets the target, see `pareto.cheapest`; None where none does."""
        return cheapest(self.points, self.setup.target, self.sweep.left)


def most_runs(setup: Setup, knobs: Sequence[PipelineKnob]) -> int:
    """Largest number of runs: of every rung, of the reference beside them, and of joint settings,
    within the budget.
    """
    seeds = len(setup.seeds)
    turned = sum(len(k.ladder) - 1 for k in knobs if not k.redraws)
    redrawn = seeds * sum(len(k.ladder) - (k.present in k.ladder) for k in knobs if k.redraws)
    reference = max(setup.repeats, REFERENCE_RUNS) + seeds - 1
    runs = reference + setup.repeats * (turned + JOINT + 1) + redrawn
    return min(runs + runs // BETWEEN, int(min(setup.budget, 10**6)))


def study(
    file: PipelineFile,
    setup: Setup,
    knobs: Sequence[PipelineKnob],
    pool: Pool | None = None,
    *,
    run: Run | None = None,
    say: Callable[[str], None] = lambda what: None,
) -> Study:
    """Sweep, search, choose. Runs are made in the process of ``pool``, or by ``run``.

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

    def in_pool(setting: dict[str, str], seed: int | None, alone: bool) -> TimedRun:
        assert pool is not None
        return run_in(pool, setup.variant(setting), setup.metric, setup.threads, seed, alone)

    bench = Bench(run or in_pool, metric, tightest(knobs), setup, say)
    found = Sweep(bench.yardstick)
    reference = bench.measure(found.reference)
    own = {k.key: k.present for k in knobs if not k.redraws}
    bench.names.setdefault(frozenset(own.items()), "as in the file")
    interrupted = False
    try:
        if bench.may(bench.missing(own)):
            bench.measure(own)
        found = sweep(bench, knobs)
        allowed = setup.target - found.left
        search(bench, found, allowed if allowed > 0 else setup.target, JOINT)
    except KeyboardInterrupt:
        interrupted = True
        found.note(bench, knobs)
    points = tuple(point(bench, s, found.reference) for s in found.joint(bench, own))
    return Study(
        setup,
        metric.says,
        found,
        next((p for p in points if p.setting == own), points[0]),
        points,
        metric.floor(reference.found[0]),
        bench.scatter(found.reference),
        reference.runs[0].first,
        bench.runs,
        interrupted,
    )
