"""The Pareto front: which settings of all knobs together nothing beats in error, CPU seconds and
memory.

The search begins with every knob at its tightest and relaxes one knob at a time, that with the best
saving per added error as the knobs alone predict it; each joint setting is then measured, never
added up. While the measured error stays within what is allowed the step is kept; a step that
exceeds it is undone and not tried again. When nothing more may be relaxed it tries exchanges: one
knob relaxed further and others tightened to pay for it. Then it goes on beyond the target, so that
the front shows what more error would buy. It measures about one setting per rung: the sum of the
ladders, not their product.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from .bench import Bench
from .settings import Setting
from .sweep import Alone, Sweep

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
    best, most = None, here.spread
    for step in _steps(turning, here.setting):
        setting, taken = here.setting | {step.key: step.value}, [step]
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
                best, most = setting, saving
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
        (p for p in points if p.error + left <= target), key=lambda p: p.seconds, default=None
    )


def _beats(q: Point, p: Point) -> bool:
    no_worse = q.error <= p.error and q.seconds <= p.seconds and q.memory <= p.memory * SAME_MEMORY
    return no_worse and (q.error < p.error or q.seconds < p.seconds)
