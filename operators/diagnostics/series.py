"""Base of steps that measure time streams, and their products: power spectra, modes, the streams of
a few detectors; the step `TimeStreams`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import Field

from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.operator import Operator
from zonda.core.output import publish
from zonda.core.product import Record
from zonda.core.signal import is_stream
from zonda.core.storage.table_files import Column
from zonda.core.stream import StreamName, streams_asked, streams_needed
from zonda.core.tables import html_table
from zonda.core.types import Floats, Integers


class StreamDiagnostic(Operator):
    """Base of steps that measure time streams. Each adds up a `Series` over the scans, which states
    its own tables and lines of the log.
    """

    def asked(self) -> Sequence[str] | None:
        """Streams that the step reads; None: `signal` and all components."""
        return ("signal",)

    @property
    def requires(self) -> frozenset[str]:
        """`signal`, and streams of other steps."""
        return streams_needed(self.asked())

    @property
    def optional(self) -> frozenset[str]:
        """Components among the streams."""
        return streams_asked(self.asked())

    def check(self, data: Data) -> list[str]:
        """Refuse streams that no step makes."""
        known = {*data.made, "signal"}
        for name in (self.asked() or ()) if data.made else ():
            if name.partition("/")[0] not in known:
                raise no_stream(name, filter(is_stream, known), self.label)
        return []

    def finalize(self, data: Data) -> None:
        """Make the product, state its values, and write its tables."""
        found: Series | None = data.take(self.label)
        if found is not None:
            if found.left_out:
                data.log.count(self.label, found.left_out, found.of_another_length)
            for name, text in found.lines():
                data.log.state(self.label, name, text)
            key = key_of(self, found.usual)
            publish(data, key, found, found.tables(), **found.meta(), SCANS=found.observations)


@dataclass(kw_only=True)
class Series(Record):
    """Base of products of streams: quantities along frequency or time, over one or several scans.

    Attributes
    ----------
    usual
        Name among the products of one whose step has no name of its own.
    left_out
        Words of the log for the number of scans that are not `alike`; empty: all scans are.
    means
        Names of fields, arrays or mappings of arrays, that are means over the scans.
    observations, of_another_length
        Number of scans in the means, and of those left out because they are not `alike`.
    """

    usual: ClassVar[str]
    left_out: ClassVar[str] = ""
    means: ClassVar[tuple[str, ...]] = ()

    observations: int = 1
    of_another_length: int = 0

    def alike(self, other: Self) -> bool:
        """True if the two can be averaged."""
        return True

    def __iadd__(self, other: Self) -> Self:
        """The mean of all scans, each with the same weight."""
        self.of_another_length += other.of_another_length
        if not self.alike(other):
            self.of_another_length += other.observations
            return self
        n = self.observations
        m = other.observations
        self.observations = n + m
        for name in self.means:
            own = getattr(self, name)
            more = getattr(other, name)
            if isinstance(own, dict):
                mean: Any = {k: (own[k] * n + more[k] * m) / (n + m) for k in own if k in more}
            else:
                mean = (own * n + more * m) / (n + m)
            setattr(self, name, mean)
        return self

    def lines(self) -> list[tuple[str, str]]:
        """Values that are stated in the log: name, and text."""
        return []

    def tables(self) -> dict[str, list[Column]]:
        """Tables to write, by what is appended to the product's name in the name of the file."""
        return {}

    def meta(self) -> dict[str, Any]:
        """Metadata of the tables."""
        return {}


