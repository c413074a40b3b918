"""Planning of the detectors' noise: bounds, coarser forms and memory (`core.plan`)."""

from __future__ import annotations

import math

import numpy as np

from zonda.core.numerics.chunks import TILE_DETECTORS
from zonda.core.observation import Observation, WhiteLevel
from zonda.core.plan.bounds import (
    LEAKS,
    OTHER_MODES,
    Choice,
    Context,
    Effect,
    Estimate,
    Traits,
    full,
)
from zonda.core.plan.planning import Knob, Planning
from zonda.core.types import Floats

from .one_over_f import PowerLawFilter
from .pink import PinkNoise, PinkSpectrum, level_of
from .streams import CHECKPOINT
from .white import WhiteNoise


class WhitePlanning(Planning[WhiteNoise]):
    """Planning of `WhiteNoise`, which has no coarser form."""

    of = WhiteNoise
    per_detector = 200
    """Amplitudes at the nodes of the mean emission."""

    def traits(self, observation: Observation) -> Traits:
        """rms of one calibrated sample of each detector, under the load of
        ``observation.smooth``.
        """
        each = calibrated(observation.noise_levels[self.operator.label], observation)
        return Traits(noise=float(each.min(initial=np.inf)) if each.size else 0.0, each=each)


class PinkPlanning(Planning[PinkNoise]):
    """Planning of `PinkNoise`: fewer poles of its filter, or none of it."""

    of = PinkNoise
    knobs = (
        Knob(
            "poles",
            (4, 6, 8, 12, 16),
            "power law by a filter of few poles (their first states are drawn anew)",
            redraws=True,
        ),
    )

    def memory(self, observation: Observation) -> int:
        """Filter states that are kept, and the common part."""
        pink = self.operator
        n_det = observation.n_detectors
        n_samp = observation.n_samples
        kept = -(-n_det // TILE_DETECTORS) * (n_samp // CHECKPOINT + 3)
        common = 12 * n_samp if pink.shared > 0 else 0
        if spectrum := PinkSpectrum.of(pink, observation):
            kept = math.ceil(kept * filters_in_a_tile(spectrum.slopes))
            common *= len(spectrum.different)
        return kept * (4 * TILE_DETECTORS * (pink.poles + 3) + 300) + common + 80 * n_det

    def traits(self, observation: Observation) -> Traits:
        """rms of one calibrated sample, and of its part that is faster than a frequency."""
        spectrum = PinkSpectrum.of(self.operator, observation)
        if spectrum is None:
            return Traits()
        law = spectrum.filter(self.operator.poles)
        amplitude = self._amplitude(spectrum, observation)
        rate, rms = observation.sample_rate, amplitude * math.sqrt(law.gain * law.variance)
        grid = np.geomspace(1e-9, 0.5, 600)
        # 2 int_f^(1/2) g |H|^2 df
        response = law.response(grid)
        cells = np.diff(grid) * (response[1:] + response[:-1])
        above = np.append(np.cumsum(cells[::-1])[::-1], 0.0)

        def faster(frequency: float) -> float:
            share = float(np.interp(math.log(max(frequency / rate, 1e-9)), np.log(grid), above))
            return min(amplitude * math.sqrt(share), rms)

        return Traits(rms=rms, faster=faster)

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out."""
        pink = self.operator
        o = context.lowest
        spectrum = PinkSpectrum.of(pink, o)
        if spectrum is None:
            return Estimate()
        law = spectrum.filter(pink.poles)
        traits = self.traits(o)
        level = self._amplitude(spectrum, o) ** 2 / max(context.noise, 1e-30) ** 2
        assert traits.faster is not None
        passed = LEAKS * traits.faster(context.cut) if context.cut > 0 else traits.rms
        common = pink.shared > 0 and not context.removes_common
        size = context.bound(passed, _correlated(law, context), common)
        if context.before_filters:
            size["tod"] = traits.rms
        size["psd"] = level * float(law.response(np.array([0.1 / (o.duration * o.sample_rate)]))[0])
        text = (
            "1.5 (2 NET^2 int (f_knee/f)^slope R^2 df)^(1/2), correlated for int |rho| dt; R:"
            " high-pass filter"
        )
        text += OTHER_MODES if context.turns else ""
        bound = context.behind_modes(size)
        choices = [full(f"{pink.poles} poles")]
        if pink.shared == 0 and not context.kept_streams & pink.provides:
            # a common part would be what a singular mode consists of: it is not dropped
            choices.append(Choice("dropped", "none", leave_out=True, bound=bound, formula=text))
        return Estimate((Effect("poles", tuple(choices), bound, text),), without=size)

    def _amplitude(self, spectrum: PinkSpectrum, observation: Observation) -> float:
        """rms of the white noise that is filtered, in the calibrated stream; of the noisiest
        detector, K.
        """
        level = calibrated(level_of(self.operator, observation), observation)
        return float(np.max(level * spectrum.factors))


def calibrated(level: WhiteLevel, observation: Observation) -> Floats:
    """(n_det,) rms of one calibrated sample over the scan, K, under the load of its smooth
    means.
    """
    return np.asarray(level.sky_net(observation) * math.sqrt(observation.sample_rate), np.float64)


def filters_in_a_tile(slopes: Floats) -> float:
    """Different slopes (n_det,) in a tile of detectors, on average: each is a filter that is run
    for the whole tile.
    """
    tiles = np.split(slopes, range(TILE_DETECTORS, len(slopes), TILE_DETECTORS))
    return max(float(np.mean([len(np.unique(tile)) for tile in tiles])), 1.0)


def _correlated(law: PowerLawFilter, context: Context) -> float:
    """int |rho| dt over all lags, s, of noise that the high-pass filter has freed of what is slower
    than its cut.

    rho from the power above the cut f_c, on a grid of f_c / 16 up to 256 f_c: what is faster
    correlates less.
    """
    if context.cut <= 0:
        return context.first.duration
    cut = context.cut
    rate = context.first.sample_rate
    n = 4096
    f = np.arange(n + 1) * cut / 16
    power = np.where((f >= cut) & (f <= rate / 2), law.response(np.maximum(f, cut) / rate), 0.0)
    if not power.sum() > 0:
        return 1 / cut
    rho = np.fft.irfft(power)
    return float(np.abs(rho / rho[0]).sum() / (2 * f[-1]))
