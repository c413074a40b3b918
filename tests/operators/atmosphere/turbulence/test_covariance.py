"""Covariance and structure function against 50-digit arithmetic and against the spectrum."""

from __future__ import annotations

import itertools

import mpmath
import numpy as np
import pytest

from zonda.operators.atmosphere.turbulence.covariance import (
    NU,
    beam_correlation,
    beam_structure,
    correlation,
    mixture,
    mixture_between,
    structure,
)

NU_EXACT = mpmath.mpf(5) / 6


def reference(x: float) -> mpmath.mpf:
    """Equation (1) in 50 digits."""
    with mpmath.workdps(50):
        y = mpmath.mpf(x)
        return (
            mpmath.mpf(2) ** (1 - NU_EXACT)
            / mpmath.gamma(NU_EXACT)
            * y**NU_EXACT
            * mpmath.besselk(NU_EXACT, y)
        )


def test_structure_function_has_no_cancellation() -> None:
    x = np.r_[np.geomspace(1e-12, 50, 200), 1.9999999, 2.0, 2.0000001]
    with mpmath.workdps(50):
        error = [
            float(abs(mpmath.mpf(s) / (1 - reference(v)) - 1))
            for v, s in zip(x, structure(x), strict=True)
        ]
    assert max(error) < 1e-13


def test_correlation_to_the_far_tail() -> None:
    x = np.geomspace(1e-12, 600, 150)
    error = [
        float(abs(mpmath.mpf(c) / reference(v) - 1)) for v, c in zip(x, correlation(x), strict=True)
    ]
    assert max(error) < 1e-13
    assert correlation([0.0, 1e4]).tolist() == [1.0, 0.0]
    assert structure([0.0, 1e4]).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(("sigma", "r"), [(21.0, 0.0), (21.0, 30.0), (42.5, 800.0), (700.0, 800.0)])
def test_beam_convolved_covariance_is_the_hankel_transform_of_the_spectrum(
    sigma: float, r: float
) -> None:
    # C = int k dk / 2 pi P(k) exp(-sigma^2 k^2) J0(k r) with P of equation (2), in units of r0 =
    # 500 m.
    s, x = sigma / 500, r / 500
    edges = sorted({0, 0.3, 1, 3, *(np.arange(1, 9) * max(1.0, 6.5 / s / 8)).tolist()})

    def integrand(k: mpmath.mpf) -> mpmath.mpf:
        return (
            2
            * NU_EXACT
            * k
            * (k * k + 1) ** (-NU_EXACT - 1)
            * mpmath.exp(-((s * k) ** 2))
            * mpmath.besselj(0, k * x)
        )

    with mpmath.workdps(16):
        expected = float(mpmath.quad(integrand, edges))
    assert beam_correlation(r, 500.0, sigma)[0] == pytest.approx(expected, rel=1e-10, abs=1e-13)


def test_beam_structure_keeps_its_precision_between_neighbours() -> None:
    # S = int w(s) (1 - exp(-r^2 / 4e)) / (4 pi e) ds of equation (4), to 30 digits, for lines of
    # sight from 1 um to 1 km apart.
    sigma, outer = 42.5, 500.0
    for r in (1e-6, 0.2, 1e3):
        with mpmath.workdps(30):
            q, b = mpmath.mpf(r / outer) ** 2 / 4, mpmath.mpf(sigma / outer) ** 2

            def integrand(u: mpmath.mpf, q: mpmath.mpf = q, b: mpmath.mpf = b) -> mpmath.mpf:
                e = mpmath.exp(u) + b
                return -mpmath.exp((NU_EXACT + 1) * u - mpmath.exp(u)) * mpmath.expm1(-q / e) / e

            expected = (
                NU_EXACT
                / mpmath.gamma(NU_EXACT + 1)
                * mpmath.quad(integrand, np.arange(-45.0, 5.1, 2.5).tolist())
            )
        assert beam_structure(r, outer, sigma)[0] == pytest.approx(float(expected), rel=1e-12)


def test_vanishing_beam_and_both_halves_agree() -> None:
    r = np.geomspace(1, 5e3, 30)
    np.testing.assert_allclose(beam_correlation(r, 500.0, 1e-9), correlation(r / 500), rtol=1e-12)
    np.testing.assert_array_equal(beam_correlation(r, 500.0, 0.0), correlation(r / 500))
    np.testing.assert_array_equal(beam_structure(r, 500.0, 0.0), structure(r / 500))
    total = beam_correlation(r, 500.0, 21.0) + beam_structure(r, 500.0, 21.0)
    np.testing.assert_allclose(total, beam_correlation(0.0, 500.0, 21.0)[0], rtol=1e-13)


def test_a_cut_mixture_adds_up_to_the_whole() -> None:
    outer, sigma = 500.0, 21.0
    edges = [sigma**2, 60.0**2, 300.0**2, 45 * outer**2 + sigma**2]
    parts = [mixture_between(outer, sigma, a, b) for a, b in itertools.pairwise(edges)]
    variance = sum(float((w / (4 * np.pi * e)).sum()) for e, w in parts)
    assert variance == pytest.approx(beam_correlation(0.0, outer, sigma)[0], rel=1e-11)
    coarse = mixture(outer, sigma, step=0.5, depth=1e-6)[1].sum()
    assert coarse == pytest.approx(variance, rel=5e-8)
    assert pytest.approx(5 / 6) == NU
