"""`CompareStreams`: a stream of a run beside another one.

With X, Y the Fourier transforms of the segments of two streams x, y (Welch 1967: they overlap by
half, are freed of a straight line and weighted by a Hann window), n the equivalent number of
independent segments, < > their mean, and one-sided spectra per Hz

    P_x = <|X|^2>,   P_y = <|Y|^2>,   P_xy = <X Y^*>,   P_d = P_x + P_y - 2 Re P_xy,   (1)

    sigma_x^2 = sum P_x df,   g = Re sum P_xy / sum P_y,
    r = Re sum P_xy / (sum P_x sum P_y)^1/2,   (2)

    C(f) = |P_xy|^2 / (P_x P_y).                                                                 (3)

All sums are over the frequencies above zero: what is slower than a segment is not in them. The
estimate of C is biased,

    <C> - C = (1 - C)^2 / n                                                                      (4)

to first order in 1/n (Carter, Knapp & Nuttall 1973; Bendat & Piersol 2010, section 9.2):
independent streams have 1/n, a single segment has 1. The mean over detectors and scans has the same
bias. With the residual e = x - g y of the spectrum P_e = P_x + g^2 P_y - 2 g Re P_xy, Gaussian
streams, and df' = 35/18 df for what the window shares between neighbouring frequencies,

    var g = df' sum P_e P_y / (2 n (sum P_y)^2),
    var ln sigma^2 = df' sum P^2 / (n (sum P)^2) / (1 + 1/n),   (5)
    var r = (1 - r^2)^2
            (r^2 (var ln sigma_e^2 + var ln sigma_y^2) / 4 + (sigma_y / sigma_x)^2 var g)  (6)

(first-order propagation of r^-2 = 1 + sigma_e^2 / (g sigma_y)^2; of white streams of N samples it
is (1 - r^2)^2 / N).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Seconds
from zonda.core.data import Block, Data, Observation
from zonda.core.storage.table_files import Column
from zonda.core.stream import AnyStream, check_signals, unit_of_stream
from zonda.core.tables import html_table
from zonda.core.types import Floats

from .power_spectrum import Chosen, Welch, welch_of
from .series import (
    Series,
    StreamDiagnostic,
    count_flagged,
    spread_evenly,
)

LEAST_SEGMENTS = 8
"""A segment is at most this part of the scan: with a single one the coherence is 1 whatever the
streams.
"""
VALUES = ("rms", "rms_reference", "rms_difference", "correlation", "gain")
"""Values of each detector; the last two have standard errors."""
SHARED = 35 / 18
"""Neighbouring frequencies behind a Hann window: 1 + 2 (2/3)^2 + 2 (1/6)^2."""


class CompareStreams(StreamDiagnostic):
    """Comparison of a stream with another at this step: rms, correlation, gain, ratio of spectra
    and coherence.

    Both are referred to the calibrated sky as in `PowerSpectrum`, and freed of a straight line in
    each segment: what is slower than a segment is not compared. `signal` holds the mean emission of
    the atmosphere, `atmosphere` is the fluctuation about it. Makes the product
    ``stream_comparison`` (a `StreamComparison`), or one under this step's own name where it has
    one; where there is an output folder, it is written there as tables (ECSV), by frequency and by
    detector. `Plots` and `Report` show it.

    Raises `PipelineError` where a stream is absent at this step.
    """

    provides = frozenset({"stream_comparison"})
    knows_means = True
    couples = "time"

    stream: AnyStream = "signal"
    """Which stream: `signal`, that of a signal of `runs` (`signal/noiseless`), a component, or
    another that a step above makes (`pwv`)."""
    reference: AnyStream = "atmosphere"
    """What it is compared with."""
    detectors: int = Field(16, ge=1)
    """Number of detectors, chosen evenly among those not flagged."""
    segment: Seconds = quantity("16 s", gt=0)
    """Length of Welch's segments, at most an eighth of the scan. Shortened to a number of samples
    that transforms quickly.
    """

    @model_validator(mode="after")
    def _two(self) -> Self:
        if self.stream == self.reference:
            raise ValueError("stream and reference are the same")
        return self

    def asked(self) -> tuple[str, str]:
        """The stream and its reference."""
        return self.stream, self.reference

    def prepare(self, observation: Observation) -> Chosen:
        check_signals(self.asked(), observation, self.label)
        count_flagged(observation, self.label, "the comparison includes")
        welch = welch_of(observation, self.segment, observation.n_samples // LEAST_SEGMENTS)
        return Chosen(spread_evenly(observation, self.detectors), welch)

    def exec(self, block: Block, state: Chosen) -> None:
        for detector, streams in state.streams(block, self.asked(), self.label):
            x, y = streams.values()
            if np.isfinite(x).all() and np.isfinite(y).all():
                assert state.welch is not None
                state.found[detector] = pair(x, y, state.welch)
            else:
                block.observation.log.count(
                    self.label,
                    "detectors left out for samples that are not finite",
                    1,
                )

    def collect(self, data: Data, observation: Observation, state: Chosen) -> None:
        """Compare in the order of the detectors."""
        every = sorted(state.found)
        if state.welch is None or not every:
            why = (
                "too short to compare streams"
                if state.welch is None
                else "without a detector to compare"
            )
            observation.log.count(self.label, f"scans {why}", 1)
            return
        names = [observation.focalplane.names[d] for d in every]
        pairs = [state.found[d] for d in every]
        found = StreamComparison.of_pairs(self, pairs, state.welch, names)
        data.add(self.label, found)


@dataclass(frozen=True)
class Pair:
    """Spectra and cross-spectrum of one detector's two streams, equation (1): (n,) each, per Hz."""

    power: Floats
    reference: Floats
    cross: NDArray[np.complex128]

    @property
    def coherence(self) -> Floats:
        """Equation (3); NaN where a spectrum is zero."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.abs(self.cross) ** 2 / (self.power * self.reference)

    def rest(self, gain: float) -> Floats:
        """P_e of x - gain y; P_d for 1."""
        rest = self.power + gain**2 * self.reference - 2 * gain * self.cross.real
        return np.maximum(rest, 0.0)


def pair(x: Floats, y: Floats, welch: Welch) -> Pair:
    """Spectra and cross-spectrum of two series (n_samp,), equation (1)."""
    both = zip(welch.transforms(x), welch.transforms(y), strict=True)
    found = welch.density(np.stack([abs(a) ** 2, abs(b) ** 2, a * b.conj()]) for a, b in both)
    return Pair(found[0].real, found[1].real, found[2])


def values_of(found: Pair, step: float, segments: float) -> tuple[Floats, Floats]:
    """`VALUES` (5,) of one detector and their standard errors: equations (2), (5), (6). ``step``:
    df, Hz; NaN where a stream is zero.
    """
    values, errors = np.full((2, len(VALUES)), math.nan)
    parts = found.power, found.reference, found.rest(1.0)
    values[:3] = [math.sqrt(float(p.sum()) * step) for p in parts]
    x, y, cross = (float(p.sum()) for p in (found.power, found.reference, found.cross.real))
    if not (x > 0 and y > 0):
        return values, errors
    gain = cross / y
    r = max(-1.0, min(1.0, cross / math.sqrt(x * y)))
    rest = found.rest(gain)
    shared = SHARED / segments  # df' / df / n, of sums without df

    def log_variance(p: Floats) -> float:
        total = float(p.sum())
        return shared * float((p / total) @ (p / total)) / (1 + 1 / segments) if total > 0 else 0.0

    var_gain = shared * float(rest @ found.reference) / (2 * y * y)
    inner = r * r * (log_variance(rest) + log_variance(found.reference)) / 4 + y / x * var_gain
    values[3:] = r, gain
    errors[3:] = (1 - r * r) * math.sqrt(inner), math.sqrt(var_gain)
    return values, errors


@dataclass
class StreamComparison(Series):
    """Comparison of a stream of a run with another.

    Attributes
    ----------
    stream, reference
        x and y.
    label
        Of the step.
    names
        (n_det) detectors.
    values, errors
        (n_det, 5) `VALUES` and their standard errors, means over the scans; NaN where there is
        none, and for `rms_difference` where the streams have not the same unit.
    frequency
        (n,) Hz, without zero.
    power, coherence
        (3, n) mean spectra P_x, P_y, P_d over detectors and scans; (n,) mean of equation (3).
    segments
        n of one scan.
    """

    usual = "stream_comparison"
    left_out = "scans left out: other detectors or length"
    means = ("values", "power", "coherence")

    stream: str
    reference: str
    label: str
    names: list[str]
    values: Floats
    errors: Floats
    frequency: Floats
    power: Floats
    coherence: Floats
    segments: float

    @classmethod
    def of_pairs(
        cls,
        step: CompareStreams,
        pairs: Sequence[Pair],
        welch: Welch,
        names: list[str],
    ) -> StreamComparison:
        """Comparison of one scan, from the spectra of each detector."""
        f = welch.frequency
        segments = welch.independent
        found = np.array([values_of(p, float(f[0]), segments) for p in pairs])
        power = np.mean([(p.power, p.reference, p.rest(1.0)) for p in pairs], axis=0)
        if unit_of_stream(step.stream) != unit_of_stream(step.reference):
            found[:, 0, VALUES.index("rms_difference")] = power[2] = np.nan
        coherence = np.mean([p.coherence for p in pairs], axis=0)
        what = (*step.asked(), step.label, names)
        return cls(*what, found[:, 0], found[:, 1], f, power, coherence, segments)

    def alike(self, other: Self) -> bool:
        """True where detectors and frequencies are the same."""
        return self.names == other.names and self.frequency.shape == other.frequency.shape

    def __iadd__(self, other: Self) -> Self:
        """The mean of all scans, each with the same weight."""
        if self.alike(other):
            n = self.observations
            m = other.observations
            self.errors = np.hypot(self.errors * n, other.errors * m) / (n + m)
        return super().__iadd__(other)

    def over_detectors(self, name: str) -> tuple[float, float, float]:
        """(mean over detectors, their standard deviation, standard error of one detector or NaN) of
        one of `VALUES`.
        """
        k = VALUES.index(name)
        values = self.values[:, k]
        scatter = float(values.std(ddof=1)) if values.size > 1 else math.nan
        return float(values.mean()), scatter, float(self.errors[:, k].mean())

    @property
    def bias(self) -> Floats:
        """(n,) of the coherence, equation (4)."""
        return (1 - self.coherence) ** 2 / self.segments

    def meta(self) -> dict[str, Any]:
        """The streams, and the number of segments."""
        return {"STREAM": self.stream, "REFERENCE": self.reference, "SEGMENTS": self.segments}

    def tables(self) -> dict[str, list[Column]]:
        """The spectra, and the values of each detector."""
        return {"": self._spectra(), "_detectors": self._of_detectors()}

    def _spectra(self) -> list[Column]:
        x, y, d = self.power
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = x / y
        own, other = (
            {"K_RJ": "K2 / Hz", "m": "m2 / Hz"}.get(unit_of_stream(n), "1 / Hz")
            for n in (self.stream, self.reference)
        )
        less = f"of {self.stream} - {self.reference}; nan: not the same unit"
        coherence = "|P_xy|^2 / (P_x P_y), mean over detectors and scans"
        bias = "(1 - C)^2 / n: expected excess of the coherence, not subtracted"
        return [
            Column("frequency", self.frequency, "Hz", ""),
            Column("power", x, own, f"of {self.stream}, mean over detectors and scans"),
            Column("power_reference", y, other, f"of {self.reference}"),
            Column("power_difference", d, own, less),
            Column("ratio", ratio, "", "power / power_reference"),
            Column("coherence", self.coherence, "", coherence),
            Column("coherence_bias", self.bias, "", bias),
        ]

    def _of_detectors(self) -> list[Column]:
        unit = {"K_RJ": "K", "m": "m"}
        own, other = (unit.get(unit_of_stream(name), "") for name in (self.stream, self.reference))
        kinds = {
            "rms": (own, f"of {self.stream}, faster than a segment"),
            "rms_reference": (other, f"of {self.reference}"),
            "rms_difference": (own, "nan: not the same unit"),
            "correlation": ("", "coefficient of correlation"),
            "gain": ("", f"of {self.stream} on {self.reference}: least squares"),
        }
        rows = [Column("detector", self.names, "", "")]
        for k, (name, about) in enumerate(kinds.items()):
            rows.append(Column(name, self.values[:, k], *about))
            if "rms" not in name:
                rows.append(Column(f"{name}_error", self.errors[:, k], "", "standard error"))
        return rows

    def lines(self) -> list[tuple[str, str]]:
        """(name, mean and scatter over detectors)."""
        found = []
        for name in VALUES:
            mean, scatter, error = self.over_detectors(name)
            of = self.reference if name == "rms_reference" else self.stream
            text = f"{mean:.4g}{f' {unit_of_stream(of)}' if 'rms' in name else ''}".rstrip()
            text += f" +- {error:.2g}" if math.isfinite(error) else ""
            text += f", scatter over detectors {scatter:.2g}" if math.isfinite(scatter) else ""
            found.append((name.replace("rms_", "rms of the "), text))
        return found

    def _repr_html_(self) -> str:
        return html_table(f"{self.stream} and {self.reference}", self.lines())
