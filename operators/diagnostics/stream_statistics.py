"""Two streams beside each other: power, gain, correlation and coherence.

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
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zonda.core.pages import html_table
from zonda.core.product import Record
from zonda.core.storage.ecsv import Column
from zonda.core.types import Floats

from .power_spectrum import CHUNK
from .series import unit_of_stream

if TYPE_CHECKING:
    from collections.abc import Sequence

FIGURES = ("rms", "rms_reference", "rms_difference", "correlation", "gain")
"""Figures of each detector."""
ERRORS = ("correlation", "gain")
"""Figures that have a standard error."""
SHARED = 35 / 18
"""Neighbouring frequencies behind a Hann window: 1 + 2 (2/3)^2 + 2 (1/6)^2."""


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
            return np.asarray(np.abs(self.cross) ** 2 / (self.power * self.reference), np.float64)

    def rest(self, gain: float) -> Floats:
        """P_e of x - gain y; P_d for 1."""
        rest = self.power + gain**2 * self.reference - 2 * gain * self.cross.real
        return np.asarray(np.maximum(rest, 0.0), np.float64)


def pair(x: Floats, y: Floats, sample_rate: float, length: int) -> Pair:
    """Spectra and cross-spectrum of two series (n_samp,), equation (1), in segments of ``length``
    samples at ``sample_rate`` [Hz].
    """
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    line = np.arange(length) - (length - 1) / 2
    views = [np.lib.stride_tricks.sliding_window_view(v, length)[:: length // 2] for v in (x, y)]
    power, cross = np.zeros((2, length // 2 + 1)), np.zeros(length // 2 + 1, np.complex128)
    for first in range(0, len(views[0]), CHUNK):
        parts = []
        for view in views:
            part = view[first : first + CHUNK]
            slope = np.einsum("st,t->s", part, line) / (line**2).sum()
            parts.append(
                np.fft.rfft(
                    (part - part.mean(axis=1, keepdims=True) - slope[:, None] * line) * window
                )
            )
        power += [(part.real**2 + part.imag**2).sum(axis=0) for part in parts]
        cross += (parts[0] * parts[1].conj()).sum(axis=0)
    scale = np.full(length // 2 + 1, 2 / (len(views[0]) * sample_rate * (window**2).sum()))
    if length % 2 == 0:
        scale[-1] /= 2
    own, other = (power * scale)[:, 1:]
    return Pair(own, other, (cross * scale)[1:])


def figures(found: Pair, step: float, segments: float) -> tuple[list[float], list[float]]:
    """(`FIGURES`, `ERRORS`) of one detector: equations (2), (5), (6). ``step``: df, Hz; NaN where a
    stream is zero.
    """
    x, y, cross = (float(p.sum()) for p in (found.power, found.reference, found.cross.real))
    if not (x > 0 and y > 0):
        return [
            math.sqrt(x * step),
            math.sqrt(y * step),
            math.sqrt((x + y) * step),
            math.nan,
            math.nan,
        ], [math.nan] * 2
    gain, r = cross / y, max(-1.0, min(1.0, cross / math.sqrt(x * y)))
    rest = found.rest(gain)
    shared = SHARED / segments  # df' / df / n, of sums without df

    def log_variance(p: Floats) -> float:
        total = float(p.sum())
        return shared * float((p / total) @ (p / total)) / (1 + 1 / segments) if total > 0 else 0.0

    var_gain = shared * float(rest @ found.reference) / (2 * y * y)
    inner = r * r * (log_variance(rest) + log_variance(found.reference)) / 4 + y / x * var_gain
    rms = [
        math.sqrt(float(p.sum()) * step) for p in (found.power, found.reference, found.rest(1.0))
    ]
    return [*rms, r, gain], [(1 - r * r) * math.sqrt(inner), math.sqrt(var_gain)]


@dataclass
class StreamComparison(Record):
    """Comparison of a stream of a run with another (`stream_statistics`).

    Attributes
    ----------
    stream, reference
        x and y.
    names
        (n_det) detectors.
    values, errors
        (n_det, 5) `FIGURES` and (n_det, 2) standard errors of `ERRORS`, means over the scans.
        `rms_difference` is NaN where the streams have not the same unit.
    frequency
        (n,) Hz, without zero.
    power, coherence
        (3, n) mean spectra P_x, P_y, P_d over detectors and scans; (n,) mean of equation (3).
    segments
        n of one scan.
    label, product
        Of the step; name among the products.
    observations, of_another_length
        Scans in the mean, and those left out since their detectors or frequencies differ.
    """

    stream: str
    reference: str
    names: list[str]
    values: Floats
    errors: Floats
    frequency: Floats
    power: Floats
    coherence: Floats
    segments: float
    label: str
    product: str = "stream_comparison"
    observations: int = 1
    of_another_length: int = 0

    @classmethod
    def of_pairs(
        cls,
        pairs: Sequence[Pair],
        frequency: Floats,
        segments: float,
        names: list[str],
        what: tuple[str, str, str, str],
    ) -> StreamComparison:
        """Comparison of one scan, from the spectra of each detector; ``what``: stream, reference,
        label, product.
        """
        found = [figures(p, float(frequency[0]), segments) for p in pairs]
        values, errors = (np.array(rows, np.float64) for rows in zip(*found, strict=True))
        power = np.mean([(p.power, p.reference, p.rest(1.0)) for p in pairs], axis=0)
        if unit_of_stream(what[0]) != unit_of_stream(what[1]):
            values[:, FIGURES.index("rms_difference")] = power[2] = np.nan
        coherence = np.mean([p.coherence for p in pairs], axis=0)
        return cls(
            what[0],
            what[1],
            names,
            values,
            errors,
            frequency,
            power,
            coherence,
            segments,
            what[2],
            what[3],
        )

    def __iadd__(self, other: StreamComparison) -> StreamComparison:
        """The mean of all scans, each with the same weight."""
        self.of_another_length += other.of_another_length
        if self.names != other.names or self.frequency.shape != other.frequency.shape:
            self.of_another_length += other.observations
            return self
        n, m = self.observations, other.observations
        for name in ("values", "power", "coherence"):
            setattr(self, name, (getattr(self, name) * n + getattr(other, name) * m) / (n + m))
        self.errors = np.hypot(self.errors * n, other.errors * m) / (n + m)
        self.observations = n + m
        return self

    def over_detectors(self, figure: str) -> tuple[float, float, float]:
        """(mean over detectors, their standard deviation, standard error of one detector or NaN) of
        one of `FIGURES`.
        """
        values = self.values[:, FIGURES.index(figure)]
        scatter = float(values.std(ddof=1)) if values.size > 1 else math.nan
        error = float(self.errors[:, ERRORS.index(figure)].mean()) if figure in ERRORS else math.nan
        return float(values.mean()), scatter, error

    @property
    def bias(self) -> Floats:
        """(n,) of the coherence, equation (4)."""
        return np.asarray((1 - self.coherence) ** 2 / self.segments, np.float64)

    def columns(self) -> list[Column]:
        """The table of the spectra."""
        x, y, d = self.power
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = x / y
        units = [
            {"K_RJ": "K2 / Hz", "m": "m2 / Hz"}.get(unit_of_stream(n), "1 / Hz")
            for n in (self.stream, self.reference)
        ]
        return [
            Column("frequency", self.frequency, "Hz", ""),
            Column("power", x, units[0], f"of {self.stream}, mean over detectors and scans"),
            Column("power_reference", y, units[1], f"of {self.reference}"),
            Column(
                "power_difference",
                d,
                units[0],
                f"of {self.stream} - {self.reference}; nan: not the same unit",
            ),
            Column("ratio", ratio, "", "power / power_reference"),
            Column(
                "coherence",
                self.coherence,
                "",
                "|P_xy|^2 / (P_x P_y), mean over detectors and scans",
            ),
            Column(
                "coherence_bias",
                self.bias,
                "",
                "(1 - C)^2 / n: expected excess of the coherence, not subtracted",
            ),
        ]

    def detector_columns(self) -> list[Column]:
        """The table of the figures of each detector."""
        unit = {"K_RJ": "K", "m": "m"}
        own, other = (unit.get(unit_of_stream(name), "") for name in (self.stream, self.reference))
        rows = [Column("detector", self.names, "", "")]
        for name, kind, text in (
            ("rms", own, f"of {self.stream}, faster than a segment"),
            ("rms_reference", other, f"of {self.reference}"),
            ("rms_difference", own, "nan: not the same unit"),
            ("correlation", "", "coefficient of correlation"),
            ("gain", "", f"of {self.stream} on {self.reference}: least squares"),
        ):
            rows.append(Column(name, self.values[:, FIGURES.index(name)], kind, text))
            if name in ERRORS:
                rows.append(
                    Column(
                        f"{name}_error", self.errors[:, ERRORS.index(name)], "", "standard error"
                    )
                )
        return rows

    def lines(self) -> list[tuple[str, str]]:
        """(figure, mean and scatter over detectors)."""
        found = []
        for figure in FIGURES:
            mean, scatter, error = self.over_detectors(figure)
            unit = (
                f" {unit_of_stream(self.reference if figure == 'rms_reference' else self.stream)}"
                if "rms" in figure
                else ""
            )
            text = f"{mean:.4g}{unit.rstrip()}"
            text += f" +- {error:.2g}" if math.isfinite(error) else ""
            text += f", scatter over detectors {scatter:.2g}" if math.isfinite(scatter) else ""
            found.append((figure.replace("_", " of the ") if "rms_" in figure else figure, text))
        return found

    def _repr_html_(self) -> str:
        return html_table(f"{self.stream} and {self.reference}", self.lines())