@dataclass
class Spectrum(Series):
    """Mean one-sided power spectral densities of time streams.

    Attributes
    ----------
    frequency
        (n,) Hz, without zero.
    psd
        (n,) per stream, K_RJ^2/Hz on the calibrated sky (`transmission`: relative, 1/Hz).
    averages
        Equivalent number of independent periodograms in each value: its relative standard error is
        averages^-1/2 where detectors are independent.
    white_level
        2 <NET^2> of the detectors used, K_RJ^2/Hz: the level of white noise; 0 where none is
        simulated.
    label
        Of the step that measured it.
    detectors
        How many were averaged.
    closed_forms
        (n,) per component: what the law that was simulated promises; where one is known.
    """

    usual = "spectrum"
    left_out = "scans of another length left out of the mean spectrum"
    means = ("psd", "closed_forms", "white_level")

    frequency: Floats
    psd: dict[str, Floats]
    averages: float
    white_level: float
    label: str
    detectors: int
    closed_forms: dict[str, Floats] = field(default_factory=dict)

    def alike(self, other: Self) -> bool:
        """True where streams and frequencies are the same."""
        f = self.frequency
        g = other.frequency
        same = f.shape == g.shape and np.allclose(f, g, rtol=1e-12)
        return self.psd.keys() == other.psd.keys() and same

    def __iadd__(self, other: Self) -> Self:
        """The mean of all scans; the periodograms of all count."""
        if self.alike(other):
            self.averages = self.averages + other.averages
            self.detectors = other.detectors
        return super().__iadd__(other)

    def regimes(self) -> list[tuple[str, float, float]]:
        """(component, lowest, highest frequency [Hz]) where one of atmosphere, 1/f and white noise
        dominates: closed forms.

        Empty where there are not two of them.
        """
        laws: dict[str, Floats] = {
            name: self.closed_forms[name]
            for name in ("atmosphere", "pink")
            if name in self.closed_forms
        }
        if self.white_level > 0 and {"white", "signal"} & set(self.psd):
            laws["white"] = np.full(self.frequency.size, self.white_level)
        if len(laws) < 2:
            return []
        names = list(laws)
        f = self.frequency
        largest = np.argmax(np.array(list(laws.values())), axis=0)
        cuts = [0, *(np.flatnonzero(np.diff(largest)) + 1).tolist(), f.size]
        ends = [float(f[0]), *(math.sqrt(f[k - 1] * f[k]) for k in cuts[1:-1]), float(f[-1])]
        return [
            (names[largest[k]], low, high)
            for k, low, high in zip(cuts[:-1], ends[:-1], ends[1:], strict=True)
        ]

    def knee(self) -> float | None:
        """Highest frequency at which the pink part exceeds the white one [Hz]; None where it never
        does or one is absent.
        """
        if not {"pink", "white"} <= set(self.psd):
            return None
        pink = self.psd["pink"]
        white = self.psd["white"]
        found = crossing(self.frequency, pink, white)
        return None if isinstance(found, str) else found[0]


BINS, NEAR = 30, 1.5
"""Bins of two spectra that cross; the factor in frequency within which their slope is taken."""
CORRELATED = 35 / 18
"""c of equation (1): correlation of neighbouring frequencies through Welch's Hann window."""


def slope(x: Floats, y: Floats) -> tuple[float, float]:
    """Least-squares slope of y (n,) over x and its standard error, n > 2:

    b = sum (x - <x>) (y - <y>) / sum (x - <x>)^2,
    sigma_b^2 = c s^2 / sum (x - <x>)^2,   s^2 the variance of the residuals             (1)
    """
    spread = x - x.mean()
    squares = float(spread @ spread)
    b = float(spread @ y) / squares
    rest = y - y.mean() - b * spread
    return b, math.sqrt(CORRELATED * float(rest @ rest) / (x.size - 2) / squares)


def crossing(frequency: Floats, upper: Floats, lower: Floats) -> tuple[float, float] | str:
    """Highest frequency f_x at which a spectrum exceeds another, and its standard error, Hz; a text
    where the two do not cross.

    Spectra are averaged in `BINS` equal bins in ln f. With the residuals s and the slope d of the
    logarithm of their ratio within a factor `NEAR`,

        ln f_x: zero of the line through both bins,   sigma_ln f = (c / n)^(1/2) s / |d|     (2)
    """
    good = (upper > 0) & (lower > 0)
    f = np.log(frequency[good])
    ratio = np.log(upper[good] / lower[good])
    reach = float(np.ptp(f)) if f.size > 1 else 1.0
    number = np.clip((BINS * (f - f.min(initial=np.inf)) / reach).astype(int), 0, BINS - 1)
    count = np.bincount(number, minlength=BINS)
    used = count > 0
    middle = np.bincount(number, f, BINS)[used] / count[used]
    above, below = (np.bincount(number, part[good], BINS)[used] for part in (upper, lower))
    mean = np.log(above / below)
    higher = np.flatnonzero(mean > 0)
    if not higher.size or higher[-1] + 1 == mean.size:
        return "exceeds everywhere" if higher.size else "nowhere exceeds"
    k = int(higher[-1])
    at = float(np.interp(0.0, [-mean[k], -mean[k + 1]], middle[[k, k + 1]]))
    near = abs(f - at) <= math.log(NEAR)
    if np.count_nonzero(near) < 4:
        return math.exp(at), math.nan
    b, error = slope(f[near], ratio[near])
    scatter = error * float(np.std(f[near]))  # (c / n)^(1/2) s
    return math.exp(at), math.exp(at) * scatter / abs(b) if b else math.nan


