"""Pink (1/f) noise of the detectors."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from zonda.core.configuration.units import Fraction, Hertz, KelvinRootSecond
from zonda.core.data import Block, Data
from zonda.core.errors import placed
from zonda.core.observation import ClosedForm, Observation, WhiteLevel
from zonda.core.operator import Operator
from zonda.core.plausibility import KNEE, doubt
from zonda.core.types import Floats

from .models import Amplitude, FixedNet, NoiseLevel, announced, resolve
from .one_over_f import PowerLawFilter, power_law_filter
from .streams import Streams, StreamsOfSlopes


class PinkNoise(Operator):
    """Gaussian noise with a power-law spectrum, independent for each detector and observation.

    One-sided power spectral density 2 NET^2 (f_knee / f)^slope from `minimum_frequency` to the
    Nyquist frequency, at the detector as for `WhiteNoise`; flat below. Made by a recursive filter
    (`power_law_filter`) of white noise, stationary from the first sample and of any length. The log
    of the run states the error of the fitted spectrum. Its variance is that of the stated spectrum
    within 10 %: where a chain of real poles misses that, as for slopes above 1, complex ones make
    the corner.
    """

    requires = frozenset({"boresight"})
    provides = frozenset({"pink"})

    net: KelvinRootSecond | None = Field(None, ge=0)
    """White level that the knee refers to; None: that of `WhiteNoise`, or the instrument's where
    there is none.
    """
    reference: Literal["sky", "detector"] = "sky"
    """Whether `net` is quoted on the sky, after division by zeta e^-tau, or at the detector."""
    knee: Hertz | None = Field(None, ge=0)
    """Frequency at which pink noise equals white noise; None: each detector's own; 0: no pink
    noise.
    """
    slope: float | None = Field(None, gt=0, le=3)
    """The power spectrum falls as f^-slope; None: each detector's own, where they differ rounded to
    a tenth.
    """
    minimum_frequency: Hertz | None = Field(None, gt=0, examples=["1 mHz"])
    """The spectrum is flat below; None: the instrument's."""
    poles: int = Field(8, ge=2, le=16)
    """Accuracy of the spectrum: its error falls about threefold for every two more poles (1.8 %
    with 8, 0.06 % with 16 for 1/f noise over 4.7 decades; with 16 at most 0.45 % for slopes to 2, 1
    % to 3, over 7.7 decades)."""
    shared: Fraction = Field(0.0, ge=0, le=1, examples=["0.8"])
    """Share of the variance that all detectors have in common."""

    @model_validator(mode="after")
    def _reference_of_net(self) -> PinkNoise:
        if self.net is None and "reference" in self.model_fields_set:
            raise ValueError("reference says what net refers to: give net too, or neither")
        return self

    def check(self, data: Data) -> list[str]:
        """Fit the filter, as `prepare` does: InputError where it cannot be. Warn of a knee that no
        noise has.
        """
        for observation in data.observations[:1]:
            spectrum = PinkSpectrum.of(self, observation)
            nyquist = observation.sampling[1] / 2
            text = (
                "" if spectrum is None else doubt(f"{self.label}: knee", spectrum.knee, KNEE, "Hz")
            )
            if spectrum is not None and spectrum.knee > nyquist:
                text = (
                    f"{self.label}: the knee of {spectrum.knee:g} Hz is above the Nyquist"
                    f" frequency, {nyquist:g} Hz"
                )
            if text:
                warnings.warn(text, stacklevel=2)
        for rate in {observation.sampling[1] for observation in data.observations}:
            for observation in data.observations[0].of_each_band():
                if spectrum := PinkSpectrum.of(self, observation):
                    replace(spectrum, rate=rate).filters(self)
        return []

    def prepare(self, observation: Observation) -> _State | None:
        """Fit the filter; draw the common part. None: there is no pink noise."""
        if spectrum := PinkSpectrum.of(self, observation):
            return _prepared(self, spectrum, observation)
        observation.log.state(self.label, "pink noise", "none: the knee is at 0 Hz")
        observation.focalplane.knee = np.zeros(observation.n_detectors)
        return None

    def exec(self, block: Block, state: _State | None) -> None:
        """Add noise to ``pink``."""
        if state is None:
            block.new("pink")
            return
        add = "pink" in block.detdata
        out = block.new("pink", zero=False)
        level = state.amplitude.of(block.observation).series(
            block.detectors,
            block.samples,
            out.dtype,
        )
        shared = state.common[..., block.samples]
        state.streams.add(
            block.detectors.start,
            block.samples.start,
            out,
            level,
            shared,
            self.shared,
            over=not add,
        )

    def collect(self, data: Data, observation: Observation, state: _State | None) -> None:
        """State the rms."""
        if state is not None:
            middle = np.median(
                state.amplitude.of(observation).time_mean() * np.sqrt(state.streams.variance)
            )
            observation.log.state(
                self.label,
                "rms at the detector, median (mK)",
                f"{1e3 * middle:.4g}",
            )


