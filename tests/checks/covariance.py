"""The von Karman covariance and what it becomes behind a beam, against constants of 50-digit
arithmetic.
"""

from __future__ import annotations

import numpy as np

from zonda.core.checks import Family
from zonda.operators.atmosphere.turbulence import covariance

from .cases import FAR, NEAR, OVERLAP

checks = Family("covariance")

# mpmath, 60 digits, printed to 20: 1 - 2^(1-nu)/Gamma(nu) x^nu K_nu(x), nu = 5/6, at the float64
# nearest to x (tests/test_hard_cases.py makes them again)
STRUCTURE = (
    (1e-12, 1.8637406672006313535e-20),
    (1e-10, 4.0141307118437135276e-17),
    (1e-08, 8.6364141079535234284e-14),
    (1e-06, 1.8488906672008838365e-10),
    (0.0001, 3.8656307171588593685e-7),
    (0.001, 0.000017138909052961226618),
    (0.01, 0.00071515160108123572359),
    (0.1, 0.025195012271401549377),
    (0.5, 0.22218340810806403334),
    (1.0, 0.46249868792933430893),
    (1.75, 0.71096338643305999788),
    (1.9999999, 0.76716854422130042214),
    (2.0, 0.76716856451768065918),
    (2.0000001, 0.76716858481405919939),
    (3.0, 0.904554932079273468),
    (5.0, 0.98504476413123799544),
    (10.0, 0.99987548662653757696),
    (20.0, 0.99999999295117530349),
    (35.0, 0.99999999999999741345),
    (50.0, 1.0),
)
CORRELATION = (
    (1e-06, 0.99999999981511093328),
    (0.1, 0.97480498772859845062),
    (1.0, 0.53750131207066569107),
    (1.9999999, 0.23283145577869957786),
    (2.0, 0.23283143548231934082),
    (5.0, 0.01495523586876200456),
    (20.0, 7.0488246965141246068e-9),
    (50.0, 8.8946748561040850085e-22),
    (100.0, 2.1567429526949917079e-43),
    (200.0, 1.0097516240714285641e-86),
    (400.0, 1.75962910513944556e-173),
    (600.0, 2.7870296221622310336e-260),
)
# mpmath quadrature, 30 digits, of the mixture: r [m] and S behind a beam of sigma 42.5 m, r0 = 500
# m
BEHIND_A_BEAM = (
    (1e-06, 4.64380890107764815e-18),
    (0.001, 4.6438089010191057e-12),
    (0.2, 1.85752262373671975e-7),
    (5.0, 0.000116058649737763451),
    (100.0, 0.0414906964760491317),
    (1000.0, 0.718200886127933101),
)


def _worst(found: np.ndarray, expected: np.ndarray) -> float:
    return float(abs(found / expected - 1).max())


@checks.add(NEAR, reference="50-digit arithmetic (mpmath)", limit=1e-13)
def structure_function() -> float:
    """relative error of 1 - C, x from 1e-12 to 50"""
    x, expected = np.array(STRUCTURE).T
    return _worst(covariance.structure(x), expected)


@checks.add(FAR, reference="50-digit arithmetic (mpmath)", limit=3e-13)
def far_tail() -> float:
    """relative error of C, x from 1e-6 to 600, where C is 3e-260"""
    x, expected = np.array(CORRELATION).T
    return _worst(covariance.correlation(x), expected)


@checks.add(FAR, reference="0 <= C <= 1, S >= 0 and not falling", limit=0, unit="values")
def extreme_scales() -> int:
    """values that are not finite or out of order, r from 0 to 1e12 m, r0 from 1e-6 to 1e9 m, beams
    from 1 mm to 1 km
    """
    r = np.r_[0.0, np.geomspace(1e-12, 1e12, 25)]
    wrong = 0
    for outer_scale in (1e-6, 1.0, 1e9):
        for sigma in (1e-3, 1.0, 1e3):
            c, s = (
                covariance.beam_correlation(r, outer_scale, sigma),
                covariance.beam_structure(r, outer_scale, sigma),
            )
            good = (c >= 0) & (c <= 1 + 1e-12) & (s >= 0) & np.isfinite(c) & np.isfinite(s)
            wrong += int((~good).sum() + (np.diff(s) < -1e-15 * s[-1]).sum())
    return wrong


@checks.add(OVERLAP, reference="30-digit quadrature (mpmath)", limit=1e-12)
def behind_a_beam() -> float:
    """relative error of the structure function behind a beam of sigma 42.5 m, r from 1 um to 1
    km
    """
    r, expected = np.array(BEHIND_A_BEAM).T
    return _worst(covariance.beam_structure(r, 500.0, 42.5), expected)
