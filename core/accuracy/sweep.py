"""Each knob alone, the others at their tightest, against the tightest rung; and how far that rung
has itself converged.

Runs are limited. Those that a claim rests on come first: the coarsest rung of each knob, which
tells whether it changes anything, the rung before the tightest, and the file's value of knobs that
redraw. The other rungs are measured if a share of the runs is left for the joint search.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from ..errors import ZondaError
from .bench import Bench
from .settings import PipelineKnob, Setting

FOR_SEARCH = 0.25
"""Share of the runs that is left for joint settings."""
NOT_MEASURED = "not measured: more --budget"
UNKNOWN = "not measured, which counts as 100 %"


@dataclass(frozen=True)
class Rung:
    """One value of one knob, the others at their tightest.

    Attributes
    ----------
    error
        Against the tightest rung; None where the run was refused (``note`` says why).
    resolution
        Standard error of ``error`` (knobs that redraw); 0 where the random numbers are the same.
    seconds, spread, memory
        CPU seconds of the run, how far to trust them, peak memory in bytes.
    own, own_spread
        CPU seconds of the knob's own step alone, which other steps' noise does not touch.
    """

    value: str
    error: float | None
    resolution: float = 0.0
    seconds: float = 0.0
    spread: float = 0.0
    memory: int = 0
    own: float = 0.0
    own_spread: float = 0.0
    note: str = ""


@dataclass(frozen=True)
class Alone:
    """A knob turned alone.

    Attributes
    ----------
    rungs
        Coarse to fine; the last is the reference.
    steps
        Errors between neighbouring rungs, coarse to fine.
    left
        What the tightest rung is itself wrong by, as far as the ladder shows it.
    how
        What ``left`` rests on.
    """

    knob: PipelineKnob
    rungs: tuple[Rung, ...]
    steps: tuple[float, ...] = ()
    left: float = 0.0
    how: str = ""

    @property
    def inert(self) -> bool:
        """True if the coarsest rung gives the same bits as the tightest: the knob changes nothing
        in this pipeline.
        """
        return len(self.rungs) == 2 and self.rungs[0].error == 0 and not self.knob.redraws

    @property
    def unmeasured(self) -> bool:
        """True if too few rungs are measured to tell the error of the tightest."""
        return self.how == UNKNOWN

    def rung(self, value: str) -> Rung:
        return next(r for r in self.rungs if r.value == value)

    @property
    def stays(self) -> float:
        """Error of the file's value of a knob that redraws, which stays as in the file. It is the
        error against the tightest rung, or twice the standard error of that if it is not resolved,
        plus the error of the tightest itself. A value that is not on the ladder counts as the worst
        rung.
        """
        measured = [r for r in self.rungs if r.error is not None]
        mine = [r for r in measured if r.value == self.knob.present] or measured
        errors = (max(r.error or 0.0, 2 * r.resolution) for r in mine)
        return max(errors, default=0.0) + self.left


@dataclass
class Sweep:
    """Errors and costs of each knob alone."""

    reference: Setting
    alone: list[Alone] = field(default_factory=list)

    def turned(self, knob: PipelineKnob, value: str) -> Setting:
        """The reference with one knob at another value; a knob that redraws and has the file's
        value is not mentioned.
        """
        if knob.redraws and value == knob.present:
            return self.reference
        return self.reference | {knob.key: value}

    def joint(self, bench: Bench, present: Setting) -> list[Setting]:
        """Settings that are measured, the reference first; knobs that change nothing stay at their
        tightest, but for ``present``, the file's own.
        """
        inert = [a.knob.key for a in self.alone if a.inert]
        return [
            setting
            for setting in bench.settings()
            if setting == present or all(setting[key] == self.reference[key] for key in inert)
        ]

    def note(self, bench: Bench, knobs: Sequence[PipelineKnob]) -> None:
        """Take in what the bench has measured of each knob alone."""
        self.alone = [_alone(bench, knob, self) for knob in knobs]

    @property
    def left(self) -> float:
        """Error of the reference itself, the sum over the knobs: at their tightest, or as in the
        file (`Alone.stays`).
        """
        return self.left_of_turned + sum(a.stays for a in self.alone if a.knob.redraws)

    @property
    def left_of_turned(self) -> float:
        """`left`, of the knobs that take part in joint settings alone."""
        return sum(a.left for a in self.alone if not a.knob.redraws)

    @property
    def staying(self) -> list[Alone]:
        """Knobs that stay as in the file and add to `left`."""
        return [a for a in self.alone if a.knob.redraws and a.stays > 0]


def tightest(knobs: Sequence[PipelineKnob]) -> Setting:
    """Setting with every knob at its tightest, but for those that redraw, which stay as in the
    file.
    """
    return {knob.key: knob.tightest for knob in knobs if not knob.redraws}


def sweep(bench: Bench, knobs: Sequence[PipelineKnob]) -> Sweep:
    """Turn each knob alone. A rung that a run refuses is kept with the reason; that of all tightest
    must run.
    """
    found = Sweep(tightest(knobs))
    every = bench.may(bench.missing(found.reference, all_seeds=True))
    bench.measure(found.reference, all_seeds=every)
    for knob, value, spare in _in_order(knobs, bench):
        setting = found.turned(knob, value)
        reference = found.turned(knob, knob.tightest)
        first = found.turned(knob, knob.ladder[0])
        known = value != knob.ladder[0] and not knob.redraws and bench.has(first)
        if known and bench.error(first, reference) == 0:
            continue  # the coarsest changes no bit: nor will the others
        if not bench.may(bench.missing(setting, knob.redraws) + spare):
            continue
        try:
            bench.measure(setting, all_seeds=knob.redraws)
        except ZondaError:
            if value == knob.tightest:
                raise
    found.note(bench, knobs)
    return found


def _in_order(
    knobs: Sequence[PipelineKnob],
    bench: Bench,
) -> Iterator[tuple[PipelineKnob, str, float]]:
    """Knobs, values, and the runs to leave for others: what claims rest on first, then the other
    rungs of all knobs in turn, fine to coarse.
    """
    turned, redrawn = ([k for k in knobs if k.redraws is which] for which in (False, True))
    yield from ((k, k.ladder[0], 0.0) for k in turned)
    yield from ((k, k.ladder[-2], 0.0) for k in turned)
    for k in redrawn:
        yield k, k.tightest, 0.0
        yield from ((k, v, 0.0) for v in k.ladder if v == k.present or k.present not in k.ladder)
    budget = bench.setup.budget
    spare = FOR_SEARCH * budget if math.isfinite(budget) else 0.0
    for place in range(2, max((len(k.ladder) for k in knobs), default=0) + 1):
        yield from ((k, k.ladder[-place], spare) for k in knobs if len(k.ladder) >= place)


def _alone(bench: Bench, knob: PipelineKnob, found: Sweep) -> Alone:
    """Measurements of a knob so far."""
    reference = found.turned(knob, knob.tightest)
    compare: Callable[[Setting, Setting], tuple[float, float]] = (
        bench.mean_error if knob.redraws else lambda a, b: (bench.error(a, b), 0.0)
    )

    def rung(value: str) -> Rung:
        setting = found.turned(knob, value)
        if (refusal := bench.refusal(setting)) is not None:
            return Rung(value, None, note=f"refused: {refusal.message}".splitlines()[0])
        if any(bench.missing(s, knob.redraws) for s in (setting, reference)):
            return Rung(value, None, note=NOT_MEASURED)
        error = (0.0, 0.0) if value == knob.tightest else compare(setting, reference)
        total, own = bench.seconds(setting), bench.seconds(setting, knob.step)
        return Rung(value, *error, *total, bench.measure(setting).memory, *own)

    rungs = [rung(value) for value in knob.ladder]
    if rungs[0].error == 0 and not knob.redraws:
        rungs = [rungs[0], rungs[-1]]
    open_ended = [k for k, r in enumerate(rungs) if r.note == NOT_MEASURED]
    good = [r for r in rungs[max(open_ended, default=-1) + 1 :] if r.error is not None]
    if len(good) < 2:  # the step across what is not measured
        good = [r for r in rungs if r.error is not None][-2:]
    settings = [found.turned(knob, r.value) for r in good]
    steps = tuple(compare(a, b)[0] for a, b in pairwise(settings))
    if len(good) < 2 and open_ended:
        return Alone(knob, tuple(rungs), (), 1.0, UNKNOWN)
    left, how = convergence(steps, [r.resolution for r in good])
    return Alone(knob, tuple(rungs), steps, left, how)


def convergence(steps: Sequence[float], resolutions: Sequence[float] = ()) -> tuple[float, str]:
    """Error of the last rung, from the errors between neighbours, coarse to fine; and the grounds
    of that figure.

    With d the last step that changes anything, d' the last larger one before it and r = max(d / d',
    0.1), what is left is the rest of a geometric series (Richardson's estimate on a ladder of equal
    ratios),

        left = d r / (1 - r);   (2)

    where no step before was larger, or there is one only, the last step itself is given, and that
    it is no bound.
    """
    if steps and len(resolutions) > 1 and 0 < steps[-1] <= 2 * resolutions[-2]:
        return 2 * resolutions[-2], "the last step is not resolved: twice its standard error"
    changing = [step for step in steps if step > 0]
    if not changing:
        return 0.0, "no rung changes anything"
    last = changing[-1]
    earlier = changing[:-1]
    if not earlier:
        return last, f"one step changes anything, by {100 * last:.2g} %: that step, not a bound"
    larger = [step for step in earlier if step > last]
    if not larger:
        return (
            last,
            (
                f"not converging (the last step, {100 * last:.2g} %, is the largest): that step,"
                " not a bound"
            ),
        )
    ratio = last / larger[-1]
    used = max(ratio, 0.1)
    return (
        last * used / (1 - used),
        (
            f"the last step is {100 * last:.2g} %, {ratio:.2g} times the one before: the rest of"
            " that series"
        ),
    )