class _State(NamedTuple):
    amplitude: Amplitude
    streams: Streams | StreamsOfSlopes
    common: NDArray[np.float32]
    """(n_samp,), or one for each slope (n_slopes, n_samp); without samples where nothing is shared.
    """


def _prepared(pink: PinkNoise, spectrum: PinkSpectrum, observation: Observation) -> _State:
    """Raises InputError as `PinkSpectrum.filters`."""
    laws = spectrum.filters(pink)
    slopes = spectrum.different
    observation.log.state(
        pink.label,
        "power over that of white noise",
        spectrum.describe(laws[spectrum.slope]),
    )
    resolve(observation)
    level = level_of(pink, observation)
    net = level.sky_net(observation)
    good = observation.good_detectors
    spectrum.state(observation, net)
    squares = np.where(good, net**2, 0.0) / max(int(good.sum()), 1)
    observation.closed_forms.setdefault("pink", []).append(
        ClosedForm(lambda f: 2 * spectrum.over_white(f, squares), pink.shared)
    )
    gain = np.sqrt([laws[slope].gain for slope in spectrum.slopes.tolist()])
    amplitude = Amplitude(pink.label, level, observation, spectrum.factors * gain)
    key = observation.detector_key(pink.label)
    start = observation.detector_key(pink.label, "start")
    made = {slope: Streams(laws[slope], key, start) for slope in slopes}
    streams = made[slopes[0]] if len(made) == 1 else StreamsOfSlopes(spectrum.slopes, made)
    common = np.zeros((len(made), observation.n_samples if pink.shared else 0), np.float32)
    if pink.shared:  # the same deviates through the filter of each slope
        keys = [observation.detector_key(pink.label, "shared", *more) for more in ((), ("start",))]
        for row, slope in enumerate(made):
            Streams(laws[slope], *keys).add(0, 0, common[row : row + 1])
    return _State(amplitude, streams, common[0] if len(made) == 1 else common)