@dataclass
class TimeStream(Series):
    """Streams of a few detectors of one scan.

    Attributes
    ----------
    seconds
        (n_samp,) s since the scan's start.
    streams
        (n_det, n_samp) K_RJ each, mean included.
    names
        (n_det) detector names.
    observation, label
        Name of the scan; the step at which they were taken.
    """

    usual = "time_streams"

    seconds: Floats
    streams: dict[str, Floats]
    names: list[str]
    observation: str
    label: str


def key_of(operator: Operator, usual: str) -> str:
    """Name of an operator's product: ``usual``, or the operator's own where it has one."""
    own = operator.label != type(operator).__name__
    return operator.name or (operator.label if own else usual)


def spread_evenly(observation: Observation, most: int) -> Integers:
    """At most ``most`` detectors, chosen evenly among those not flagged."""
    usable = np.flatnonzero(observation.good_detectors)
    ends = np.linspace(0, max(0, usable.size - 1), min(usable.size, most))
    return usable[np.unique(ends.round().astype(np.int64))]


def count_flagged(observation: Observation, place: str, what: str) -> None:
    """Count the flagged samples of a scan that ``what`` includes."""
    if flagged := int(np.count_nonzero(~observation.good_samples)):
        told = f"flagged samples that {what}"
        observation.log.count(place, told, flagged, observation.n_samples)


def no_stream(name: str, have: Iterable[str], place: str) -> PipelineError:
    """Error of a stream that is not there."""
    cure = f"choose from: {', '.join(sorted(have))}"
    return PipelineError(f"there is no stream {name!r} at this step", place=place, cure=cure)


def kinds_of_maps(data: Data) -> dict[str, str]:
    """In `Operator.check`: the kind of each map that will be made, by its product: its projection,
    HEALPix, or hits.
    """
    return {
        str(layout["product"]): str(layout["kind"])
        for layout in data.layouts.values()
        if "kind" in layout
    }


def check_map(data: Data, name: str, place: str) -> None:
    """In `Operator.check`: PipelineError where no step makes the map of this name, of whatever
    signal and plane.
    """
    base = name.rpartition("/")[2]
    known = {*kinds_of_maps(data), *data.made, *({"input"} if "sky" in data.made else ())}
    if (
        data.made
        and base.partition(".")[0] not in known
        and re.sub(r"_([IQUPEB]|half_difference)$", "", base) not in known
    ):
        cure = f"name one of these: {', '.join(kinds_of_maps(data)) or 'none is made'}"
        raise PipelineError(f"there is no map {name!r}", place=place, cure=cure)


def plane_key(key: str, plane: str) -> str:
    """Name of a product of I, Q or U: ``key``, ``key_Q``, ``key_U``."""
    return key if plane == "I" else f"{key}_{plane}"


