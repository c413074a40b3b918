"""Templates in azimuth: what repeats with it goes to rounding, white noise loses their degrees of
freedom.
"""

from __future__ import annotations

import numpy as np
import pytest

import zonda.testing
from zonda.core.flags import INVALID
from zonda.core.numerics.quaternions import from_angles
from zonda.operators.filters.ground import GroundFilter

N = 6000
BIN = np.radians(0.5)


def scan(bench, n_det=3, centre=0.0):
    """To and fro over 40 deg of azimuth about ``centre`` [rad] in 12.3 s, so that no bin keeps its
    place in time.
    """
    observation = bench.observation(n_det, N)
    azimuth = centre + np.radians(20) * np.sin(2 * np.pi * observation.seconds / 12.3)
    observation.boresight_azel = from_angles(-azimuth, np.full(N, 0.9))
    return observation


def ground(observation, seed, n_det=3):
    """Another number for each detector and bin of 0.5 deg."""
    number = np.floor(observation.azimuth / BIN).astype(int)
    return np.random.default_rng(seed).standard_normal((n_det, 1000))[:, number], number


def drift(order, n_det=3):
    t = np.linspace(-1, 1, N)
    return np.random.default_rng(9).standard_normal((n_det, order)) @ np.stack(
        [t ** (k + 1) for k in range(order)]
    )


def test_it_keeps_the_contract():
    zonda.testing.check_operator(GroundFilter(bin="2 arcmin", trend=2))


def test_it_keeps_the_contract_with_two_templates():
    zonda.testing.check_operator(GroundFilter(bin="2 arcmin", split=True, trend=0))


@pytest.mark.parametrize("centre", [0.0, 2.0])
def test_what_repeats_with_the_azimuth_goes_with_a_trend(bench, centre):
    """About the north too, where the azimuth jumps from 360 to 0 deg; tens of kelvin of mean, and a
    drift.
    """
    observation = scan(bench, centre=centre)
    x = ground(observation, 1)[0] + drift(2) + 30.0
    found = bench.run(
        [GroundFilter(trend=2)], observation, {"signal": x}, precision="float64"
    ).signal
    assert np.abs(found).max() < 1e-11  # 30 x 2^-52 x sums of some hundred terms


def test_a_signal_of_the_sky_stays(bench):
    """What does not repeat with the azimuth: a wave in time of which the template holds only its
    mean in each bin.
    """
    observation = scan(bench)
    t = observation.seconds
    x = np.tile(np.sin(2 * np.pi * t / 0.37), (3, 1))
    found = bench.run([GroundFilter()], observation, {"signal": x}, precision="float64").signal
    # a bin has some 60 samples, in passages of 0.06 s to 1 s whose phases differ: it keeps most of
    # the power
    assert 0.8 < np.mean(found**2) / np.mean(x**2) < 1


def test_two_directions_need_two_templates(bench):
    observation = scan(bench)
    number = ground(observation, 2)[1]
    to_the_right = np.gradient(np.unwrap(observation.azimuth)) > 0
    rng = np.random.default_rng(3)
    one, other = rng.standard_normal((2, 3, 1000))
    x = np.where(to_the_right, one[:, number], other[:, number])
    split = bench.run(
        [GroundFilter(split=True, trend=0)], observation, {"signal": x}, precision="float64"
    ).signal
    assert np.abs(split).max() < 1e-12
    both = bench.run(
        [GroundFilter(trend=0)], scan(bench), {"signal": x}, precision="float64"
    ).signal
    # of two independent numbers a bin keeps the mean: half of the variance is left where both are
    # seen equally often
    assert np.mean(both**2) / np.mean(x**2) == pytest.approx(0.5, abs=0.1)


def test_white_noise_loses_its_degrees_of_freedom(bench):
    n_det = 200
    observation = scan(bench, n_det)
    x = np.random.default_rng(4).standard_normal((n_det, N))
    bins = len(np.unique(ground(observation, 0)[1]))
    found = bench.run([GroundFilter(trend=3)], observation, {"signal": x}, precision="float64")
    assert found.log["GroundFilter", "scan0: bins of the template"] == str(bins)
    lost = n_det * (bins + 3)
    assert abs((np.sum(x**2) - np.sum(found.signal**2)) / lost - 1) < 4 * np.sqrt(2 / lost)  # chi^2


def test_it_is_the_least_squares_fit(bench):
    """Equation (1) with the whole matrix, some samples flagged, one not finite."""
    observation = scan(bench)
    observation.flags[1000:1400] = INVALID
    x = np.random.default_rng(5).standard_normal((3, N)).cumsum(axis=1)
    x[2, 77] = np.nan
    found = bench.run(
        [GroundFilter(trend=2)], observation, {"signal": x}, precision="float64"
    ).signal
    number = np.unique(np.floor(observation.azimuth / BIN), return_inverse=True)[1]
    t = (2 * np.arange(N) + 1) / N - 1
    functions = np.column_stack(
        [number[:, None] == np.arange(number.max() + 1), t, 1.5 * t**2 - 0.5]
    )
    for row, y in zip(x, found, strict=True):
        use = (observation.flags == 0) & np.isfinite(row)
        fit = functions @ np.linalg.lstsq(functions[use], row[use], rcond=None)[0]
        np.testing.assert_allclose(
            y, row - fit, rtol=0, atol=1e-9 * np.nanmax(np.abs(row)), equal_nan=True
        )


def test_one_bin_is_warned_of(bench):
    with pytest.warns(UserWarning, match="spans 0 deg of azimuth, one bin of 0.5 deg"):
        bench.run([GroundFilter()], bench.observation(3, N), {"signal": np.ones((3, N))})


def test_bins_are_of_the_recorded_azimuth(bench):
    """A throw that begins on the edge of a bin, of which the azimuth of the quaternions is a
    rounding away; TOAST's bins.
    """
    observation = scan(bench)
    edge = np.radians(105.0)
    azimuth = edge + np.radians(20) * np.abs(np.sin(2 * np.pi * observation.seconds / 12.3))
    azimuth[::50] = edge
    observation.boresight_azel = from_angles(-(azimuth - np.radians(5e-14)), np.full(N, 0.9))
    observation.recorded_azimuth = azimuth
    number = (azimuth // BIN).astype(int)
    assert (number[::50] == 210).all()
    assert (
        np.floor(observation.derotate("boresight_azel")[0] * -1 % (2 * np.pi) / BIN)[::50] == 209
    ).any()
    x = np.random.default_rng(2).standard_normal((3, 1000))[:, number]
    found = bench.run(
        [GroundFilter(trend=0)], observation, {"signal": x}, precision="float64"
    ).signal
    assert np.abs(found).max() < 1e-12
    observation.recorded_azimuth = (
        azimuth + 2 * np.pi
    )  # as TOAST counts beyond the north; of a whole number of bins
    observation.recorded_azimuth[::2] = azimuth[::2]
    where = (observation.recorded_azimuth // BIN).astype(int) % 720
    x = np.random.default_rng(2).standard_normal((3, 1000))[:, where]
    found = bench.run(
        [GroundFilter(trend=0)], observation, {"signal": x}, precision="float64"
    ).signal
    assert np.abs(found).max() < 1e-12


def test_no_azimuth_is_a_whole_turn(bench):
    """The remainder of what is a rounding below 0 is 2 pi: a bin of its own."""
    observation = scan(bench)
    observation.boresight_azel = from_angles(-np.linspace(-1e-17, 1e-17, N), np.full(N, 0.9))
    assert observation.azimuth.max() < 2 * np.pi
