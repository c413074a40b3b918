"""High-pass filters of whole scans: a brick wall without phase (`brick_wall`), or the causal Bessel
filter of `bessel`.
"""

from __future__ import annotations

from functools import partial
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Hertz, Seconds
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.flags import TRIMMED, has_a_signal
from zonda.core.operator import Operator
from zonda.core.types import AnyFloats, Floats

from .baseline import Fit, polynomials
from .bessel import BesselPlan, sections
from .brick_wall import HighpassPlan, first_kept, plan_highpass
from .rows import SPOILT, in_double
from .source_mask import Inside, SourceMask, check_mask, check_masks, filter_outside

ONLY_THE_MEAN, ONLY_A_LINE = "only the mean is removed", "only the mean and a line are removed"


class State(NamedTuple):
    """Filter, flagged samples and source mask for `HighpassFilter.exec`."""

    plan: HighpassPlan | BesselPlan
    bad: NDArray[np.intp]
    inside: Inside | None


class HighpassParameters(Operator):
    """Parameters of `HighpassFilter`."""

    frequency: Hertz = quantity("0.08 Hz", gt=0)
    """Cutoff: lower frequencies are removed (`brick_wall`), or attenuated as the fourth power of
    the frequency (`bessel`).
    """
    response: Literal["brick_wall", "bessel"] = "brick_wall"
    """Brick wall without phase, or a causal Bessel filter with four poles."""
    degree: int | None = Field(3, ge=0, le=3)
    """Degree of the polynomial fitted to each detector's scan and removed first (1: a line; null:
    none, for `bessel` alone).
    """
    trim: Seconds = quantity("0 s", ge=0)
    """Time at either end of each scan that is flagged."""
    oversampling: float = Field(24.0, ge=8, le=1000)
    """Of the brick wall: coarse knots per cut cycle (M / (K / 2)); the low part's error at the cut
    is about oversampling^-4.
    """
    mask: SourceMask | None = None
    """Source whose samples are bridged to find the slow part, which is subtracted there too:
    equation (1) of `source_mask`.
    """

    @model_validator(mode="after")
    def _has_a_degree(self) -> HighpassParameters:
        if self.degree is None and self.response == "brick_wall":
            raise ValueError(
                "a brick wall needs a degree of 0 or more; degree: null belongs to response: bessel"
            )
        if self.response == "bessel" and "oversampling" in self.model_fields_set:
            raise ValueError(
                "oversampling belongs to response: brick_wall; the Bessel filter is exact"
            )
        return self