@dataclass
class Modes(Series):
    """Principal components of the detectors' streams (`components`).

    Attributes
    ----------
    values
        (n_scan, n) leading singular values / (detectors x delays x samples)^1/2, `unit`; zeros
        behind the last.
    energy
        (n_scan,) sum of the squares of all.
    seconds, streams
        (n_samp,) and (m, n_samp): the leading modes in time, of the first scan; NaN at flagged
        samples.
    vectors
        (m, n_det (delays + 1)): the leading modes over detectors (and delays, the first detectors
        first), of unit length.
    names
        (n_det) detectors.
    delays, delay
        Number of delays, and each in s; 0: instantaneous.
    unit
        Of the values: K_RJ; empty where detectors were divided by their rms.
    observation, label
        Name of the first scan; the step at which they were taken.
    """

    usual = "modes"

    values: Floats
    energy: Floats
    seconds: Floats
    streams: Floats
    vectors: Floats
    names: list[str]
    delays: int
    delay: float
    unit: str
    observation: str
    label: str

    def __iadd__(self, other: Self) -> Self:
        """Values of all scans; streams and vectors of the first."""
        self.values = np.concatenate([self.values, other.values])
        self.energy = np.concatenate([self.energy, other.energy])
        return super().__iadd__(other)

    @property
    def detectors(self) -> int:
        """Number of detectors used."""
        return len(self.names)

    @property
    def shares(self) -> Floats:
        """(n,) mean over the scans of each mode's share of the variance."""
        return np.asarray((self.values**2 / self.energy[:, None]).mean(axis=0))

    @property
    def error(self) -> Floats:
        """(n,) standard error of `shares` from their scatter over scans; NaN for one scan."""
        each = self.values**2 / self.energy[:, None]
        n = len(each)
        return each.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else np.full(each.shape[1], np.nan)

    def tables(self) -> dict[str, list[Column]]:
        """The singular values, the largest first; and the leading modes in time."""
        used = self.values.any(axis=0)
        share = self.shares[used]
        rms = np.sqrt((self.values[:, used] ** 2).mean(axis=0))
        error = "standard error of share from its scatter over scans; nan: one scan"
        before = "share of this mode and those before"
        values = [
            Column("mode", np.arange(1, share.size + 1), "", "the largest first"),
            Column("singular_value", rms, self._fits, "/ sqrt(rows x samples), rms over the scans"),
            Column("share", share, "", "of the variance, mean over the scans"),
            Column("error", self.error[used], "", error),
            Column("cumulative", np.cumsum(share), "", before),
        ]
        text = "v(t) = sum over detectors (and delays) of u A"
        streams = [
            Column("seconds", self.seconds, "s", f"since the start of {self.observation}"),
            *(Column(f"mode_{k}", row, self._fits, text) for k, row in enumerate(self.streams, 1)),
        ]
        return {"": values, "_streams": streams}

    def meta(self) -> dict[str, Any]:
        """The scan whose streams are in the table."""
        return {"SCAN": self.observation}

    @property
    def _fits(self) -> str:
        return "K" if self.unit == "K_RJ" else ""

    def _repr_html_(self) -> str:
        shares = enumerate(self.shares[:8], 1)
        rows = [(f"mode {k}", f"{100 * share:.3g} %") for k, share in shares if share > 0]
        return html_table(f"Modes of {self.detectors} detectors", rows)


class TimeStreams(StreamDiagnostic):
    """Streams of a few detectors of one scan at this step, for a picture: product ``time_streams``.

    Components (`sky`, `white`, those of plugins ...) are at the detector, before the calibration;
    `signal` is the calibrated sum. `signal` holds the mean emission of the atmosphere, `atmosphere`
    is the fluctuation about it. Further streams are those that a step above makes, e.g. `pwv`,
    `opacity` and `path_delay` (`AtmosphereLayers.outputs`).
    """

    provides = frozenset({"time_streams"})
    knows_means = True

    streams: list[StreamName] = Field(["signal"], min_length=1)
    """Streams to keep; components that are absent at this step are skipped and counted."""
    detectors: int = Field(3, ge=1, le=64)
    """Number of detectors, chosen evenly."""
    observation: int = Field(0, ge=0)
    """Which scan, counted from 0."""

    def asked(self) -> list[str]:
        """Streams of the parameter `streams`."""
        return self.streams

    def check(self, data: Data) -> list[str]:
        """Refuse a scan that is not there, once the telescope is pointed."""
        if data.observations:
            data.check_scan(self.observation, self.label)
        return []

    def observe(self, data: Data) -> None:
        self.check(data)

    def prepare(self, observation: Observation) -> TimeStream | None:
        if observation.index != self.observation:
            return None
        n = observation.n_detectors
        shape = min(n, self.detectors), observation.n_samples
        chosen = np.linspace(0, n - 1, shape[0]).round().astype(int)
        names = [observation.focalplane.names[d] for d in chosen]
        streams: dict[str, Floats] = {name: np.full(shape, np.nan) for name in self.streams}
        return TimeStream(observation.seconds, streams, names, observation.name, self.label)

    def exec(self, block: Block, state: TimeStream | None) -> None:
        if state is None:
            return
        for k, detector in enumerate(state.names):
            d = block.observation.focalplane.names.index(detector)
            if block.detectors.start <= d < block.detectors.stop:
                for name in state.streams.keys() & block.detdata.keys():
                    values = block.detdata[name][d - block.detectors.start].astype(np.float64)
                    if name in block.means:
                        values += block.means[name].evaluate(slice(d, d + 1), block.samples)[0]
                    state.streams[name][k, block.samples] = values

    def collect(self, data: Data, observation: Observation, state: TimeStream | None) -> None:
        if state is None:
            return
        for name in [s for s, values in state.streams.items() if np.isnan(values).all()]:
            del state.streams[name]
            observation.log.count(self.label, f"stream {name} is absent at this step", 1)
        data.add(self.label, state)
