"""Polynomials of intervals: they go to rounding, white noise loses their degrees of freedom, the
rest stays.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.legendre import legval
from scipy import signal as scipy_signal

import zonda
import zonda.testing
from zonda.core.errors import PipelineError
from zonda.core.flags import INVALID, TRIMMED, slices_in
from zonda.operators.filters.polynomial import Detrend, Pieces, PolynomialFilter
from zonda.operators.filters.rows import Rows
from zonda.plugins.checks import scenes

N = 6000
PASSES = [(0.0, 15.0), (20.0, 35.0), (40.0, 55.0)]
"""Three passes of 15 s with turnarounds of 5 s between them, at 100 Hz; 60 s in all."""


def scan(bench, n_det=3):
    observation = bench.observation(n_det, N)
    observation.intervals = {
        "scanning": PASSES,
        "throw": [(0.0, 17.5), (17.5, 37.5), (37.5, 59.99)],
    }
    return observation


def polynomials(parts, order, n_det, seed):
    """Of each part and detector another polynomial; 0 between."""
    rng = np.random.default_rng(seed)
    x = np.zeros((n_det, N))
    for part in parts:
        n = part.stop - part.start
        x[:, part] = legval(np.linspace(-1, 1, n), rng.standard_normal((order + 1, n_det)))
    return x


@pytest.mark.parametrize("interval", ["whole", "scanning"])
def test_it_keeps_the_contract(interval):
    zonda.testing.check_operator(PolynomialFilter(order=2, interval=interval))


def test_polynomials_of_each_throw_go_to_rounding(bench):
    observation = scan(bench)
    parts = slices_in(observation.intervals["throw"], observation.seconds)
    x = polynomials(parts, 4, 3, 1)
    found = bench.run(
        [PolynomialFilter(order=4, interval="throw")],
        observation,
        {"signal": x},
        precision="float64",
    )
    assert (
        np.abs(found.signal).max() < 1e-13 * np.abs(x).max() * 100
    )  # sums of 2000 terms, condition 1
    assert not found.observations[0].flags.any()


def test_the_whole_scan_is_what_detrend_does(bench):
    x = np.random.default_rng(2).standard_normal((3, N)).cumsum(axis=1)
    runs = [
        bench.run([step], bench.observation(3, N), {"signal": x}, precision="float64").signal
        for step in (PolynomialFilter(order=1), Detrend(order=1))
    ]
    np.testing.assert_array_equal(*runs)
    np.testing.assert_allclose(
        runs[0], scipy_signal.detrend(x), rtol=0, atol=1e-9 * np.abs(x).max()
    )


def test_white_noise_loses_its_degrees_of_freedom(bench):
    """sum y^2 is chi^2 with n - (order + 1) degrees for each pass: within 4 of its standard errors
    sqrt(2 / dof).
    """
    n_det, order = 400, 9
    observation = scan(bench, n_det)
    x = np.random.default_rng(3).standard_normal((n_det, N))
    found = bench.run(
        [PolynomialFilter(order=order, interval="scanning")],
        observation,
        {"signal": x},
        precision="float64",
    )
    parts = slices_in(PASSES, observation.seconds)
    lost = n_det * len(parts) * (order + 1)
    total = sum(float((x[:, p] ** 2).sum() - (found.signal[:, p] ** 2).sum()) for p in parts)
    assert abs(total / lost - 1) < 4 * np.sqrt(2 / lost)


def test_between_passes_goes_a_straight_line_and_the_samples_are_flagged(bench):
    """A drift of 30 K in all: what is left between passes is no larger than the curvature of 5 s of
    it.
    """
    observation = scan(bench)
    t = observation.seconds
    x = np.tile(30 + 0.01 * t, (3, 1))
    found = bench.run(
        [PolynomialFilter(order=1, interval="scanning")],
        observation,
        {"signal": x},
        precision="float64",
    )
    inside = np.zeros(N, bool)
    for p in slices_in(PASSES, t):
        inside[p] = True
    assert np.abs(found.signal[:, :5500]).max() < 1e-11  # the line itself
    assert np.abs(found.signal[:, 5500:]).max() == pytest.approx(
        0.05, rel=0.01
    )  # behind the last pass a constant goes: 5 s x 10 mK/s
    np.testing.assert_array_equal(found.observations[0].flags == TRIMMED, ~inside)
    assert found.log["PolynomialFilter", "samples between intervals, flagged"].startswith(
        str(np.count_nonzero(~inside))
    )


def test_flagged_samples_are_not_used(bench):
    observation = scan(bench)
    observation.flags[100:160] = INVALID
    x = polynomials(slices_in(observation.intervals["throw"], observation.seconds), 2, 3, 4)
    x[:, 100:160] += 1e6
    found = bench.run(
        [PolynomialFilter(order=2, interval="throw")],
        observation,
        {"signal": x},
        precision="float64",
    ).signal
    good = np.r_[0:100, 160:N]
    assert np.abs(found[:, good]).max() < 1e-8  # 1e6 of them would leave thousands
    np.testing.assert_allclose(found[:, 100:160], 1e6, rtol=1e-6)


def test_samples_that_are_not_finite_are_bridged_and_stay(bench):
    observation = scan(bench)
    x = polynomials(slices_in(PASSES, observation.seconds), 2, 3, 5)
    x[1, [0, 700, 1499]] = np.nan
    found = bench.run(
        [PolynomialFilter(order=2, interval="scanning")],
        observation,
        {"signal": x},
        precision="float64",
    ).signal
    assert np.isnan(found[1, [0, 700, 1499]]).all()
    for p in slices_in(PASSES, observation.seconds):
        assert np.nanmax(np.abs(found[:, p])) < 1e-11


def test_a_scan_without_the_interval(bench):
    with pytest.raises(
        PipelineError, match=r"no interval 'throw_leftright'; it has scanning, throw"
    ):
        bench.run(
            [PolynomialFilter(interval="throw_leftright")], scan(bench), {"signal": np.ones((3, N))}
        )


def test_rows_together_have_the_bits_of_rows_alone():
    """Whatever their number: four are summed side by side, spoilt and masked ones by themselves."""
    rng = np.random.default_rng(4)
    rows, masked = rng.normal(size=(11, 3000)), np.zeros((11, 3000), bool)
    rows[2, 70], masked[5, 100:200] = np.nan, True
    use = rng.random(3000) < 0.9
    pieces = Pieces.of([slice(0, 1100), slice(1200, 3000)], 3, use)
    together = rows.copy()
    assert pieces.remove(Rows.of(together), masked) == 1
    for d, row in enumerate(rows):
        alone = row[None].copy()
        pieces.remove(Rows.of(alone), masked[d : d + 1])
        np.testing.assert_array_equal(together[d], alone[0])


def test_on_an_azimuth_scan_turnarounds_are_in_no_map():
    """From a real pointing: `scanning` flags the turnarounds, `throw` uses every sample, and the
    sum of squares falls.
    """
    pointing = zonda.PointingBackAndForth(
        scan_duration="60 s",
        throw="1 deg",
        speed="0.2 deg/s",
        acceleration="0.4 deg/s2",
        sample_rate="50 Hz",
    )
    scene = scenes.scene(scenes.camera(7))
    left = {}
    for interval in ("scanning", "throw"):
        steps = [
            pointing,
            zonda.WhiteNoise(),
            zonda.Efficiency(),
            PolynomialFilter(order=3, interval=interval),
        ]
        observation = zonda.Pipeline(steps).run(scene, keep=("signal",), threads=1).observations[0]
        turning = np.isin(
            np.arange(observation.n_samples),
            np.r_[
                tuple(
                    np.arange(p.start, p.stop)
                    for p in slices_in(observation.intervals["turnaround"], observation.seconds)
                )
            ],
        )
        left[interval] = (observation.flags == TRIMMED) & turning
        assert np.isfinite(observation.detdata["signal"]).all()
        assert (
            (observation.flags == TRIMMED) == (turning if interval == "scanning" else False)
        ).mean() > 0.99
    assert left["scanning"].sum() > 100
    assert not left["throw"].any()