@dataclass(frozen=True)
class PinkSpectrum:
    """The spectrum of pink noise over that of white noise: (f / knee)^-slope from ``minimum`` to
    the Nyquist frequency.

    Attributes
    ----------
    knee, slope, minimum, rate
        What the step asks for, else the instrument's; ``rate`` is that of the samples. Hz.
    knees, slopes
        (n_det,) of the single detectors: those that the instrument's focal plane has, where the
        step states none.
    """

    knee: float
    slope: float
    minimum: float
    rate: float
    knees: Floats = field(repr=False)
    slopes: Floats = field(repr=False)

    @classmethod
    def of(cls, pink: PinkNoise, observation: Observation) -> PinkSpectrum | None:
        """Spectrum of an observation; None: no pink noise."""
        instrument = observation.instrument
        n = observation.n_detectors
        knee = instrument.knee if pink.knee is None else pink.knee
        plane = instrument.focalplane() if pink.knee is None or pink.slope is None else None
        if plane and pink.knee is None and not knee:  # the median; single detectors may have some
            knee = float(plane.knee.max())
        if not knee:
            return None
        slope = pink.slope or instrument.slope
        minimum = pink.minimum_frequency
        knees = np.full(n, knee)
        slopes = np.full(n, slope)
        if plane and plane.names == observation.focalplane.names:
            if pink.knee is None and np.ptp(plane.knee):
                knees = plane.knee
            if pink.slope is None and np.ptp(plane.slope):
                slopes = np.clip(plane.slope.round(1), 0.1, 3.0)
        minimum = minimum or instrument.pink_minimum_frequency
        return cls(knee, slope, minimum, observation.sample_rate, knees, slopes)

    @property
    def factor(self) -> float:
        """Root of the spectrum at its ``minimum``."""
        return float((self.knee / self.minimum) ** (self.slope / 2))

    @property
    def factors(self) -> Floats:
        """(n_det,) `factor` of each detector; by single numbers, whose powers have the same bits
        anywhere.
        """
        pairs = zip(self.knees.tolist(), self.slopes.tolist(), strict=True)
        return np.array([(knee / self.minimum) ** (slope / 2) for knee, slope in pairs])

    @property
    def different(self) -> list[float]:
        """The different slopes."""
        return [float(slope) for slope in np.unique(self.slopes)]

    def filter(self, poles: int) -> PowerLawFilter:
        """The recursive filter that makes it of white noise of the rms `factor`."""
        return power_law_filter(self.minimum / self.rate, self.slope, poles)

    def filters(self, pink: PinkNoise) -> dict[float, PowerLawFilter]:
        """The filter of the spectrum's own slope, and of each that a detector has.

        Raises InputError where the number of poles cannot fit the spectrum (see
        `power_law_filter`).
        """
        with placed(pink.label):
            return {
                slope: replace(self, slope=slope).filter(pink.poles)
                for slope in [self.slope, *self.different]
            }

    def describe(self, law: PowerLawFilter) -> str:
        """The spectrum in words: differences between detectors, and the errors of its filter."""
        spans = [
            f"{what} {values.min():.4g} to {values.max():.4g}{unit}"
            for what, values, unit in (("knee", self.knees, " Hz"), ("slope", self.slopes, ""))
            if np.ptp(values)
        ]
        text = f"{', '.join(spans)}; at the median " if spans else ""
        return (
            f"{text}(f / {self.knee:g} Hz)^-{self.slope:g} from {self.minimum:g} Hz to"
            f" {self.rate / 2:g} Hz within {100 * law.error:.2g} %, levelling off below to"
            f" {law.plateau:.2g} times its value at {self.minimum:g} Hz"
        )

    def over_white(self, frequency: Floats, weights: Floats) -> Floats:
        """Sum over detectors of ``weights`` (n_det,) times the spectra over those of white noise,
        (n,).
        """
        f = np.maximum(frequency, self.minimum)
        found = np.zeros(len(f))
        for slope in self.different:
            mine = self.slopes == slope
            found += np.sum(weights[mine] * self.knees[mine] ** slope) * f**-slope
        return found

    def state(self, observation: Observation, net: Floats) -> None:
        """Write it to the focal plane, where the knee refers to the white noise of that: here it
        refers to ``net`` (n_det,).
        """
        plane = observation.focalplane
        white = np.where(plane.net > 0, plane.net, net)
        ratio = np.divide(net, white, out=np.ones(len(plane)), where=white > 0)
        plane.knee = self.knees * ratio ** (2 / self.slopes)
        plane.slope, plane.minimum_frequency = self.slopes.copy(), np.full(len(plane), self.minimum)


def level_of(pink: PinkNoise, observation: Observation) -> WhiteLevel:
    """The white level that the knee refers to."""
    if pink.net is None:
        return announced(observation)
    return NoiseLevel(FixedNet.of(pink.net, pink.reference))
