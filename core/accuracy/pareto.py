"""The Pareto front: which settings of all knobs together nothing beats in error, CPU seconds and
memory.

The search begins with every knob at its tightest and relaxes one knob at a time, that with the best
saving per added error as the knobs alone predict it; each joint setting is then measured, never
added up. While the measured error stays within what is allowed the step is kept; a step that
exceeds it is undone and not tried again. When nothing more may be relaxed it tries exchanges: one
knob relaxed further and others tightened to pay for it. Then it goes on beyond the target, so that
the front shows what more error would buy. It measures about one setting per rung: the sum of the
ladders, not their product.

A study of one pipeline and metric has every knob alone (`sweep`), this front, and the setting that
is recommended.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from ..configuration.pipeline_file import PipelineFile
from ..errors import InputError
from ..experiment.engines import Pool
from .bench import BETWEEN, REFERENCE_RUNS, Bench, Run, Setup, TimedRun, run_in
from .metrics import metric_of
from .settings import PipelineKnob, Setting
from .sweep import Alone, Sweep, sweep, tightest

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
        """The point that meets the target, see `cheapest`; None where none does."""
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


SAME_MEMORY = 1.02
"""Peak memory within this factor counts as equal: allocators do not repeat to the byte."""


@dataclass(frozen=True)
class Point:
    """A joint setting, measured: error against the reference, CPU seconds and their spread, peak
    memory in bytes.

    ``bands``: the error of each band by its name, of which ``error`` is the largest; empty where
    the camera has one.
    """

    setting: Setting
    error: float
    seconds: float
    spread: float
    memory: int
    bands: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Step:
    """Another value of one knob: CPU seconds that it saves, error that it adds, and the noise of
    the saving, as the knob alone predicts them.
    """

    key: str
    value: str
    saving: float
    error: float
    noise: float


def point(bench: Bench, setting: Setting, reference: Setting) -> Point:
    """Measure a joint setting."""
    error = bench.error(setting, reference)
    return Point(
        setting,
        error,
        *bench.seconds(setting),
        bench.measure(setting).memory,
        bench.errors(setting, reference),
    )


def search(bench: Bench, found: Sweep, allowed: float, most: int = 40) -> list[Point]:
    """Every joint setting that was tried, in order; the first is the reference. ``allowed``: error
    that a kept step may reach.
    """
    turning = [a for a in found.alone if not a.knob.redraws and not a.inert]
    points: list[Point] = []

    def tried(setting: Setting) -> Point:
        points.append(point(bench, setting, found.reference))
        return points[-1]

    def may_go_on() -> bool:
        return len(points) < most and bench.may(bench.missing())

    best = _relaxed(turning, tried(found.reference), allowed, tried, may_go_on)
    while may_go_on():
        exchange = _exchange(turning, best, allowed)
        if exchange is None or any(p.setting == exchange for p in points):
            break
        now = tried(exchange)
        if now.error > allowed:
            break
        best = now
    _relaxed(turning, best, math.inf, tried, may_go_on)
    return points


def _relaxed(
    turning: Sequence[Alone],
    here: Point,
    limit: float,
    tried: Callable[[Setting], Point],
    may_go_on: Callable[[], bool],
) -> Point:
    """Relax one knob after the other while the measured error stays within ``limit``; the point
    that is reached.
    """
    refused: set[tuple[str, str]] = set()
    while may_go_on():
        options = [s for s in _steps(turning, here.setting) if (s.key, s.value) not in refused]
        if not options:
            break
        best = max(options, key=lambda s: s.saving / max(s.error, 1e-12))
        now = tried(here.setting | {best.key: best.value})
        if now.error <= limit:
            here = now
        else:
            refused.add((best.key, best.value))
    return here


def _exchange(turning: Sequence[Alone], here: Point, allowed: float) -> Setting | None:
    """The setting that saves most, as predicted: one knob relaxed, and others tightened until the
    error is allowed again.
    """
    best = None
    most = here.spread
    for step in _steps(turning, here.setting):
        setting = here.setting | {step.key: step.value}
        taken = [step]
        while here.error + sum(t.error for t in taken) > allowed:
            ways = [t for a in turning if a.knob.key != step.key for t in _tighter(a, setting)]
            if not ways:
                break
            way = max(ways, key=lambda t: -t.error / max(-t.saving, 1e-12))
            setting |= {way.key: way.value}
            taken.append(way)
        else:
            saving = sum(t.saving for t in taken)
            if saving > most:
                best = setting
                most = saving
    return best


def _tighter(alone: Alone, here: Setting) -> list[_Step]:
    """Finer values of a knob than here that lower its error; savings and errors are negative."""
    return [step for step in _moves(alone, here, finer=True) if step.error < 0]


def _steps(turning: Sequence[Alone], here: Setting) -> list[_Step]:
    """Relaxations from here that save more than the noise of the measurement."""
    moves = (step for alone in turning for step in _moves(alone, here, finer=False))
    return [replace(s, error=max(0.0, s.error)) for s in moves if s.saving > s.noise]


def _moves(alone: Alone, here: Setting, finer: bool) -> Iterator[_Step]:
    """Steps of one knob from its value here to the finer, or to the coarser ones."""
    at = alone.rung(here[alone.knob.key])
    place = alone.rungs.index(at)
    for rung in alone.rungs[place + 1 :] if finer else alone.rungs[:place]:
        if rung.error is not None:
            error = rung.error - (at.error or 0.0)
            noise = math.hypot(at.own_spread, rung.own_spread)
            yield _Step(alone.knob.key, rung.value, at.own - rung.own, error, noise)


def pareto(points: Sequence[Point]) -> list[Point]:
    """Points that no other beats, by error."""
    unique = list({frozenset(p.setting.items()): p for p in points}.values())
    kept = [p for p in unique if not any(_beats(q, p) for q in unique)]
    return sorted(kept, key=lambda p: (p.error, p.seconds))


def cheapest(points: Sequence[Point], target: float, left: float = 0.0) -> Point | None:
    """The cheapest point whose error, with what is ``left`` in the reference, meets the target;
    among those that cost the same within its spread, the most accurate. None where there is
    none."""
    best = least(points, target, left)
    if best is None:
        return None
    alike = (p for p in points if p.seconds <= best.seconds + best.spread)
    return min(alike, key=lambda p: (p.error, p.seconds))


def least(points: Sequence[Point], target: float, left: float = 0.0) -> Point | None:
    """The point that was measured to cost least of those that meet the target; None where there is
    none.
    """
    return min(
        (p for p in points if p.error + left <= target),
        key=lambda p: p.seconds,
        default=None,
    )


def _beats(q: Point, p: Point) -> bool:
    no_worse = q.error <= p.error and q.seconds <= p.seconds and q.memory <= p.memory * SAME_MEMORY
    return no_worse and (q.error < p.error or q.seconds < p.seconds)
