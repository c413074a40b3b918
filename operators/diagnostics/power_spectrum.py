"""Power spectra of the time streams, referred to the calibrated sky."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Seconds
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.flags import has_a_signal
from zonda.core.operator import Operator
from zonda.core.signal import BUILT_IN, MAIN, TRANSMISSION, Component
from zonda.core.stream_names import StreamName, streams_asked, streams_needed
from zonda.core.types import Floats

from .series import Spectrum, check_streams, count_flagged, key_of, no_stream, spread_evenly

ORDER = ("signal", "atmosphere", "pink", "white", "sky", "transmission")
"""Of spectra in pictures."""


CHUNK = 8
"""Segments that are transformed at a time: numpy works out the roots of unity at every call. It is
slower in float32.
"""


class Welch:
    """One-sided power spectral densities of series of ``n`` samples by Welch's method (1967).

    Segments of ``length`` samples overlap by half, each is freed of its straight line and weighted
    by a Hann window w once:

        P_k = 2 |sum_t w_t x_t e^(-2 pi i k t / L)|^2 / (f_s sum_t w_t^2),   k > 0;
        half of it at k = L/2        (1)

    so that white noise of variance s^2 has P = 2 s^2 / f_s.

    Attributes
    ----------
    frequency
        (length // 2,) Hz, without zero.
    independent
        Equivalent number of independent segments.
    """

    def __init__(self, n: int, sample_rate: float, length: int) -> None:
        w = (
            0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
            if length > 2
            else np.ones(length)
        )
        self._length, self._step = length, max(1, length // 2)
        self._segments = (n - length) // self._step + 1
        self._line = np.arange(length) - (length - 1) / 2
        self._slope = self._line / (self._line**2).sum()
        self._window = w
        self._scale = np.full(length // 2, 2 / (self._segments * sample_rate * (w**2).sum()))
        if length % 2 == 0:
            self._scale[-1] /= 2
        overlap = ((w[: length - length // 2] * w[length // 2 :]).sum() / (w**2).sum()) ** 2
        self.independent = self._segments / (1 + 2 * overlap * (1 - 1 / self._segments))
        self.frequency: Floats = np.arange(1, length // 2 + 1) * sample_rate / length

        self._memory = threading.local()

    def __call__(self, values: Floats) -> Floats:
        """P (length // 2,) of ``values`` (n,) float64, C-contiguous. May be called from several
        threads.
        """
        power = np.zeros(2 * (self._length // 2 + 1))
        views = np.lib.stride_tricks.sliding_window_view(values, self._length)[:: self._step]
        for first in range(0, self._segments, CHUNK):
            view = views[first : first + CHUNK]
            segments, found = (part[: len(view)] for part in self._scratch())
            lines = zip(view.mean(axis=1), np.einsum("st,t->s", view, self._slope), strict=True)
            for row, (mean, slope), segment in zip(
                view, lines, segments, strict=True
            ):  # each stays in the cache
                np.multiply(self._line, -slope, out=segment)
                segment -= mean
                segment += row
                segment *= self._window
            parts = np.fft.rfft(segments, out=found).view(np.float64)
            power += np.einsum("sk,sk->k", parts, parts)
        return np.asarray((power[2::2] + power[3::2]) * self._scale, np.float64)

    def _scratch(self) -> tuple[NDArray[Any], ...]:
        """This thread's memory for the segments and their transforms."""
        if not hasattr(self._memory, "arrays"):
            count = min(CHUNK, self._segments)
            real, spectrum = (count, self._length), (count, self._length // 2 + 1)
            self._memory.arrays = np.empty(real), np.empty(spectrum, np.complex128)
        return self._memory.arrays  # type: ignore[no-any-return]


def quick_length(n: int) -> int:
    """Largest number up to ``n`` without a prime factor above 5: transforms of other lengths take
    up to ten times as long.
    """
    from scipy.fft import next_fast_len

    return next(k for k in range(n, 0, -1) if next_fast_len(k, real=True) == k)


@dataclass
class Periodograms:
    """Spectra of one scan by detector and stream.

    ``welch``: None where the scan is too short. ``streams``: those asked for, None: the usual ones.
    ``place``: the step's label.
    """

    detectors: NDArray[np.int64]
    welch: Welch | None
    streams: Sequence[str] | None
    place: str
    found: dict[int, dict[str, Floats]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, block: Block, detector: int) -> None:
        """Add the spectra of one detector, whose whole scan is in the block."""
        assert self.welch is not None
        found: dict[str, Floats] = {}
        gain = calibration(block, detector)
        usual = {MAIN, *BUILT_IN, *block.observation.components} - {TRANSMISSION}
        for name in self.streams or [s for s in in_order(block.detdata) if s in usual]:
            if name not in block.detdata:
                raise no_stream(name, block.detdata, self.place)
            with np.errstate(
                invalid="ignore", over="ignore"
            ):  # of samples that are not finite: their spectrum is not
                power = self.welch(on_sky(block, detector, name, gain))
            if np.isfinite(power).all():
                found[name] = power
            else:
                block.observation.tally.count(
                    self.place, f"detectors left out for non-finite samples of {name}", 1
                )
        with self.lock:
            self.found[detector] = found

    def mean(self, observation: Observation) -> Spectrum | None:
        """Mean spectrum of all detectors; None where there is none, which is counted."""
        if self.welch is None or not any(self.found.values()):
            why = "too short for" if self.welch is None else "without a detector that has"
            observation.tally.count(self.place, f"scans {why} a power spectrum", 1)
            return None
        every, count = sorted(self.found), len(self.found)
        rows = {
            name: [self.found[d][name] for d in every if name in self.found[d]]
            for d in every
            for name in self.found[d]
        }
        psd = {name: np.mean(rows[name], axis=0) for name in in_order(rows)}
        net = observation.focalplane.net[every]
        white = 2 * float(np.mean(net**2)) if "white" in observation.components else 0.0
        f = self.welch.frequency
        forms = {
            name: np.sum([law(f) for law in observation.closed_forms[name]], axis=0)
            for name in psd
            if name in observation.closed_forms
        }
        return Spectrum(
            f, psd, self.welch.independent * count, white, self.place, count, closed_forms=forms
        )


class PowerSpectrum(Operator):
    """Mean one-sided power spectra of the streams at this step, in K_RJ^2/Hz on the calibrated sky.

    Components at the detector are divided as the calibration divides them: `atmosphere` times
    epsilon, `white`, `pink` and those of plugins, by zeta e^-tau. Streams of other kinds (`pwv`,
    `opacity`, `path_delay`, `transmission`) keep their units. Each segment is freed of a straight
    line, which takes the slow drift of the mean emission with elevation out. Makes the product
    ``spectrum`` (a `Spectrum`), or one under this step's own name where it has one.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"spectrum"})
    knows_means: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"

    streams: list[StreamName] | None = Field(None, min_length=1)
    """Streams to measure; where absent, `signal` and zonda's own components but `transmission`, as
    far as they reach this step."""
    detectors: int = Field(16, ge=1)
    """Number of detectors averaged, chosen evenly among those not flagged."""
    segment: Seconds = quantity("128 s", gt=0)
    """Length of Welch's segments (at most the scan): the inverse of the frequency resolution.
    Shortened to a number of samples that has no prime factor above 5."""

    @property
    def requires(self) -> frozenset[str]:
        """`signal`, and streams of other steps."""
        return streams_needed(self.streams)

    @property
    def optional(self) -> frozenset[str]:
        """Components among the streams."""
        return streams_asked(self.streams)

    def check(self, data: Data) -> list[str]:
        """Refuse streams that no step makes."""
        check_streams(data, self.streams or (), self.label)
        return []

    def prepare(self, observation: Observation) -> Periodograms:
        asked = max(2, round(self.segment * observation.sample_rate))
        length = quick_length(min(observation.n_samples, asked))
        count_flagged(observation, self.label, "the power spectra include")
        welch = None
        if length >= 4:
            welch = Welch(observation.n_samples, observation.sample_rate, length)
        chosen = spread_evenly(observation, self.detectors)
        return Periodograms(chosen, welch, self.streams, self.label)

    def exec(self, block: Block, state: Periodograms) -> None:
        if block.shape[1] != block.observation.n_samples:
            raise PipelineError(
                "got a part of a scan, not a whole one",
                place=self.label,
                cure="this is a fault of the executor: report it",
            )
        here = (state.detectors >= block.detectors.start) & (state.detectors < block.detectors.stop)
        for detector in state.detectors[here] if state.welch is not None else ():
            state.add(block, int(detector))

    def collect(self, data: Data, observation: Observation, state: Periodograms) -> None:
        if (mean := state.mean(observation)) is not None:
            data.add(self.label, mean)

    def finalize(self, data: Data) -> None:
        mean: Spectrum | None = data.take(self.label)
        if mean is not None:
            what = "scans of another length left out of the mean spectrum"
            data.tally.count(self.label, what, mean.of_another_length)
            data.products[key_of(self, "spectrum")] = mean


def in_order(streams: Iterable[str]) -> list[str]:
    """Names of streams in the order of pictures."""
    return sorted(
        streams, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name)
    )


def calibration(block: Block, detector: int) -> Floats:
    """1 / (zeta e^-tau) of one detector: (n_samp,), or (1,) where no step gave a transmission."""
    zeta = block.observation.focalplane.main_beam_efficiency[detector]
    transmission = block.observation.smooth.get("transmission")
    if transmission is None:
        return np.array([1 / zeta])
    return np.asarray(
        1 / (zeta * transmission.evaluate(slice(detector, detector + 1), block.samples)[0]),
        np.float64,
    )


def on_sky(block: Block, detector: int, name: str, gain: Floats) -> Floats:
    """One detector's stream as it enters the calibrated sum, float64 (n_samp,): `signal` with its
    mean, `atmosphere` without.

    Where flags say that there is no signal it is a straight line, as filters see it.
    """
    values, there = (
        _as_it_enters(block, detector, name, gain),
        has_a_signal(block.observation.flags[block.samples]),
    )
    if there.all() or not there.any():
        return values
    known = np.flatnonzero(there)
    values[~there] = np.interp(np.flatnonzero(~there), known, values[known])
    return values


def _as_it_enters(block: Block, detector: int, name: str, gain: Floats) -> Floats:
    """See `on_sky`."""
    row = block.detdata[name][detector - block.detectors.start]
    enters = {
        str(c): c.enters
        for c in (*BUILT_IN, *block.observation.components)
        if isinstance(c, Component)
    }
    if name == "atmosphere":
        gain = gain * block.observation.focalplane.illumination_efficiency[detector]
    if (at_detector := enters.get(name) == "at the detector") and name not in block.means:
        return np.asarray(row * gain, np.float64)
    values: Floats = row.astype(np.float64)
    if name in block.means:
        values += block.means[name].evaluate(slice(detector, detector + 1), block.samples)[0]
    if at_detector:
        values *= gain
    return values
