"""Glitches: Poisson arrivals, Campbell's theorem, decay, and samples that are lost."""

from __future__ import annotations

import numpy as np
import pytest

import zonda
import zonda.testing
from zonda.operators.detectors.glitches import Glitches
from zonda.plugins.checks import scenes


def stream(bench, n_det, n_samples, index=0, **parameters):
    step, observation = Glitches(**parameters), bench.observation(n_det, n_samples, index=index)
    return (
        bench.run([step], observation, precision="float64", keep=("glitches",))
        .observations[0]
        .detdata["glitches"]
    )


def test_it_keeps_the_contract():
    zonda.testing.check_operator(Glitches(rate="0.2 Hz", decay="0.3 s"))


def test_arrivals_are_a_poisson_process(bench):
    """Counts have mean and variance rate T; times are uniform; amplitudes exponential."""
    n, rate = 4000, 0.5
    found = Glitches(rate=f"{rate} Hz", decay="1 ms").prepare(bench.observation(n, 2001))
    number, mean = np.array([len(times) for times, _ in found]), rate * (20 + 0.023)
    time, amplitude = (np.concatenate(values) for values in zip(*found, strict=True))
    assert abs(number.mean() - mean) < 4 * np.sqrt(mean / n)
    assert abs(number.var() - mean) < 4 * np.sqrt(
        (mean + 2 * mean**2) / n
    )  # of the variance of Poisson counts
    assert abs(time.mean() - (20 - 0.023) / 2) < 4 * 20 / np.sqrt(12 * len(time))
    assert amplitude.mean() == pytest.approx(0.1, rel=4 / np.sqrt(len(time)))  # rms = mean


def test_campbells_theorem(bench):
    """Mean rate A tau and variance rate A^2 tau (<A^2> = 2 A^2, halved by the decay): from the
    first sample on.
    """
    n, rate, tau = 20000, 5.0, 0.2
    g = stream(bench, n, 130, rate=f"{rate} Hz", amplitude="1 K", decay=f"{tau} s")
    k2, k4 = rate * tau, rate * tau * 6  # cumulants rate tau m! / m
    for t in (0, 60, 129):
        assert abs(g[:, t].mean() - rate * tau) < 4 * np.sqrt(k2 / n)
        assert abs(g[:, t].var() - k2) < 4 * np.sqrt((k4 + 2 * k2**2) / n)


def test_each_is_an_exponential_from_its_arrival_on(bench):
    observation = bench.observation(30, 3000)
    found = Glitches(rate="20 mHz", decay="50 ms").prepare(observation)
    g, t = stream(bench, 30, 3000, rate="20 mHz", decay="50 ms"), observation.seconds
    for d in range(30):
        expected = np.zeros(3000)
        for time, amplitude in zip(*found[d], strict=True):
            late = t - time
            expected += np.where(late >= 0, amplitude * np.exp(-np.maximum(late, 0) / 0.05), 0)
        np.testing.assert_allclose(g[d], expected, rtol=0, atol=1e-9)
    assert g.max() > 0.05


def test_scans_are_independent(bench):
    a, b = (stream(bench, 40, 2000, index=k, rate="0.1 Hz") for k in (0, 1))
    assert not np.array_equal(a, b)


def test_samples_above_a_threshold_are_in_no_map_and_filters_bridge_them():
    """The map without glitches beside it loses the same samples; without the threshold glitches are
    in the map.
    """
    pointing = zonda.PointingDaisy(scan_duration="20 s", radius="1 arcmin", speed="30 arcsec/s")
    maps, lost = {}, 0
    for threshold in (None, "1 mK"):
        glitches = Glitches(rate="0.5 Hz", amplitude="1 K", decay="30 ms", flag_above=threshold)
        filters = [zonda.HighpassFilter(frequency="0.2 Hz"), zonda.BinMap(pixel="8 arcsec")]
        steps = [pointing, glitches, zonda.WhiteNoise(), zonda.Efficiency(), *filters]
        data = zonda.Pipeline(steps, runs={"quiet": {"without": ["glitches"]}}).run(
            scenes.scene(scenes.camera(19)), threads=1
        )
        maps[threshold] = data.products["map"], data.products["quiet/map"]
        text = next(
            (value for who, what, value in data.log if what == "samples lost to glitches"), "0"
        )
        lost = int(str(text).split()[0].replace(",", ""))
    (loud, quiet), (cut, rest) = maps[None], maps["1 mK"]
    assert lost > 500
    assert quiet.hits.sum() - cut.hits.sum() == lost
    np.testing.assert_array_equal(cut.hits, rest.hits)
    use = cut.hits > 20
    assert np.std(cut.signal[use]) < 1.2 * np.std(quiet.signal[use])
    assert np.std(loud.signal[use]) > 2 * np.std(quiet.signal[use])
