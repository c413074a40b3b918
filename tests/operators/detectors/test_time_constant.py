"""Time constants: the response to waves and steps, whatever the blocks."""

from __future__ import annotations

import numpy as np
import pytest

import zonda.testing
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.detectors.time_constant import TimeConstant

RATE, N = 100.0, 6000


def act(bench, x, **more):
    given = {name: f"{value} s" if isinstance(value, float) else value for name, value in more.items()}
    step, observation = TimeConstant(**given), bench.observation(len(x), x.shape[1])
    return bench.run([step], observation, {"signal": x}, precision="float64").signal


@pytest.mark.parametrize("tau", ["0 s", "5 ms", "400 ms"])
def test_it_keeps_the_contract(tau):
    zonda.testing.check_operator(TimeConstant(tau=tau))


@pytest.mark.parametrize("tau", [0.002, 0.05, 0.5])
@pytest.mark.parametrize("f", [0.1, 2.0, 20.0])
def test_waves(bench, tau, f):
    """The wave sampled and joined by straight lines is the sum over n of waves at f + n f_s of amplitude sinc^2(f / f_s + n), n
    any integer; the detector's response to each of them adds up, for sampled again all of them are at f.
    """
    t = np.arange(N) / RATE
    found = act(bench, np.cos(2 * np.pi * f * t)[None], tau=tau)[0]
    alias = f + RATE * np.arange(-400, 401)
    response = np.sum(np.sinc(alias / RATE) ** 2 / (1 + 2j * np.pi * alias * tau))
    later = t > 30 * tau  # the wave begins at t = 0
    expected = (response * np.exp(2j * np.pi * f * t)).real
    np.testing.assert_allclose(found[later], expected[later], rtol=0, atol=1e-6)  # the aliases beyond fall as n^-3
    if f <= 0.03 * RATE:  # what the docstring promises
        assert abs(abs(response) * np.hypot(1, 2 * np.pi * f * tau) - 1) < 2 * (1 - np.sinc(f / RATE) ** 2)


def test_a_step(bench):
    """From 0 to 1 in a straight line between two samples h apart, then 1: 1 - (tau / h) (1 - e^(-h / tau)) e^(-t / tau)."""
    tau, h = 0.05, 1 / RATE
    x = np.zeros((1, N))
    x[0, 3000:] = 1.0
    t = (np.arange(N) - 3000) * h
    expected = np.where(t >= 0, 1 - tau / h * -np.expm1(-h / tau) * np.exp(-np.maximum(t, 0) / tau), 0.0)
    np.testing.assert_allclose(act(bench, x, tau=tau)[0], expected, rtol=0, atol=1e-9)


def test_constants_stay_and_the_scan_begins_at_rest(bench):
    x = np.full((2, N), 7.0)
    np.testing.assert_allclose(act(bench, x, tau="1 s"), x, rtol=0, atol=1e-12)


def test_what_it_forgets_is_nothing(bench):
    """Against one recursion over the whole scan: tiles begin anew after e^-23."""
    tau = 0.3
    x = np.random.default_rng(1).standard_normal((3, N)).cumsum(axis=1)
    r = 1 / (tau * RATE)
    a = np.exp(-r)
    b, c = 1 - (1 - a) / r, (1 - a) / r - a
    y = x.copy()
    for n in range(1, N):
        y[:, n] = a * y[:, n - 1] + b * x[:, n] + c * x[:, n - 1]
    np.testing.assert_allclose(act(bench, x, tau=tau), y, rtol=0, atol=1e-9 * np.abs(x).max())


def test_the_mean_beside_the_stream_is_part_of_it(bench):
    level = np.array([[30.0], [40.0]])
    x = np.random.default_rng(2).standard_normal((2, N)) * 1e-3
    means = {"signal": SmoothField.constant(level[:, 0], N)}
    step = TimeConstant(tau="0.2 s")
    beside = bench.run([step], bench.observation(2, N), {"signal": x}, means=means, precision="float64").signal
    np.testing.assert_allclose(beside, act(bench, x + level, tau="0.2 s"), rtol=0, atol=1e-11)


def test_samples_that_are_not_finite_stay_alone(bench):
    x = np.random.default_rng(3).standard_normal((2, N))
    x[1, [0, 100, 2048, 4095]] = np.nan
    np.testing.assert_array_equal(np.isnan(act(bench, x, tau="50 ms")), np.isnan(x))


def test_constants_scatter_between_detectors(bench):
    n = 3000
    one, other = (TimeConstant(tau="10 ms", scatter="10 %").constants(bench.observation(n, 10, index=k)) for k in (0, 1))
    np.testing.assert_array_equal(one, other)  # of the detectors, not of the scan
    spread = np.log(one / 0.01)
    assert spread.std() == pytest.approx(np.log(1.1), rel=4 / np.sqrt(2 * n))
    assert abs(spread.mean()) < 4 * np.log(1.1) / np.sqrt(n)
