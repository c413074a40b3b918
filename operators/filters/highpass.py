"""High-pass filters of whole scans: a brick wall without phase (`brick_wall`), or the causal Bessel
filter of the paper's authors.

The mapper of maria 1.0.0 (`maria/utils/signal.py`) filters with ``scipy.signal.bessel(4, 2 f / f_s,
"high")`` in second-order sections and ``scipy.signal.sosfilt``: four poles, normalized so that the
phase at f is half-way (``norm="phase"``), made digital by the bilinear transform. The filter is
causal, so that a source is followed by a trough; its initial state is zero, so that a scan that
does not begin with zero has a transient, which decays within about 1 / f.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Hertz, Seconds
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.flags import TRIMMED, has_a_signal
from zonda.core.types import AnyFloats, Floats, Indices

from .baseline import Fit, polynomials
from .brick_wall import HighpassPlan, first_kept, plan_highpass
from .rows import SPOILT, LinearFilter, Mask, Rows
from .source_mask import Inside, SourceMask, adjoint_outside, filter_outside

ONLY_THE_MEAN = "only the mean is removed"
ONLY_A_LINE = "only the mean and a line are removed"

POLES = 4
"""Of the Bessel filter, as in the authors' code."""


class HighpassFilter(LinearFilter):
    """High-pass filter of each detector's scan: a brick wall without phase, equations (1) and (2)
    of `brick_wall`, or the causal Bessel filter of the paper's authors.

    The brick wall drops the modelled mean emission that accompanies the signal analytically, before
    anything else; with a `mask`, it acts on all of the signal. A scan that is shorter than 1 /
    `frequency` loses its mean and a line alone; the log says so. A frequency so near the Nyquist
    frequency that nothing of a scan is left is refused.

    The Bessel filter acts on all of the signal, and begins in the state zero: what does not begin
    with zero has a transient of about 1 / `frequency`, which `degree`, `Detrend` and `Taper` lessen
    and `trim` flags.
    """

    knows_means = True

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
    trim: Seconds = quantity("0 s", ge=0, examples=["10 s"])
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
    def _one_response(self) -> HighpassFilter:
        if self.degree is None and self.response == "brick_wall":
            raise ValueError(
                "a brick wall needs a degree of 0 or more; degree: null belongs to response: bessel"
            )
        if self.response == "bessel" and "oversampling" in self.model_fields_set:
            raise ValueError(
                "oversampling belongs to response: brick_wall; the Bessel filter is exact"
            )
        return self

    def check(self, data: Data) -> list[str]:
        """Scans that are shorter than one cycle of the cut. Raises PipelineError where a run would
        find nothing left of one.
        """
        super().check(data)
        scans = data.observations
        for scan in scans:
            self._check_length(scan)
        short = sum(scan.duration * self.frequency < 1 for scan in scans)
        text = (
            f"{short} of {len(scans)} scans are shorter than 1/frequency, {1 / self.frequency:g} s:"
            f" {self._short()}"
        )
        return [text] if short else []

    def prepare(self, observation: Observation) -> tuple[Bridged, Inside | None]:
        """Tables for this observation's length, flagged samples; flags the trimmed ends."""
        n = observation.n_samples
        rate = observation.sample_rate
        log = observation.log
        fine = has_a_signal(observation.flags)
        trimmed = self._check_length(observation)
        observation.flags[:trimmed] |= TRIMMED
        observation.flags[n - trimmed :] |= TRIMMED
        log.count(self.label, "samples trimmed", 2 * trimmed, n)
        bad = np.flatnonzero(~fine)
        log.count(self.label, "flagged samples bridged before filtering", bad.size, n)
        inside = self._inside(observation)
        if self.response == "bessel":
            trend = None if self.degree is None else Fit.of(polynomials(n, self.degree), fine)
            return Bridged(causal(self.frequency, rate), bad, trend), inside
        if observation.smooth.get("atmosphere") is not None and inside is None:
            log.state(self.label, "smooth mean emission", "removed analytically")
        degree = self.degree or 0
        plan = plan_highpass(n, self.frequency / rate, degree, self.oversampling)
        if plan.cut == 0:
            left = f"nothing is left of {n} sample{'s' if n > 1 else ''}"
            text = self._short() if n > 1 + min(degree, 1) else left
            log.state(self.label, f"{observation.name} is shorter than 1/frequency", text)
        return Bridged(lambda row: plan.apply(row[None]), bad, plan=plan), inside

    def exec(self, block: Block, state: tuple[Bridged, Inside | None]) -> None:
        """Filter the block's rows in place."""
        bridged, inside = state
        if inside is not None or bridged.plan is None:
            super().exec(block, state)
        else:
            block.means.pop("signal", None)
            spoilt = bridged.plan.apply(block.detdata["signal"], bridged.bad)
            block.observation.log.count(self.label, SPOILT, spoilt)

    def adjoint(self, block: Block, state: Any) -> None:
        """The transpose of `exec`."""
        super().adjoint(block, state)

    def _check_length(self, observation: Observation) -> int:
        """Samples at either end that are trimmed. Raises PipelineError where nothing is left of a
        scan.
        """
        (n, rate), place = observation.sampling, f"{self.label}, {observation.name}"
        trimmed = min(round(self.trim * rate), n)
        if 2 * trimmed >= n and trimmed:
            text = (
                f"trimming {self.trim:g} s at either end leaves nothing of a scan of {n / rate:g} s"
            )
            raise PipelineError(text, place=place, cure="shorten trim or lengthen the scan")
        bessel = self.response == "bessel"
        if self.frequency >= rate / 2 if bessel else first_kept(n, self.frequency / rate) >= n:
            highest = rate / 2
            more = ""
            if not bessel:
                highest = (n - 1) / n * rate / 2
                more = ", or lengthen the scan"
            raise PipelineError(
                f"a cut at {self.frequency:g} Hz removes everything: {n} samples at {rate:g} Hz"
                " contain no higher frequency",
                place=place,
                cure=f"choose a frequency below {highest:.6g} Hz{more}",
            )
        return trimmed

    def _short(self) -> str:
        """Statement about a scan that is shorter than one cycle of the cut."""
        if self.response == "bessel":
            return "all of it is within the filter's transient"
        return ONLY_A_LINE if self.degree else ONLY_THE_MEAN


