"""Each knob alone, the others at their tightest, against the tightest rung; and how far that rung
has itself converged.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise

import numpy as np

from ..errors import ZondaError
from .measure import Measured
from .metrics import Metric
from .settings import PipelineKnob, Setting

Run = Callable[[Setting, Sequence[int | None], Setting], Measured]
"""Measures a setting at some seeds, timing it (at the first) beside the setting that is its
yardstick.
"""


class Bench:
    """Measures settings, each once, and compares them.

    Parameters
    ----------
    run
        Measures.
    yardstick
        The setting that all are timed beside: costs are ratios to its runs, so that the load of the
        machine cancels.
    metric
        Compares.
    seeds
        For knobs that redraw and for the realization scatter; the first is the one all settings
        share.
    say
        Told what is being measured.
    """

    def __init__(
        self,
        run: Run,
        metric: Metric,
        yardstick: Setting,
        seeds: Sequence[int | None] = (None,),
        say: Callable[[str], None] = lambda what: None,
    ) -> None:
        self.run, self.metric, self.yardstick, self.seeds, self.say = (
            run,
            metric,
            yardstick,
            tuple(seeds),
            say,
        )
        self._done: dict[frozenset[tuple[str, str]], Measured] = {}

    def measure(self, setting: Setting, all_seeds: bool = False) -> Measured:
        """The measurement of a setting; made where it is not there yet."""
        key, wanted = frozenset(setting.items()), self.seeds if all_seeds else self.seeds[:1]
        if key not in self._done or len(self._done[key].found) < len(wanted):
            self.say(
                f"{len(self._done) + 1}:"
                f" {' '.join(f'{k}={v}' for k, v in setting.items()) or 'as in the file'}"
            )
            self._done[key] = self.run(setting, wanted, self.yardstick)
        return self._done[key]

    def seconds(self, setting: Setting, step: str = "") -> tuple[float, float]:
        """CPU seconds of a setting, or of one of its steps, and their spread, on the scale of the
        yardstick's own runs.
        """
        measured = self.measure(self.yardstick)
        totals = [sum(run) for run in zip(*measured.steps.values(), strict=True)] + list(
            measured.yardstick
        )
        scale = statistics.median(totals) if measured.yardstick else 1.0
        middle, spread = self.measure(setting).cost(step)
        return scale * middle, scale * spread

    def error(self, setting: Setting, reference: Setting) -> float:
        """Of a setting against a reference with the same random numbers."""
        return self.metric.error(self.measure(setting).found[0], self.measure(reference).found[0])

    def errors(self, setting: Setting, reference: Setting) -> dict[str, float]:
        """`error` of each band, by its name; empty where the camera has one."""
        return dict(
            self.metric.errors(self.measure(setting).found[0], self.measure(reference).found[0])
        )

    def mean_error(self, setting: Setting, reference: Setting) -> tuple[float, float]:
        """Change of the mean over seeds and its standard error (`Metric.mean_error`)."""
        return self.metric.mean_error(
            self.measure(setting, True).found, self.measure(reference, True).found
        )

    def scatter(self, reference: Setting) -> float | None:
        """Realization scatter in units of the error: rms over pairs of seeds of their error,
        divided by sqrt(2).
        """
        found = self.measure(reference, True).found
        pairs = [self.metric.error(a, b) ** 2 for a, b in combinations(found, 2)]
        return float(np.sqrt(np.mean(pairs) / 2)) if pairs else None


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
        """Whether the coarsest rung gives the same bits as the tightest: the knob changes nothing
        in this pipeline.
        """
        return len(self.rungs) == 2 and self.rungs[0].error == 0 and not self.knob.redraws

    def rung(self, value: str) -> Rung:
        return next(r for r in self.rungs if r.value == value)

    @property
    def stays(self) -> float:
        """Of a knob that redraws, which stays as in the file: what the file's value is wrong by.
        Its error against the tightest rung, or twice the standard error of that where it is not
        resolved, and what the tightest is itself wrong by. A value that is not on the ladder counts
        as the worst rung."""
        measured = [r for r in self.rungs if r.error is not None]
        mine = [r for r in measured if r.value == self.knob.present] or measured
        return (
            max(
                (r.error or 0.0 if (r.error or 0.0) > 2 * r.resolution else 2 * r.resolution)
                for r in mine
            )
            + self.left
        )


@dataclass
class Sweep:
    """All knobs alone."""

    reference: Setting
    alone: list[Alone] = field(default_factory=list)

    @property
    def left(self) -> float:
        """What the reference is itself wrong by, the sum over the knobs: at their tightest, or as
        in the file (`Alone.stays`).
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
    """All knobs at their tightest, but for those that redraw, which stay as in the file."""
    return {knob.key: knob.tightest for knob in knobs if not knob.redraws}


def sweep(bench: Bench, knobs: Sequence[PipelineKnob]) -> Sweep:
    """Turn each knob alone. A rung that a run refuses is kept with the reason; that of all tightest
    must run.
    """
    found = Sweep(tightest(knobs))
    bench.measure(found.reference, all_seeds=True)
    found.alone = [_alone(bench, knob, found.reference) for knob in knobs]
    return found


def _alone(bench: Bench, knob: PipelineKnob, others: Setting) -> Alone:
    reference = others | {knob.key: knob.tightest}
    rungs: list[Rung] = []

    def rung(value: str, error: float, resolution: float) -> Rung:
        setting = others | {knob.key: value}
        total, own = bench.seconds(setting), bench.seconds(setting, knob.step)
        return Rung(value, error, resolution, *total, bench.measure(setting).memory, *own)

    for value in knob.ladder[:-1]:
        setting = others | {knob.key: value}
        try:
            error, resolution = (
                bench.mean_error(setting, reference)
                if knob.redraws
                else (bench.error(setting, reference), 0.0)
            )
        except ZondaError as err:
            rungs.append(Rung(value, None, note=f"refused: {err.message}".splitlines()[0]))
            continue
        rungs.append(rung(value, error, resolution))
        if error == 0 and not knob.redraws and len(rungs) == 1:
            break  # the coarsest changes no bit: nor will the others
    bench.measure(reference, all_seeds=knob.redraws)
    rungs.append(rung(knob.tightest, 0.0, 0.0))
    good = [others | {knob.key: r.value} for r in rungs if r.error is not None]
    compare = (lambda a, b: bench.mean_error(a, b)[0]) if knob.redraws else bench.error
    steps = tuple(compare(a, b) for a, b in pairwise(good))
    left, how = convergence(steps, [r.resolution for r in rungs if r.error is not None])
    return Alone(knob, tuple(rungs), steps, left, how)


def convergence(steps: Sequence[float], resolutions: Sequence[float] = ()) -> tuple[float, str]:
    """What the last rung is wrong by, from the errors between neighbours, coarse to fine; and what
    that rests on.

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
    last, earlier = changing[-1], changing[:-1]
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


def differences(setting: Mapping[str, str], reference: Mapping[str, str]) -> Setting:
    """What a setting has other than the reference."""
    return {k: v for k, v in setting.items() if reference.get(k) != v}
