"""Estimates of an operator for the planner: the size of its effects, and the errors of coarser
forms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

METRICS = {
    "map_rms": "rms error of a map pixel, K",
    "peak": "largest error of the sky's brightness in the map, K",
    "transfer": "largest error of the transfer function",
    "tod": "rms error of one sample of the calibrated time stream, K",
    "psd": "largest relative error of the time stream's power spectrum, before filters",
}
"""What an error may be bounded in."""

Bound = Mapping[str, float]
"""Upper bounds by metric; a metric that is absent is not touched."""

Decision = Literal["full", "coarse", "dropped", "not simulated"]


@dataclass(frozen=True)
class Saving:
    """CPU time that a coarser form saves, as measured in a benchmark scene.

    Attributes
    ----------
    scene
        A shipped pipeline or a scene of ``benchmarks/plan``.
    share
        Share of the CPU time of the run in full (`python benchmarks/plan.py --rungs`).
    """

    scene: str
    share: float


@dataclass(frozen=True)
class Choice:
    """One way to carry out an effect.

    Attributes
    ----------
    decision, what
        Kind, and in a few words what it is (``6 poles``).
    settings
        Parameters of the operator (or of the pipeline: ``precision``) that bring it about.
    leave_out
        The operator does not run at all.
    bound
        Error against the effect as the pipeline asks for it.
    formula
        Where the bound comes from.
    seconds
        Seconds that it saves, stated by planning classes of before: above 0 it is tried after the
        forms that state what they `saves`.
    saves
        Measured saving; None: it saves nothing in this scene, and is taken only if it is asked for.
    """

    decision: Decision
    what: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    leave_out: bool = False
    bound: Bound = field(default_factory=dict)
    formula: str = ""
    seconds: float = 0.0
    saves: Saving | None = None

    @property
    def pays(self) -> bool:
        """True if the form saves time in this scene."""
        return self.saves is not None or self.seconds > 0


@dataclass(frozen=True)
class Effect:
    """Something that the sky, the atmosphere, the telescope or the arithmetic does to the products.

    Attributes
    ----------
    name
        Unique in its operator: ``poles``, ``layer 9``.
    choices
        The first is what the pipeline asks for; the others are coarser, each less accurate than the
        one before.
    size, formula
        Upper bound of what the effect contributes (what leaving it out would cost), and where it
        comes from.
    """

    name: str
    choices: tuple[Choice, ...]
    size: Bound = field(default_factory=dict)
    formula: str = ""


@dataclass(frozen=True)
class Cost:
    """CPU seconds stated by planning classes of before; accepted and not used: times are measured.

    Attributes
    ----------
    fixed, per_time, per_sample
        seconds = fixed + per_time N_t + per_sample N_det N_t of one observation.
    once
        Seconds for the whole run.
    """

    fixed: float = 0.0
    per_time: float = 0.0
    per_sample: float = 0.0
    once: float = 0.0
    kernel: str = "stream"
    shared: float = 0.0


@dataclass(frozen=True)
class Estimate:
    """An operator's effects. ``without``: what leaving the whole operator out would cost, where
    that is not what its effects contribute. ``cost`` is accepted and not used."""

    effects: tuple[Effect, ...] = ()
    cost: Cost | None = None
    without: Bound | None = None


@dataclass(frozen=True)
class Traits:
    """Properties of an operator that the bounds of others depend on.

    Attributes
    ----------
    noise
        Adds this much white noise: rms of one sample of the calibrated stream, K; of the quietest
        detector.
    each
        (n_det,) The same of each detector; None: they are alike.
    rms
        Adds a fluctuation of at most this rms to the calibrated stream, K (the smooth mean apart).
    faster
        Rms above a frequency [Hz], K; None: that of all of it.
    peak
        Adds a sky of at most this brightness, K; None: it adds no sky, or does not know.
    pixel
        Makes a map with pixels of this side, rad.
    response
        Amplitude that passes at a frequency [Hz]; None: all.
    removes_common
        Removes what all detectors have in common.
    turns
        Removes modes that it finds in the data: without a part of them it finds others.
    weighs
        Makes a map in which samples are weighed by the inverse variance of their white noise.
    gain_error
        Scatters the detectors' gains by this relative rms, unknown to the calibration.
    """

    noise: float = 0.0
    each: NDArray[np.float64] | None = None
    rms: float = 0.0
    faster: Callable[[float], float] | None = None
    peak: float | None = None
    pixel: float = 0.0
    response: Callable[[float], float] | None = None
    removes_common: bool = False
    turns: bool = False
    weighs: bool = False
    gain_error: float = 0.0

    @property
    def loudest(self) -> float:
        """`noise` of the noisiest detector, K."""
        return self.noise if self.each is None else float(self.each.max(initial=0.0))


def add(*bounds: Bound) -> dict[str, float]:
    """The sum of bounds."""
    return {m: sum(b.get(m, 0.0) for b in bounds) for m in METRICS if any(m in b for b in bounds)}


def full(what: str, **more: Any) -> Choice:
    """The first choice of an effect: as the pipeline asks for it."""
    return Choice("full", what, **more)


def exact(name: str, size: Bound, formula: str, what: str = "exact") -> Effect:
    """An effect that has no coarser form."""
    return Effect(name, (full(what),), size, formula)


def not_simulated(name: str, what: str, bound: Bound, formula: str) -> Effect:
    """An effect that nature has and zonda leaves out, with a bound on what that costs."""
    return Effect(
        name, (Choice("not simulated", what, bound=bound, formula=formula),), bound, formula
    )


def describe(bound: Bound, metrics: Iterable[str]) -> str:
    """A bound in the products' units, the metrics that matter only."""
    return ", ".join(f"{m} {figure(m, bound[m])}" for m in METRICS if m in bound and m in metrics)


def figure(metric: str, value: float) -> str:
    """A bound in the unit of its metric, which may name a plane too: ``transfer Q``."""
    return f"{value:.1e}" if metric.split()[0] in ("transfer", "psd") else kelvin(value)


def kelvin(value: float) -> str:
    """A temperature with three figures and a unit that reads well."""
    for factor, unit in ((1.0, "K"), (1e3, "mK"), (1e6, "uK"), (1e9, "nK")):
        if abs(value) * factor >= 1:
            return f"{value * factor:.3g} {unit}"
    return f"{value * 1e9:.1g} nK" if value else "0 K"
