"""A whole study of one pipeline and metric: every knob alone, the Pareto front, and the setting
that is recommended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..errors import InputError
from .bands import metric_of
from .measure import Measured, Request, measure
from .pareto import Point, cheapest, pareto, point, search
from .settings import PipelineKnob, Setting, overrides
from .sweep import Bench, Run, Sweep, sweep, tightest

if TYPE_CHECKING:
    from ..configuration.pipeline_file import PipelineFile


@dataclass(frozen=True)
class Setup:
    """What is studied, and how it is measured.

    Attributes
    ----------
    pipeline, settings
        Path or shipped name, and the overrides it is loaded with.
    metric, target
        A metric's name, and the error that it may have.
    shorter
        Overrides that shorten the scans (`settings.shortened`).
    repeats, seeds, threads
        Timed runs of each setting; seeds for the realization scatter and for knobs that redraw;
        threads of each run.
    """

    pipeline: str
    settings: tuple[str, ...]
    metric: str
    target: float
    shorter: Setting
    repeats: int = 3
    seeds: tuple[int | None, ...] = (None,)
    threads: int = 1

    def __post_init__(self) -> None:
        if not self.target > 0:
            raise InputError(
                f"the target must be above 0, got {100 * self.target:g} %",
                place="--target",
                cure="e.g. 1 %",
            )

    def run(self, setting: Setting, seeds: Sequence[int | None], yardstick: Setting) -> Measured:
        """Measure a setting in a process of its own."""
        mine, other = (
            (*self.settings, *overrides(self.shorter), *overrides(s)) for s in (setting, yardstick)
        )
        return measure(
            Request(
                self.pipeline, mine, self.metric, other, tuple(seeds), self.repeats, self.threads
            )
        )


@dataclass(frozen=True)
class Study:
    """What was found.

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
    """Sweep, search, choose. ``run`` measures a setting; default: in a process of its own.

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
    bench = Bench(run or setup.run, metric, tightest(knobs), setup.seeds, say)
    found = sweep(bench, knobs)
    reference = bench.measure(found.reference)
    present = point(bench, {k.key: k.present for k in knobs if not k.redraws}, found.reference)
    allowed = setup.target - found.left
    points = (*search(bench, found, allowed if allowed > 0 else setup.target), present)
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
    )
