"""Power spectra of the time streams, referred to the calibrated sky."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Seconds
from zonda.core.data import Block, Data, Observation
from zonda.core.flags import has_a_signal
from zonda.core.signal import BUILT_IN, MAIN, TRANSMISSION, Component
from zonda.core.stream import StreamName
from zonda.core.types import Floats, Integers

from .series import Spectrum, StreamDiagnostic, count_flagged, no_stream, spread_evenly

ORDER = ("signal", "atmosphere", "pink", "white", "sky", "transmission")
"""Of spectra in pictures."""


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
        turn = 2 * np.pi * np.arange(length) / length
        w = 0.5 - 0.5 * np.cos(turn) if length > 2 else np.ones(length)
        self._length = length
        self._step = max(1, length // 2)
        self._window = w
        segments = (n - length) // self._step + 1
        self._line = np.arange(length) - (length - 1) / 2
        self._slope = self._line / (self._line**2).sum()
        self._scale = np.full(length // 2, 2 / (segments * sample_rate * (w**2).sum()))
        if length % 2 == 0:
            self._scale[-1] /= 2
        overlap = ((w[: length - length // 2] * w[length // 2 :]).sum() / (w**2).sum()) ** 2
        self.independent = segments / (1 + 2 * overlap * (1 - 1 / segments))
        self.frequency: Floats = np.arange(1, length // 2 + 1) * sample_rate / length

    def __call__(self, values: Floats) -> Floats:
        """P (length // 2,) of ``values`` (n,) float64."""
        powers = (t.real**2 + t.imag**2 for t in self.transforms(values))
        return np.asarray(self.density(powers), np.float64)

    def transforms(self, values: Floats) -> Iterator[NDArray[np.complex128]]:
        """Fourier transform (length // 2 + 1,) of each segment of a series."""
        from scipy.fft import rfft

        for part in np.lib.stride_tricks.sliding_window_view(values, self._length)[:: self._step]:
            line = np.einsum("t,t", part, self._slope) * self._line
            yield rfft((part - part.mean() - line) * self._window)

    def density(self, products: Iterable[Any]) -> Any:
        """Density (..., length // 2) from products of the transforms of each segment."""
        return sum(products)[..., 1:] * self._scale


def welch_of(observation: Observation, seconds: float, most: int) -> Welch | None:
    """`Welch` with segments of at most ``most`` samples; None for a scan that is too short.

    Their length has no prime factor above 5: transforms of others take up to ten times as long.
    """
    from scipy.fft import prev_fast_len

    wanted = min(most, round(seconds * observation.sample_rate))
    length = prev_fast_len(max(1, wanted), real=True)
    return Welch(observation.n_samples, observation.sample_rate, length) if length >= 4 else None


@dataclass
class Chosen:
    """Detectors of one scan whose streams are looked at, and what was found of each.

    ``welch``: None where the scan is too short.
    """

    detectors: Integers
    welch: Welch | None
    found: dict[int, Any] = field(default_factory=dict)

    def streams(
        self,
        block: Block,
        names: Sequence[str],
        place: str,
    ) -> Iterator[tuple[int, dict[str, Floats]]]:
        """Each detector of a block with its streams on the calibrated sky, `on_sky`."""
        for name in names:
            if name not in block.detdata:
                raise no_stream(name, block.detdata, place)
        for detector in self.detectors if self.welch else ():
            if block.detectors.start <= detector < block.detectors.stop:
                gain = calibration(block, int(detector))
                with np.errstate(invalid="ignore", over="ignore"):
                    yield int(detector), {n: on_sky(block, int(detector), n, gain) for n in names}


class PowerSpectrum(StreamDiagnostic):
    """Mean one-sided power spectra of the streams at this step, in K_RJ^2/Hz on the calibrated sky.

    Components at the detector are divided as the calibration divides them: `atmosphere` times
    epsilon, `white`, `pink` and those of plugins, by zeta e^-tau. Streams of other kinds (`pwv`,
    `opacity`, `path_delay`, `transmission`) keep their units. Each segment is freed of a straight
    line, which takes the slow drift of the mean emission with elevation out. Makes the product
    ``spectrum`` (a `Spectrum`), or one under this step's own name where it has one.
    """

    provides = frozenset({"spectrum"})
    knows_means = True
    couples = "time"

    streams: list[StreamName] | None = Field(None, min_length=1)
    """Streams to measure; where absent, `signal` and zonda's own components but `transmission`, as
    far as they reach this step."""
    detectors: int = Field(16, ge=1)
    """Number of detectors averaged, chosen evenly among those not flagged."""
    segment: Seconds = quantity("128 s", gt=0)
    """Length of Welch's segments (at most the scan): the inverse of the frequency resolution.
    Shortened to a number of samples that has no prime factor above 5."""

    def asked(self) -> Sequence[str] | None:
        """Streams of the parameter `streams`."""
        return self.streams

    def prepare(self, observation: Observation) -> Chosen:
        count_flagged(observation, self.label, "the power spectra include")
        welch = welch_of(observation, self.segment, observation.n_samples)
        return Chosen(spread_evenly(observation, self.detectors), welch)

    def exec(self, block: Block, state: Chosen) -> None:
        usual = {MAIN, *BUILT_IN, *block.observation.components} - {TRANSMISSION}
        names = self.streams or [name for name in in_order(block.detdata) if name in usual]
        for detector, streams in state.streams(block, names, self.label):
            found = state.found[detector] = {}
            for name, values in streams.items():
                with np.errstate(invalid="ignore", over="ignore"):
                    power = state.welch(values)  # type: ignore[misc]
                if np.isfinite(power).all():
                    found[name] = power
                else:
                    block.observation.log.count(
                        self.label,
                        f"detectors left out for non-finite samples of {name}",
                        1,
                    )

    def collect(self, data: Data, observation: Observation, state: Chosen) -> None:
        every = sorted(state.found)
        rows = [state.found[detector] for detector in every]
        names = in_order(set().union(*rows))
        if state.welch is None or not names:
            why = "too short for" if state.welch is None else "without a detector that has"
            observation.log.count(self.label, f"scans {why} a power spectrum", 1)
            return
        psd = {name: np.mean([row[name] for row in rows if name in row], axis=0) for name in names}
        net = observation.focalplane.net[every]
        f = state.welch.frequency
        forms = {
            name: np.sum([law(f) for law in observation.closed_forms[name]], axis=0)
            for name in names
            if name in observation.closed_forms
        }
        white = 2 * float(np.mean(net**2)) if "white" in observation.components else 0.0
        averages = state.welch.independent * len(every)
        found = Spectrum(f, psd, averages, white, self.label, len(every), closed_forms=forms)
        data.add(self.label, found)


def in_order(streams: Iterable[str]) -> list[str]:
    """Names of streams in the order of pictures."""
    return sorted(streams, key=lambda name: (ORDER.index(name) if name in ORDER else 9, name))


def calibration(block: Block, detector: int) -> Floats | float:
    """1 / (zeta e^-tau) of one detector: (n_samp,), or 1 / zeta where no step gave a
    transmission.
    """
    zeta = block.observation.focalplane.main_beam_efficiency[detector]
    passed = block.observation.smooth.get("transmission")
    one = slice(detector, detector + 1)
    transmission = passed.evaluate(one, block.samples)[0] if passed else 1.0
    return np.asarray(1 / (zeta * transmission))


def on_sky(block: Block, detector: int, name: str, gain: Floats | float) -> Floats:
    """One detector's stream as it enters the calibrated sum, float64 (n_samp,): `signal` with its
    mean, `atmosphere` without.

    Where flags say that there is no signal it is a straight line, as filters see it.
    """
    observation = block.observation
    values: Floats = block.detdata[name][detector - block.detectors.start].astype(np.float64)
    if name in block.means:
        values += block.means[name].evaluate(slice(detector, detector + 1), block.samples)[0]
    known = [c for c in (*BUILT_IN, *observation.components) if isinstance(c, Component)]
    if any(c.enters == "at the detector" for c in known if c == name):
        if name == "atmosphere":
            gain = gain * observation.focalplane.illumination_efficiency[detector]
        values *= gain
    there = has_a_signal(observation.flags[block.samples])
    if not there.all() and there.any():
        values[~there] = np.interp(np.flatnonzero(~there), np.flatnonzero(there), values[there])
    return values
