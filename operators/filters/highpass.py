"""A brick-wall high-pass filter of whole scans, without phase: equations (1) and (2) of `brick_wall`."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Hertz, Seconds
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.flags import EXCLUDE_SAMPLE, HAS_A_SIGNAL, PROCESSING, good
from zonda.core.operator import Operator

from .brick_wall import HighpassPlan, plan_highpass

SPOILT = "samples not finite"
"""Count of samples that are left as they are."""

ONLY_THE_MEAN, ONLY_A_LINE = "only the mean is removed", "only the mean and a line are removed"


class HighpassFilter(Operator):
    """Zero-phase brick-wall high-pass filter of each detector's scan: equations (1) and (2) of `brick_wall`.

    The modelled mean emission that accompanies the signal is dropped analytically, before anything else. A scan that is shorter
    than 1 / `frequency` loses its mean and a line alone; the log says so. A frequency so near the Nyquist frequency that
    nothing of a scan is left is refused.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"

    frequency: Hertz = quantity("0.08 Hz", gt=0)
    """Cutoff: everything slower is removed."""
    degree: int = Field(3, ge=0, le=3)
    """Degree of the polynomial fitted to each detector's scan and removed before the even extension (1: a line)."""
    trim: Seconds = quantity("0 s", ge=0)
    """Flag this long at either end of each scan."""
    oversampling: float = Field(24.0, ge=8, le=1000)
    """Coarse knots per cut cycle (M / (K / 2)); the low part's error at the cut is about oversampling^-4."""

    def check(self, data: Data) -> list[str]:
        """Scans that are shorter than one cycle of the cut."""
        short, every = sum(o.duration * self.frequency < 1 for o in data.observations), len(data.observations)
        text = f"{short} of {every} scans are shorter than 1/frequency, {1 / self.frequency:g} s: {_only(self.degree)}"
        return [text] if short else []

    def prepare(self, observation: Observation) -> tuple[HighpassPlan, NDArray[np.intp]]:
        """Tables for this observation's length, flagged samples; flags the trimmed ends."""
        bad = ~good(observation.flags, EXCLUDE_SAMPLE & ~HAS_A_SIGNAL)
        _trim(self, observation)
        observation.tally.count(self.label, "flagged samples bridged before filtering", int(bad.sum()), bad.size)
        if observation.smooth.get("atmosphere") is not None:
            observation.tally.state(self.label, "smooth mean emission", "removed analytically")
        return _planned(self, observation), np.flatnonzero(bad)

    def exec(self, block: Block, state: tuple[HighpassPlan, NDArray[np.intp]]) -> None:
        """Filter the block's rows in place."""
        block.means.pop("signal", None)
        plan, bad = state
        spoilt = plan.apply(block.detdata["signal"], bad)
        block.observation.tally.count(self.label, SPOILT, spoilt)


def _trim(step: HighpassFilter, observation: Observation) -> None:
    """Flag the ends of a scan."""
    n = observation.n_samples
    trimmed = min(round(step.trim * observation.sample_rate), n)
    if 2 * trimmed >= n and trimmed:
        raise PipelineError(
            f"trimming {step.trim:g} s at either end leaves nothing of a scan of {observation.duration:g} s",
            place=f"{step.label}, {observation.name}",
            cure="shorten trim or lengthen the scan",
        )
    observation.flags[:trimmed] |= PROCESSING
    observation.flags[n - trimmed :] |= PROCESSING
    observation.tally.count(step.label, "samples trimmed", 2 * trimmed, n)


def _planned(step: HighpassFilter, observation: Observation) -> HighpassPlan:
    """The plan for a scan's length; says, or refuses, where nothing or little is left."""
    n, rate = observation.n_samples, observation.sample_rate
    plan = plan_highpass(n, step.frequency / rate, step.degree, step.oversampling)
    if plan.cut == 0:
        text = _only(step.degree) if n > 1 + min(step.degree, 1) else f"nothing is left of {n} sample{'s' if n > 1 else ''}"
        observation.tally.state(step.label, f"{observation.name} is shorter than 1/frequency", text)
    elif plan.cut >= n:
        raise PipelineError(
            f"a cut at {step.frequency:g} Hz removes everything: {n} samples at {rate:g} Hz contain no higher frequency",
            place=f"{step.label}, {observation.name}",
            cure=f"choose a frequency below {(n - 1) / n * rate / 2:.6g} Hz, or lengthen the scan",
        )
    return plan


def _only(degree: int) -> str:
    """What is removed from a short scan."""
    return ONLY_A_LINE if degree else ONLY_THE_MEAN
