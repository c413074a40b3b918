"""A window weighs samples in maps: sources keep their brightness, and the noise is what it says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal.windows import tukey

import zonda
from zonda.core.errors import PipelineError
from zonda.core.pipeline import Pipeline
from zonda.core.scene import Scene
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.filters.taper import MEAN, Taper
from zonda.operators.maps.bin_map import LIGHT, LIGHTEST, BinMap
from zonda.plugins.checks import scenes

N = 6000


def test_it_is_tukeys_window(bench):
    x = np.random.default_rng(0).standard_normal((3, N))
    found = bench.run(
        [Taper(share="30 %")], bench.observation(3, N), {"signal": x}, precision="float64"
    )
    np.testing.assert_allclose(found.signal, x * tukey(N, 0.3), rtol=1e-12)
    np.testing.assert_array_equal(found.observations[0].window, tukey(N, 0.3))


def test_a_map_of_a_constant_is_that_constant(bench):
    """sum W d / sum W; the weights are sums of W, so that the ends of the scan count less. Two
    windows are one, their product.
    """
    plain, once, twice = (
        bench.run(
            [*steps, BinMap(pixel="6 arcsec")],
            bench.observation(7, N),
            {"signal": np.full((7, N), 0.25)},
        ).map
        for steps in ([], [Taper(share="50 %")], [Taper(share="50 %"), Taper(share="30 %")])
    )
    window = tukey(N, 0.5)
    for product, w in ((once, window), (twice, window * tukey(N, 0.3))):
        seen = (
            product.weights > 1e-3 * product.weights.max()
        )  # elsewhere fixed-point steps of the weights show
        np.testing.assert_allclose(product.signal[seen], 0.25, rtol=1e-5)
        assert product.weights.sum() / plain.weights.sum() == pytest.approx(
            w[w >= LIGHTEST].sum() / N, rel=1e-6
        )
        assert product.hits.sum() == 7 * np.count_nonzero(w >= LIGHTEST)


def test_the_noise_of_a_pixel_is_that_of_weighted_samples(bench):
    """White noise of the detectors' NET: map / noise has unit variance, within 4 standard errors
    sqrt(2 / pixels).
    """
    observation = bench.observation(37, 20000)
    rms = observation.focalplane.net[:, None] * np.sqrt(observation.sample_rate)
    x = rms * np.random.default_rng(1).standard_normal((37, 20000))
    product = bench.run(
        [Taper(share="60 %"), BinMap(pixel="6 arcsec")], observation, {"signal": x}
    ).map
    use = product.hits > 20
    n = int(use.sum())
    assert n > 500
    assert abs((product.signal / product.noise)[use].var() - 1) < 4 * np.sqrt(2 / n)


@pytest.mark.parametrize("nside", [None, 8192])
def test_signals_without_filters_are_weighed_alike(nside):
    """Unfiltered, the sky is multiplied by the window in the map alone: both maps are the sky's."""
    grid = {"pixel": "6 arcsec"} if nside is None else {"nside": nside}
    y, x = np.mgrid[-150:151, -150:151]
    with scenes.sky_file(0.01 * np.exp(-0.5 * (x**2 + y**2) / 60.0**2), 4.0) as path:
        steps = [
            zonda.PointingDaisy(scan_duration="20 s"),
            zonda.SkyMap(file=str(path)),
            Taper(share="50 %"),
            BinMap(**grid),
        ]
        scene: Scene = scenes.scene(scenes.camera(19))
        data = Pipeline(steps, runs={"raw": {"only": ["sky"], "filters": "none"}}).run(
            scene, threads=1
        )
    one, other = data.products["map"], data.products["raw/map"]
    use = np.isfinite(one.signal) & (one.weights > 1e-2 * one.weights.max())
    assert use.sum() > 200
    # streams are float32, 6e-8 of 10 mK; the window of unfiltered ones is multiplied in float64
    np.testing.assert_allclose(other.signal[use], one.signal[use], rtol=0, atol=1e-8)


def test_noise_from_the_scatter_is_refused(bench):
    with pytest.raises(PipelineError, match="no window has changed; Taper did"):
        bench.run(
            [Taper(), BinMap(noise="scatter")],
            bench.observation(3, 900),
            {"signal": np.ones((3, 900))},
        )


@pytest.mark.parametrize("before", [[], [HighpassFilter(frequency="0.5 Hz")]])
def test_where_the_window_leaves_nothing_there_is_no_map(bench, before):
    """Pixels so small that some hold the first sample alone, whose window is zero: hits, weight and
    value go together.
    """
    steps = [Taper(share="100 %"), *before, BinMap(pixel="0.5 arcsec", half_difference="halves")]
    run = bench.run(
        steps,
        bench.observation(5, 3000),
        {"signal": np.random.default_rng(1).standard_normal((5, 3000))},
    )
    for product in (run.map, run.map.smoothed(1e-5)):
        np.testing.assert_array_equal(np.isfinite(product.signal), product.hits > 0)
    assert (run.map.weights[run.map.hits > 0] > 0).all()
    assert int(run.log["BinMap", LIGHT]) == np.count_nonzero(tukey(3000, 1.0) < LIGHTEST)


def test_what_is_added_behind_the_window_is_raised_by_ten_at_most(bench):
    """A step behind the window leaves r everywhere: maps divide it by W, and hold nothing of W <
    1/10.
    """
    behind = zonda.operator(lambda block: block.detdata["signal"].__iadd__(1e-3), name="Behind")
    steps = [Taper(share="100 %"), behind, BinMap(pixel="2 arcsec")]
    product = bench.run(steps, bench.observation(5, N), {"signal": np.zeros((5, N))}).map
    largest = np.nanmax(np.abs(product.signal))
    assert (
        5e-3 < largest <= 1e-3 / LIGHTEST * (1 + 1e-4)
    )  # W 1/5 or less is in pixels of its own; weights are in fixed point


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_mean_beside_the_signal_is_multiplied_and_told(precision):
    """W (x + M) whether M stands beside x or in it; the log tells of it, and nothing behind a
    Detrend.
    """

    def steps(*before):
        return [
            zonda.AtmosphereLayers(pwv="5 mm", pwv_rms="1 %"),
            zonda.Efficiency(),
            *before,
            Taper(share="40 %"),
        ]

    whole = zonda.operator(
        lambda block: block.detdata["signal"].__imul__(1.0), name="Whole"
    )  # it does not know of means
    made = [
        scenes.run(chain, scenes.scan(3, 2000), keep=("signal",), precision=precision)
        for chain in (steps(), [*steps(), whole], steps(zonda.Detrend()))
    ]
    eps = float(np.finfo(precision).eps)
    one, other = (data.tod("signal") for data in made[:2])
    level = float(np.abs(one).max())
    assert level > 10
    np.testing.assert_allclose(one, other, rtol=0, atol=4 * level * eps)
    assert abs(one[:, 0]).max() < 4 * level * eps  # the window is zero there
    told = [(str(what), text) for who, what, text in made[0].log if who == "Taper"]
    assert any(what == MEAN for what, _ in told)
    assert any("rounding" in what and "µK" in text for what, text in told)
    assert not any(what == MEAN for who, what, _ in made[2].log if who == "Taper")
