"""Ground pickup: it repeats with the azimuth, has the rms and correlation it should, and a ground
filter removes it.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

import zonda
import zonda.testing
from zonda.core.numerics.quaternions import from_angles
from zonda.core.numerics.random import stream_key
from zonda.operators.filters.ground import GroundFilter
from zonda.operators.optics.ground_pickup import GroundPickup, horizon
from zonda.plugins.checks import scenes


def scan(bench, n_det=5, n=4000, index=0, elevation=math.pi / 4, **more):
    observation = bench.observation(n_det, n, index=index, **more)
    azimuth = 2.0 + np.radians(30) * np.sin(2 * np.pi * observation.seconds / 7 + index)
    observation.boresight_azel = from_angles(-azimuth, np.full(n, elevation))
    return observation


def test_it_keeps_the_contract():
    zonda.testing.check_operator(GroundPickup(scatter="10 %"))


def test_rms_and_correlation_over_grounds():
    """A Gaussian process of unit variance whose correlation is that of the lobe with itself:
    exp(-x^2 / (4 s^2)), less its mean over the horizon."""
    n, fwhm = 3000, np.radians(20)
    s = fwhm / np.sqrt(8 * np.log(2))
    azimuth = np.radians([0.0, 10.0, 25.0, 180.0])
    found = np.array([horizon(azimuth, fwhm, stream_key(k, "test")) for k in range(n)])
    assert (np.abs((found**2).mean(axis=0) - 1) < 4.5 * np.sqrt(2 / n)).all()
    level = s / np.sqrt(
        np.pi
    )  # 2 s sqrt(pi) / (2 pi): the mean of that Gaussian over the circle, taken away (m = 0)
    for k in (1, 2, 3):
        expected = (np.exp(-(azimuth[k] ** 2) / (4 * s**2)) - level) / (1 - level)
        assert abs((found[:, 0] * found[:, k]).mean() - expected) < 4.5 * np.sqrt(
            (1 + expected**2) / n
        )


def test_it_depends_on_the_azimuth_alone_and_is_that_of_the_seed(bench):
    """Two scans of one seed at the same azimuth have the same; another elevation scales it; a
    detector's share is its own.
    """
    first, second = scan(bench), scan(bench, index=1)
    step = GroundPickup(rms="2 mK", scatter="20 %")
    run = bench.run([step], [first, second], precision="float64", keep=("ground",))
    a, b = (o.detdata["ground"] for o in run.observations)
    order = np.argsort(second.azimuth)
    np.testing.assert_allclose(
        np.interp(first.azimuth, second.azimuth[order], b[2][order]), a[2], rtol=0, atol=1e-5
    )
    ratio = a[:, :1] / a[0, 0]
    np.testing.assert_allclose(a, ratio * a[0], rtol=1e-12)
    assert 0.05 < ratio.std() < 0.6
    high = bench.run(
        [step], scan(bench, elevation=math.pi / 3), precision="float64", keep=("ground",)
    )
    np.testing.assert_allclose(high.observations[0].detdata["ground"], 0.75 * a, rtol=0, atol=1e-15)


def test_a_realization_is_the_same_for_every_seed(bench):
    one, other = scan(bench), scan(bench)
    other.seed = 99
    for realization, same in ((None, False), (4, True)):
        step = GroundPickup(realization=realization)
        assert np.array_equal(step.prepare(one)[1], step.prepare(other)[1]) == same


def test_a_ground_filter_removes_it():
    """Azimuth scan, white noise: with the filter the stream is that of the noise alone, within the
    bins' width; without it is not."""
    pointing = zonda.PointingBackAndForth(
        target="az 120 deg el 50 deg",
        scan_duration="60 s",
        throw="8 deg",
        speed="1 deg/s",
        acceleration="2 deg/s2",
        sample_rate="50 Hz",
    )
    found = {}
    for label, steps in (("ground", [GroundPickup(rms="50 mK")]), ("alone", [])):
        chain = [
            pointing,
            zonda.WhiteNoise(),
            *steps,
            zonda.Efficiency(),
            GroundFilter(bin="3 arcmin"),
        ]
        data = zonda.Pipeline(chain, precision="float64").run(
            scenes.scene(scenes.camera(7)), keep=("signal",), threads=1
        )
        found[label] = data.observations[0].detdata["signal"]
    left = np.std(found["ground"] - found["alone"])
    # 50 mK over zeta of 0.3; of a slope T' a bin of width w leaves T' w / sqrt(12), T' = rms /
    # (sqrt(2) s) for a lobe of 10 deg
    slope = 0.05 / 0.3 / (np.sqrt(2) * np.radians(10) / np.sqrt(8 * np.log(2)))
    assert left < 3 * slope * np.radians(0.05) / np.sqrt(12)


def test_it_is_a_component_of_its_own():
    pointing = zonda.PointingDaisy(scan_duration="10 s")
    steps = [
        pointing,
        zonda.WhiteNoise(),
        GroundPickup(rms="5 mK"),
        zonda.Efficiency(),
        zonda.BinMap(pixel="8 arcsec"),
    ]
    runs = {"ground": {"only": ["ground"]}, "clean": {"without": ["ground"]}}
    data = zonda.Pipeline(steps, runs=runs).run(scenes.scene(scenes.camera(19)), threads=1)
    whole, ground, clean = (
        data.products[name].signal for name in ("map", "ground/map", "clean/map")
    )
    use = np.isfinite(whole)
    assert np.nanstd(ground) > 0
    np.testing.assert_allclose(
        (ground + clean)[use], whole[use], rtol=0, atol=1e-5 * np.nanmax(np.abs(whole))
    )


@pytest.mark.parametrize("power", [-1.0, 2.0])
def test_the_plan_bounds_it(power):
    from zonda.core.plan.planning import planning_of

    observation = scenes.scan(3, 2000, elevation=40.0)
    step = GroundPickup(rms="1 mK", power=power)
    profile = step.prepare(observation)[1]
    many = [
        GroundPickup(rms="1 mK", power=power, realization=k).prepare(observation)[1][0]
        for k in range(400)
    ]
    bound = planning_of(step).traits(observation).rms * 0.3  # at the detector
    assert np.std(many) <= bound * (1 + 4 / np.sqrt(800))
    assert np.isfinite(profile).all()