class HighpassFilter(HighpassParameters):
    """High-pass filter of each detector's scan: a brick wall without phase, equations (1) and (2)
    of `brick_wall`, or the causal Bessel filter of the paper's authors (`bessel`).

    The brick wall drops the modelled mean emission that accompanies the signal analytically, before
    anything else; with a `mask`, it acts on all of the signal. A scan that is shorter than 1 /
    `frequency` loses its mean and a line alone; the log says so. A frequency so near the Nyquist
    frequency that nothing of a scan is left is refused.

    The Bessel filter acts on all of the signal, and begins in the state zero: what does not begin
    with zero has a transient of about 1 / `frequency`, which `degree`, `Detrend` and `Taper` lessen
    and `trim` flags.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"

    def check(self, data: Data) -> list[str]:
        """Scans that are shorter than one cycle of the cut. Raises PipelineError where a run would
        find nothing left of one.
        """
        for observation in data.observations:
            place = f"{self.label}, {observation.name}"
            self._trimmed(*observation.sampling, place)
            self._check_cut(*observation.sampling, place)
        check_masks(self.mask, data, self.label)
        short, every = (
            sum(o.duration * self.frequency < 1 for o in data.observations),
            len(data.observations),
        )
        text = (
            f"{short} of {every} scans are shorter than 1/frequency, {1 / self.frequency:g} s:"
            f" {self._short()}"
        )
        return [text] if short else []

    def prepare(self, observation: Observation) -> State:
        """Tables for this observation's length, flagged samples; flags the trimmed ends."""
        fine = has_a_signal(observation.flags)
        self._trim(observation)
        observation.tally.count(
            self.label, "flagged samples bridged before filtering", int((~fine).sum()), fine.size
        )
        inside = self.mask.of(observation) if self.mask else None
        if inside is not None:
            check_mask(inside, observation, f"{self.label}, {observation.name}")
        if self.response == "bessel":
            return State(self._bessel(observation, fine), np.flatnonzero(~fine), inside)
        if observation.smooth.get("atmosphere") is not None and inside is None:
            observation.tally.state(self.label, "smooth mean emission", "removed analytically")
        return State(self._planned(observation), np.flatnonzero(~fine), inside)

    def exec(self, block: Block, state: State) -> None:
        """Filter the block's rows in place."""
        plan, bad, inside = state
        if inside is None and isinstance(plan, HighpassPlan):
            block.means.pop("signal", None)
            block.observation.tally.count(
                self.label, SPOILT, plan.apply(block.detdata["signal"], bad)
            )
            return
        act = plan.apply if isinstance(plan, BesselPlan) else partial(_brick_wall, plan)
        in_double(self.label, block, lambda rows, masked: act(rows, bad, masked), inside)

    def _check_cut(self, n: int, rate: float, place: str) -> None:
        """Raise PipelineError for a cut at which nothing is left of a scan of ``n`` samples."""
        text = (
            f"a cut at {self.frequency:g} Hz removes everything: {n} samples at {rate:g} Hz"
            " contain no higher frequency"
        )
        if self.response == "bessel":
            if self.frequency >= rate / 2:
                raise PipelineError(
                    text, place=place, cure=f"choose a frequency below {rate / 2:.6g} Hz"
                )
        elif first_kept(n, self.frequency / rate) >= n:
            cure = f"choose a frequency below {(n - 1) / n * rate / 2:.6g} Hz, or lengthen the scan"
            raise PipelineError(text, place=place, cure=cure)

    def _bessel(self, observation: Observation, fine: NDArray[np.bool_]) -> BesselPlan:
        """The causal filter of a scan.

        Raises PipelineError for a cutoff at the Nyquist frequency or above.
        """
        rate = observation.sample_rate
        self._check_cut(observation.n_samples, rate, f"{self.label}, {observation.name}")
        trend = (
            None
            if self.degree is None
            else Fit.of(polynomials(observation.n_samples, self.degree), fine)
        )
        return BesselPlan(sections(self.frequency, rate), trend)

    def _trimmed(self, n: int, rate: float, place: str) -> int:
        """Samples at either end that are trimmed of ``n``. Raises PipelineError where nothing is
        left.
        """
        trimmed = min(round(self.trim * rate), n)
        if 2 * trimmed >= n and trimmed:
            text = (
                f"trimming {self.trim:g} s at either end leaves nothing of a scan of {n / rate:g} s"
            )
            raise PipelineError(text, place=place, cure="shorten trim or lengthen the scan")
        return trimmed

    def _trim(self, observation: Observation) -> None:
        """Flag the ends of a scan."""
        n = observation.n_samples
        trimmed = self._trimmed(n, observation.sample_rate, f"{self.label}, {observation.name}")
        observation.flags[:trimmed] |= TRIMMED
        observation.flags[n - trimmed :] |= TRIMMED
        observation.tally.count(self.label, "samples trimmed", 2 * trimmed, n)

    def _planned(self, observation: Observation) -> HighpassPlan:
        """The plan for a scan's length; says, or refuses, where nothing or little is left."""
        n, rate = observation.n_samples, observation.sample_rate
        self._check_cut(n, rate, f"{self.label}, {observation.name}")
        degree = self.degree or 0
        plan = plan_highpass(n, self.frequency / rate, degree, self.oversampling)
        if plan.cut == 0:
            text = (
                self._short()
                if n > 1 + min(degree, 1)
                else f"nothing is left of {n} sample{'s' if n > 1 else ''}"
            )
            observation.tally.state(
                self.label, f"{observation.name} is shorter than 1/frequency", text
            )
        return plan

    def _short(self) -> str:
        """Statement about a scan that is shorter than one cycle of the cut."""
        if self.response == "bessel":
            return "all of it is within the filter's transient"
        return ONLY_A_LINE if self.degree else ONLY_THE_MEAN


def _brick_wall(
    plan: HighpassPlan, rows: Floats, bad: NDArray[np.intp], masked: NDArray[np.bool_] | None
) -> int:
    """Equation (1) of `source_mask` on rows (n_det, N) in place; returns how many samples were not
    finite.
    """

    def act(row: AnyFloats) -> None:
        plan.apply(row[None])

    return sum(
        filter_outside(row, bad, None if masked is None else masked[d], act)
        for d, row in enumerate(rows)
    )
