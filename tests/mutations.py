"""Numerical safeguards, each broken as naive code would have it, and the check that must then fail.

Compiled code that is called from Python is replaced as a whole; nothing is compiled anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from zonda.core.data import Block, Observation
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.run import block_maker
from zonda.operators.atmosphere.turbulence import covariance, lattice
from zonda.operators.atmosphere.weather import bands
from zonda.operators.filters import brick_wall, common_mode
from zonda.operators.maps import binning
from zonda.operators.maps.intensity_kernel import DATA
from zonda.operators.noise import pink, white
from zonda.operators.optics.efficiency import Efficiency
from zonda.operators.pointing import recording
from zonda.operators.sky.map_header import MapHeader

Patch = pytest.MonkeyPatch


@dataclass(frozen=True)
class Mutation:
    """What is broken, the check that must fail, and how to break it."""

    what: str
    check: str
    breaks: Callable[[Patch], None]


def one_minus_correlation(patch: Patch) -> None:
    patch.setattr(covariance, "structure", lambda x: 1 - covariance._tail(np.asarray(x)))


def difference_of_covariances(patch: Patch) -> None:
    def subtracted(r: Any, outer_scale: float, sigma: float) -> Any:
        return covariance.beam_correlation(0.0, outer_scale, sigma) - covariance.beam_correlation(
            r, outer_scale, sigma
        )

    patch.setattr(covariance, "beam_structure", subtracted)


def weights_that_do_not_sum_to_one(patch: Patch) -> None:
    kriging = lattice.kriging
    patch.setattr(lattice, "kriging", lambda *of: kriging(*of) * np.float32(1 - 1e-3))


def transmission_of_the_mean_opacity(patch: Patch) -> None:
    def mean_first(self: Any, slant: Any) -> Any:
        opacity = float(np.average(slant.sum(axis=0), weights=self._weight))
        return float(np.sum(self._weight * bands.emission(slant, self._source))), -opacity

    patch.setattr(bands.BandTransfer, "_at", mean_first)


def exponentials_before_logarithms(patch: Patch) -> None:
    def underflowing(self: Any, slant: Any) -> Any:
        passed = self._weight * np.exp(-slant.sum(axis=0))
        emitted = float(np.sum(self._weight * bands.emission(slant, self._source)))
        with np.errstate(divide="ignore"):
            return emitted, float(np.log(passed.sum()))

    patch.setattr(bands.BandTransfer, "_at", underflowing)


def differences_by_subtraction(patch: Patch) -> None:
    def subtracted(self: Any, which: int, pwv: Any, dpwv: Any, elevation: Any) -> Any:
        return self._evaluate(which, np.add(pwv, dpwv), elevation) - self._evaluate(
            which, pwv, elevation
        )

    patch.setattr(bands.BandAtmosphere, "_difference", subtracted)


def highpass_without_detrending(patch: Patch) -> None:
    low = brick_wall.HighpassPlan._low

    def without(self: Any, s: Any) -> Any:
        return low(
            replace(self, modes=0 * self.modes, spread_modes=0 * self.spread_modes, sums=()), s
        )

    patch.setattr(brick_wall.HighpassPlan, "_low", without)


def gaps_that_ring(patch: Patch) -> None:
    patch.setattr(
        brick_wall,
        "bridge",
        lambda row, gaps: row.__setitem__(gaps, np.nan_to_num(row[gaps], posinf=0.0, neginf=0.0)),
    )


def modes_beyond_the_rank(patch: Patch) -> None:
    patch.setattr(common_mode.ModeSearch, "_choose", lambda self, found, gram: self.step.modes)


def dead_detectors_that_take_part(patch: Patch) -> None:
    begin = common_mode.Gram.__init__

    def all_of_them(self: Any, *arguments: Any, **others: Any) -> None:
        begin(self, *arguments, **others)
        self.constant[:] = False
        self.not_finite[:] = False

    patch.setattr(common_mode.Gram, "__init__", all_of_them)


def float32_whatever_the_ratio(patch: Patch) -> None:
    patch.setattr(common_mode, "_check_precision", lambda *arguments: None)


def mean_emission_in_float32(patch: Patch) -> None:
    calibrated = Efficiency.exec

    def together(self: Any, block: Block, state: Any) -> None:
        calibrated(self, block, state)
        if mean := block.means.pop("signal", None):
            block.detdata["signal"] += mean.evaluate(block.detectors, block.samples).astype(
                block.dtype
            )

    patch.setattr(Efficiency, "exec", together)


def nan_pixels_that_stay(patch: Patch) -> None:
    patch.setattr(
        MapHeader, "filled", lambda header, values, first: int((~np.isfinite(values)).sum())
    )


def nan_samples_that_count_as_zero(patch: Patch) -> None:
    add = binning.add_intensity
    patch.setattr(
        binning,
        "add_intensity",
        lambda signals, *rest: add(
            tuple(np.nan_to_num(s, posinf=0.0, neginf=0.0) for s in signals), *rest
        ),
    )


def sums_rounded_by_block(patch: Patch) -> None:
    """Each block adds float32 sums, as a naive accumulator would."""
    add = binning.add_intensity

    def rounded(*arguments: Any) -> None:
        add(*arguments)
        sums = arguments[-3]
        sums[:, DATA] = sums[:, DATA].astype(np.float32).astype(np.int64)

    patch.setattr(binning, "add_intensity", rounded)


def noise_that_starts_again_in_each_block(patch: Patch) -> None:
    add = white._add_normals
    patch.setattr(
        white,
        "_add_normals",
        lambda key, first, start, lines, cell, *rest: add(key, first, 0, lines, 0, *rest),
    )


def pink_noise_with_a_period(patch: Patch) -> None:
    add = pink.Streams.add
    patch.setattr(
        pink.Streams,
        "add",
        lambda self, detector, sample, *rest: add(self, detector, sample % 200_000, *rest),
    )


def pink_noise_that_starts_from_nothing(patch: Patch) -> None:
    first = pink.Streams._first_state
    patch.setattr(pink.Streams, "_first_state", lambda self, number: 0 * first(self, number))


def times_in_one_float(patch: Patch) -> None:
    def julian_dates(self: Any, seconds: Any) -> Any:
        utc = 2440587.5 + (self.start.nanoseconds / 1e9 + seconds) / 86400
        return utc, np.zeros_like(utc)

    patch.setattr(CelestialTransform, "_utc", julian_dates)


def days_of_86400_seconds(patch: Patch) -> None:
    def divided(self: Any, seconds: Any) -> Any:
        days, rest = divmod(self.start.nanoseconds, 86_400_000_000_000)
        return np.full(len(seconds), 2440587.5 + days), rest / 86_400e9 + seconds / 86400.0

    patch.setattr(CelestialTransform, "_utc", divided)


def air_that_ignores_the_times(patch: Patch) -> None:
    patch.setattr(Observation, "seconds_at", lambda self, index: index / self.sample_rate)


def gaps_filled_in_silence(patch: Patch) -> None:
    patch.setattr(recording, "NOT_RECORDED", np.uint8(0))


def noise_that_all_bands_share(patch: Patch) -> None:
    patch.setattr(Observation, "detector_key", Observation.key)


def the_instruments_net_whatever_the_load(patch: Patch) -> None:
    patch.setattr(white, "resolve", lambda observation: None)


def steps_that_see_no_mean(patch: Patch) -> None:
    patch.setattr(block_maker, "knows_means", lambda operator: True)


MUTATIONS = (
    Mutation("1 - C by subtraction", "covariance.structure_function", one_minus_correlation),
    Mutation("C(0) - C(r) by subtraction", "covariance.behind_a_beam", difference_of_covariances),
    Mutation(
        "kriging weights that do not sum to 1",
        "lattice.structure_function",
        weights_that_do_not_sum_to_one,
    ),
    Mutation(
        "e^-<tau> instead of <e^-tau>", "opacity.band_average", transmission_of_the_mean_opacity
    ),
    Mutation(
        "logarithms of exponentials that underflow",
        "opacity.saturated_line",
        exponentials_before_logarithms,
    ),
    Mutation(
        "T(pwv + d) - T(pwv) instead of log1p and a recurrence",
        "opacity.small_differences",
        differences_by_subtraction,
    ),
    Mutation(
        "the high-pass does not detrend", "numerics.elevation_drift", highpass_without_detrending
    ),
    Mutation("flagged samples are not bridged", "filters.gaps_and_nan", gaps_that_ring),
    Mutation(
        "modes are removed whatever the rank", "filters.one_or_identical", modes_beyond_the_rank
    ),
    Mutation(
        "dead detectors are not flagged", "filters.useless_detectors", dead_detectors_that_take_part
    ),
    Mutation(
        "float32 whatever the common mode",
        "filters.common_mode_in_float32",
        float32_whatever_the_ratio,
    ),
    Mutation(
        "the mean emission is part of the float32 stream",
        "filters.transfer",
        mean_emission_in_float32,
    ),
    Mutation("NaN pixels of the input spread", "maps.nan_in_the_input_map", nan_pixels_that_stay),
    Mutation(
        "NaN samples are mapped as 0", "maps.nan_in_the_signal", nan_samples_that_count_as_zero
    ),
    Mutation(
        "map sums rounded block by block", "determinism.blocks_in_time", sums_rounded_by_block
    ),
    Mutation(
        "random numbers counted from the block's start",
        "determinism.blocks_in_time",
        noise_that_starts_again_in_each_block,
    ),
    Mutation("1/f noise with a period", "noise.no_period", pink_noise_with_a_period),
    Mutation(
        "1/f noise that starts from nothing",
        "numerics.first_sample",
        pink_noise_that_starts_from_nothing,
    ),
    Mutation("the time in one float64", "numerics.exact_start", times_in_one_float),
    Mutation(
        "the air is sampled by a comb", "timing.jittered_atmosphere", air_that_ignores_the_times
    ),
    Mutation(
        "NaN rows and gaps are interpolated", "timing.recorded_gaps_and_nan", gaps_filled_in_silence
    ),
    Mutation("days of 86400 s", "pointing.leap_second", days_of_86400_seconds),
    Mutation(
        "noise keyed without instrument and band", "noise.two_bands", noise_that_all_bands_share
    ),
    Mutation(
        "the noise of a map follows from the instrument's NET",
        "noise.stated",
        the_instruments_net_whatever_the_load,
    ),
    Mutation(
        "a plugin's step multiplies the stream without its mean",
        "means.gain_of_the_whole",
        steps_that_see_no_mean,
    ),
)
