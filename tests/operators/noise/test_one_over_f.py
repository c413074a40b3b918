from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import least_squares

from zonda.operators.noise.one_over_f import _least_squares, _state_covariance, power_law_filter


def test_least_squares_finds_what_scipys_does() -> None:
    x = np.linspace(0, 3, 40)
    data = 2 * np.exp(-1.3 * x) + 0.3 + 0.01 * np.random.default_rng(0).normal(size=x.size)

    def misfit(p):
        return p[0] * np.exp(-p[1] * x) + p[2] - data

    def jacobian(p):
        return np.stack([np.exp(-p[1] * x), -p[0] * x * np.exp(-p[1] * x), np.ones_like(x)], axis=1)

    start = np.array([1.0, 0.1, 0.0])
    found, theirs = (
        _least_squares(misfit, jacobian, start),
        least_squares(misfit, start, jac=jacobian, method="lm").x,
    )
    # it ends where the misfit changes by 1e-5 of itself: |misfit|^2 is flat there, so x is within
    # some 1e-3 of its error bars
    assert misfit(found) @ misfit(found) == pytest.approx(misfit(theirs) @ misfit(theirs), rel=1e-5)
    np.testing.assert_allclose(found, theirs, rtol=1e-3)


@pytest.mark.parametrize(
    ("f_min", "poles", "percent"),
    [
        (1e-5, 4, 18),
        (1e-5, 8, 1.8),
        (1e-5, 12, 0.22),
        (1e-5, 16, 0.06),
        (1e-7, 6, 15),
        (1e-7, 10, 2.5),
        (1e-7, 16, 0.23),
    ],
)
def test_error_is_that_of_the_table(f_min: float, poles: int, percent: float) -> None:
    assert 100 * power_law_filter(f_min, 1.0, poles).error == pytest.approx(percent, rel=0.05)


@pytest.mark.parametrize("f_min", [1.2e-8, 1e-6, 1e-3, 0.1, 0.43])
@pytest.mark.parametrize(
    ("slope", "percent"), [(0.3, 0.45), (1.2, 0.45), (2.0, 0.45), (2.2, 1.0), (3.0, 1.0)]
)
def test_unusual_slopes_are_within_the_stated_bound(
    f_min: float, slope: float, percent: float
) -> None:
    """On a grid of its own, 40 times as fine as the fit's: what the fit states is what it errs
    by.
    """
    if slope <= 2 and f_min >= 1e-6:
        percent = 0.2
    law = power_law_filter(f_min, slope, 16)
    f = np.r_[np.geomspace(f_min, 0.5, 8001), 0.5 - np.geomspace(1e-9, 0.4 * (0.5 - f_min), 2001)]
    error = np.abs(law.response(f) * (f / f_min) ** slope - 1).max()
    assert error <= percent / 100
    assert error <= law.error + 1e-4
    assert law.plateau < 30  # and what lies below f_min is level, not traded for the band


@pytest.mark.parametrize("f_min", [1e-8, 1e-5, 1e-3, 0.1, 0.43])
@pytest.mark.parametrize("slope", [1.0, 1.5, 2.0, 2.5, 3.0])
@pytest.mark.parametrize("poles", [8, 16])
def test_the_variance_is_that_of_a_spectrum_that_is_flat_below_the_minimum(
    f_min: float, slope: float, poles: int
) -> None:
    """It was 2.4 times as large for slope 2 and 8 poles, 6.3 to 7.5 times for slope 3."""
    law = power_law_filter(f_min, slope, poles)
    f = np.geomspace(f_min, 0.5, 20_001)
    stated = 2 * (f_min + np.trapezoid((f / f_min) ** -slope, f))
    assert law.gain * law.variance == pytest.approx(stated, rel=0.1)
    below = np.r_[np.linspace(0, f_min, 4_000, endpoint=False), f]
    assert 2 * np.trapezoid(law.response(below), below) == pytest.approx(
        law.gain * law.variance, rel=1e-3
    )
    if slope >= 2 and f_min > 1e-6:  # complex pairs: level, but for what is next to the corner
        assert np.abs(law.response(below[below < 0.8 * f_min]) - 1).max() < 0.35


def test_where_the_variance_of_real_poles_is_right_there_are_no_others() -> None:
    """The filters of shipped pipelines, whose bits stay."""
    for f_min in (2.5e-6, 1e-5, 5e-5):
        assert power_law_filter(f_min, 1.0, 8).pair_poles.size == 0


def test_covariance_of_pairs() -> None:
    """As that of the states of equations (2) and (3) written out in real numbers."""
    law = power_law_filter(1e-3, 3.0, 4)
    (n,), taps = law.poles.shape, np.r_[law.zeros - law.poles, law.pairs[:, 2:].ravel()]
    size = n + 2 * len(law.pairs)
    step, drive = np.eye(size), np.ones(size)
    for k in range(n):
        step[k, :k], step[k, k] = taps[:k], 1 - law.poles[k]
    for k, (a, b, *_) in zip(range(n, size, 2), law.pairs, strict=True):
        step[k, :k], drive[k + 1] = taps[:k], 0.0
        step[k : k + 2, k : k + 2] = [[1 - a, b], [-b, 1 - a]]
    expected = solve_discrete_lyapunov(step, np.outer(drive, drive))
    np.testing.assert_allclose(
        law.start @ law.start.T, expected, rtol=1e-5, atol=1e-8 * np.abs(expected).max()
    )
    assert law.variance == pytest.approx(1 + taps @ expected @ taps, rel=1e-6)


def test_covariance_of_the_states() -> None:
    """S = A S A^T + b b^T with A = 1 + D."""
    fit = power_law_filter(1e-3, 1.0, 5)
    n = fit.poles.size
    step = (
        np.eye(n)
        + np.diag(-fit.poles)
        + np.tril(np.broadcast_to(fit.zeros - fit.poles, (n, n)), -1)
    )
    expected = solve_discrete_lyapunov(step, np.ones((n, n)))
    np.testing.assert_allclose(
        _state_covariance(fit.poles, fit.zeros), expected, rtol=1e-8
    )  # 1 / pole^2 of rounding