@dataclass(frozen=True)
class Bridged:
    """A filter ``act`` of one row in place, behind the subtraction of a ``trend``.

    Equation (1) of `source_mask`: the samples ``bad`` and those of a mask are bridged.
    """

    act: Callable[[AnyFloats], object]
    bad: Indices
    trend: Fit | None = None
    plan: HighpassPlan | None = None
    """The brick wall, which without a mask acts on rows of any precision."""

    def remove(self, rows: Rows, masked: Mask | None = None) -> int:
        """Filter rows in float64; see `Removal`."""
        double = rows.double(slice(None), rows.values.shape[1])
        if self.trend is not None:
            self.trend.remove(Rows.of(double), masked)
        masks = [None] * len(double) if masked is None else masked
        pairs = zip(double, masks, strict=True)
        spoilt = sum(filter_outside(row, self.bad, mask, self.act) for row, mask in pairs)
        rows.values[...] = double
        return spoilt

    def adjoint(self, rows: Rows, masked: Mask | None = None) -> None:
        """Transpose of `remove`, of float64 rows in place: of a causal filter that begins at zero,
        the same backwards.
        """
        plan = self.plan
        for d, row in enumerate(rows.values):
            mask = None if masked is None else masked[d]
            if plan is None:
                adjoint_outside(row, self.bad, mask, lambda row: self.act(row[::-1]))
            else:
                adjoint_outside(row, self.bad, mask, lambda row: plan.adjoint(row[None]))
        if self.trend is not None:
            self.trend.adjoint(rows, masked)


def sections(frequency: float, rate: float) -> Floats:
    """(2, 6) second-order sections of the Bessel filter; ``frequency`` below half of the sample
    ``rate``, Hz.
    """
    from scipy.signal import bessel

    return np.asarray(bessel(POLES, 2 * frequency / rate, "high", output="sos"), np.float64)


def causal(frequency: float, rate: float) -> Callable[[AnyFloats], None]:
    """The Bessel filter of a row in place."""
    from scipy.signal import sosfilt

    sos = sections(frequency, rate)

    def act(row: AnyFloats) -> None:
        row[...] = sosfilt(sos, row)

    return act


def amplitude(frequency: Floats, cutoff: float, rate: float) -> Floats:
    """|H| of the Bessel filter at frequencies (n,), Hz; beyond half of the sample ``rate`` that
    there.
    """
    from scipy.signal import sosfreqz

    at = np.minimum(frequency, rate / 2)
    return np.abs(sosfreqz(sections(cutoff, rate), 2 * np.pi * at / rate)[1])
