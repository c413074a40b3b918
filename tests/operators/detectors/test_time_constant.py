"""Time constants: the response to waves and steps, whatever the blocks."""

from __future__ import annotations

import numpy as np
import pytest

import zonda
import zonda.testing
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.detectors.time_constant import TAPS, TimeConstant, weights

RATE, N = 100.0, 6000


def act(bench, x, **more):
    given = {
        name: f"{value} s" if isinstance(value, float) else value for name, value in more.items()
    }
    step, observation = TimeConstant(**given), bench.observation(len(x), x.shape[1])
    return bench.run([step], observation, {"signal": x}, precision="float64").signal


@pytest.mark.parametrize("tau", ["0 s", "5 ms", "400 ms"])
def test_it_keeps_the_contract(tau):
    zonda.testing.check_operator(TimeConstant(tau=tau))


@pytest.mark.parametrize("tau", [1e-5, 1e-3, 0.003, 0.02, 0.05, 0.5, 10.0])
@pytest.mark.parametrize("f", [0.1, 2.0, 20.0, 35.0, 46.0])
def test_waves(bench, tau, f):
    """1 / (1 + 2 pi i f tau) within 0.5 %, in amplitude and phase, from time constants far below a
    sample to far above.
    """
    n = N if tau < 1 else 60_000
    t = np.arange(n) / RATE
    x = np.stack([np.cos(2 * np.pi * f * t), np.sin(2 * np.pi * f * t)])
    found = act(bench, x, tau=tau)
    response = 1 / (1 + 2j * np.pi * f * tau)
    later = (t > 30 * tau + 1) & (t < t[-1] - 1)  # the wave is held before and behind the scan
    late = (found[0] + 1j * found[1])[later] / np.exp(2j * np.pi * f * t[later])
    assert np.abs(late / response - 1).max() < 0.005


@pytest.mark.parametrize("tau", [2e-3, 5e-3, 10e-3, 50e-3])
@pytest.mark.parametrize("width", [2.1, 3.0])
@pytest.mark.parametrize("shift", [0.0, 0.37, 0.5])
def test_a_source_of_some_samples(bench, tau, width, shift):
    """A Gaussian of ``width`` samples FWHM: its peak, and all of it, within 0.5 % of the exact
    response to what is sampled.
    """
    sigma = width / np.sqrt(8 * np.log(2)) / RATE
    t = (np.arange(N) - N // 2 - shift) / RATE
    x = np.exp(-(t**2) / 2 / sigma**2)
    expected = np.fft.irfft(
        np.fft.rfft(x) / (1 + 2j * np.pi * np.fft.rfftfreq(N, 1 / RATE) * tau), N
    )
    found = act(bench, x[None], tau=tau)[0]
    assert np.abs(found - expected).max() < 0.005 * expected.max()


def test_the_peak_of_a_fast_detector(bench):
    """2.1 samples FWHM, a time constant of a twentieth of a sample: 1 - (tau / sigma)^2 of the
    peak; straight lines left 0.92.
    """
    sigma = 2.1 / np.sqrt(8 * np.log(2))
    found = act(
        bench, np.exp(-((np.arange(N) - N // 2) ** 2) / 2 / sigma**2)[None], tau=0.05 / RATE
    )[0]
    assert found.max() == pytest.approx(1 - (0.05 / sigma) ** 2, abs=1e-3)


def test_no_time_constant_is_no_filter(bench):
    x = np.random.default_rng(8).standard_normal((2, N))
    np.testing.assert_array_equal(act(bench, x, tau="0 s"), x)


def test_constants_stay_and_the_scan_begins_at_rest(bench):
    x = np.full((2, N), 7.0)
    np.testing.assert_allclose(act(bench, x, tau="1 s"), x, rtol=0, atol=1e-12)


def test_what_it_forgets_is_nothing(bench):
    """Against one recursion over the whole scan: tiles begin anew after e^-23."""
    tau = 0.3
    x = np.random.default_rng(1).standard_normal((3, N)).cumsum(axis=1)
    held = np.pad(x, ((0, 0), (TAPS, TAPS)), mode="edge")
    driven = np.lib.stride_tricks.sliding_window_view(held, 2 * TAPS, axis=1) @ weights(tau * RATE)
    y = x.copy()
    for n in range(1, N):
        y[:, n] = np.exp(-1 / (tau * RATE)) * y[:, n - 1] + driven[:, n]
    np.testing.assert_allclose(act(bench, x, tau=tau), y, rtol=0, atol=1e-9 * np.abs(x).max())


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_same_bits_for_any_blocks(precision):
    """With lost samples within and at the ends of tiles."""
    from zonda.plugins.checks.scenes import camera, scene

    @zonda.operator(name="lose")
    def lose(block):
        for lost in (0, 1, 777, 2047, 2048, 2049, 4400):
            if block.samples.start <= lost < block.samples.stop:
                block.detdata["signal"][1::3, lost - block.samples.start] = np.nan

    steps = [
        zonda.PointingDaisy(scan_duration="60 s"),
        zonda.AtmosphereLayers(pwv="5 mm", layers=1),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        lose,
        zonda.TimeConstant(tau="30 ms", scatter="50 %"),
    ]

    def made(**how):
        return (
            zonda.Pipeline(steps, precision=precision)
            .run(scene(camera(19)), keep=["signal"], **how)
            .tod()
        )

    one = made(threads=1)
    for how in (
        {"threads": 2},
        {"threads": 1, "memory": 5_000_000},
        {"threads": 3, "memory": 15_000_000},
    ):
        np.testing.assert_array_equal(made(**how), one)


def test_the_mean_beside_the_stream_is_part_of_it(bench):
    level = np.array([[30.0], [40.0]])
    x = np.random.default_rng(2).standard_normal((2, N)) * 1e-3
    means = {"signal": SmoothField.constant(level[:, 0], N)}
    step = TimeConstant(tau="0.2 s")
    beside = bench.run(
        [step], bench.observation(2, N), {"signal": x}, means=means, precision="float64"
    ).signal
    np.testing.assert_allclose(beside, act(bench, x + level, tau="0.2 s"), rtol=0, atol=1e-11)


def test_samples_that_are_not_finite_stay_alone(bench):
    x = np.random.default_rng(3).standard_normal((2, N))
    x[1, [0, 100, 2048, 4095]] = np.nan
    np.testing.assert_array_equal(np.isnan(act(bench, x, tau="50 ms")), np.isnan(x))


def test_constants_scatter_between_detectors(bench):
    n = 3000
    one, other = (
        TimeConstant(tau="10 ms", scatter="10 %").constants(bench.observation(n, 10, index=k))
        for k in (0, 1)
    )
    np.testing.assert_array_equal(one, other)  # of the detectors, not of the scan
    spread = np.log(one / 0.01)
    assert spread.std() == pytest.approx(np.log(1.1), rel=4 / np.sqrt(2 * n))
    assert abs(spread.mean()) < 4 * np.log(1.1) / np.sqrt(n)
