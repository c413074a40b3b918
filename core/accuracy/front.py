"""The joint front: which settings of all knobs together nothing beats in error, CPU seconds and memory.

The search begins with every knob at its tightest and relaxes one knob at a time, that with the best saving per added error as
the knobs alone predict it; each joint setting is then measured, never added up. While the measured error stays within what is
allowed the step is kept; a step that exceeds it is undone and not tried again from there. When nothing more may be relaxed the
search goes on beyond the target, so that the front shows what more error would buy. It measures at most one setting per rung:
the sum of the ladders, not their product.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from .settings import Setting
from .sweep import Alone, Bench, Sweep

SAME_MEMORY = 1.02
"""Peak memory within this factor counts as equal: allocators do not repeat to the byte."""


@dataclass(frozen=True)
class Point:
    """A joint setting, measured: error against the reference, CPU seconds and their spread, peak memory in bytes."""

    setting: Setting
    error: float
    seconds: float
    spread: float
    memory: int


@dataclass(frozen=True)
class _Step:
    """A relaxation of one knob, as the knob alone predicts it."""

    key: str
    value: str
    saving: float
    error: float


def point(bench: Bench, setting: Setting, reference: Setting) -> Point:
    """Measure a joint setting."""
    measured = bench.measure(setting)
    return Point(setting, bench.error(setting, reference), measured.seconds(), measured.spread(), measured.memory)


def search(bench: Bench, found: Sweep, allowed: float, most: int = 40) -> list[Point]:
    """Every joint setting that was tried, in order; the first is the reference. ``allowed``: error that a kept step may reach."""
    reference = found.reference
    turning = [a for a in found.alone if not a.knob.redraws and not a.inert]
    points = [point(bench, reference, reference)]
    here, refused = dict(reference), set[tuple[str, str]]()
    limit = allowed
    while len(points) < most:
        options = [s for s in _steps(turning, here) if (s.key, s.value) not in refused]
        if not options:
            if math.isinf(limit):
                break
            limit = math.inf  # beyond the target, to draw the rest of the front
            refused.clear()
            continue
        best = max(options, key=lambda s: s.saving / max(s.error, 1e-12))
        tried = point(bench, here | {best.key: best.value}, reference)
        points.append(tried)
        if tried.error <= limit:
            here = tried.setting
        else:
            refused.add((best.key, best.value))
    return points


def _steps(turning: Sequence[Alone], here: Setting) -> list[_Step]:
    """All relaxations from here that save more than the noise of the measurement."""
    steps = []
    for alone in turning:
        at = alone.rung(here[alone.knob.key])
        for rung in alone.rungs:
            if rung is at:
                break
            saving = at.own - rung.own
            if rung.error is not None and saving > math.hypot(at.own_spread, rung.own_spread):
                steps.append(_Step(alone.knob.key, rung.value, saving, max(0.0, rung.error - (at.error or 0.0))))
    return steps


def pareto(points: Sequence[Point]) -> list[Point]:
    """Those that no other beats, by error."""
    unique = list({frozenset(p.setting.items()): p for p in points}.values())
    kept = [p for p in unique if not any(_beats(q, p) for q in unique)]
    return sorted(kept, key=lambda p: (p.error, p.seconds))


def cheapest(points: Sequence[Point], target: float, left: float = 0.0) -> Point | None:
    """The cheapest point whose error, with what is ``left`` in the reference, meets the target; among those that cost the same
    within their spread, the most accurate. None where there is none."""
    good = [p for p in points if p.error + left <= target]
    if not good:
        return None
    best = min(good, key=lambda p: p.seconds)
    return min((p for p in good if p.seconds <= best.seconds + best.spread), key=lambda p: (p.error, p.seconds))


def _beats(q: Point, p: Point) -> bool:
    no_worse = q.error <= p.error and q.seconds <= p.seconds and q.memory <= p.memory * SAME_MEMORY
    return no_worse and (q.error < p.error or q.seconds < p.seconds)
