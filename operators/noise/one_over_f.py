"""A short recursive filter whose power response is f^-slope from f_min to the Nyquist frequency.

White noise through a cascade of ``poles`` real one-pole sections (z = e^{2 pi i f / f_s})

    H(z) = prod_k (1 - (1 - z_k) / z) / (1 - (1 - q_k) / z),
    g |H(f)|^2 = (f_min / f)^slope  for f >= f_min       (1)

has a power-law spectrum of any length, without periodicity. The poles q_k and zeros z_k (distances
from 1, in (0, 2)) and the gain g are fitted to (1) in discrete time by least squares of the log
response. Each section keeps 1 - pole, which float32 resolves however slow the pole is:

    y = x + (z_k - q_k) s_k,
    s_k <- s_k + (x - q_k s_k)                                                              (2)

A cascade has no cancelling residues, so poles may coincide. Largest error of the PSD from f_min to
Nyquist for slope 1:

=====  =======================  =======================
poles  f_min / f_s = 1e-5       f_min / f_s = 1e-7
=====  =======================  =======================
4      18 %                     37 %
6      5.1 %                    15 %
8      1.8 %                    5.8 %
10     0.7 %                    2.5 %
12     0.22 %                   1.2 %
16     0.06 %                   0.23 %
=====  =======================  =======================

(the rms error is a third of that; the fit in use states its own). Largest over slopes and f_min /
f_s up to 0.45, with 16 poles: 0.25 % for slopes to 2 and f_min / f_s >= 1e-6, 0.45 % down to 1e-8,
1 % for slopes to 3; the last is at f_min itself.

Below f_min the response of real poles levels off, at `plateau` times its value at f_min: a sharp
corner is beyond them. For slope 1 the variance is that of a response that is flat below f_min
within some per cent, where f_min is decades below the Nyquist frequency; for slope 3 it is 5 to 7
times as large. Where it departs by more than `LEVEL`, `PAIRS` pairs of complex poles and zeros are
fitted beside the real ones, which make the corner:

    y = x + 2 Re(r s),   s <- s + (x - q s),
    r = (z - q) (z* - q) / (q* - q)                                          (3)

with q and z complex distances from 1. The response is then flat below f_min within some per cent
(10 % next to it), and the variance right within 2 % with 8 poles or more, 7 % with fewer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zonda.core.errors import InputError
from zonda.core.types import Floats

Complexes = NDArray[np.complex128]

TOLERANCE = 0.25
"""A fit whose PSD errs by more is refused."""

_N_BAND = 200
_N_NYQUIST = 50
_N_BELOW = 12
_N_CORNER = 80
_BELOW, _FEW = 3e-3, 8
"""Weight of the level below f_min with `_FEW` poles or less; with more it takes less of the band's
accuracy.
"""
_SLOWEST = 0.02
"""Lower bound of 2 pi f of a pole, in units of 2 pi f_min."""
_FASTEST = 2.0 - 1e-5
_GOOD, _BETTER, _STEEP = 0.02, 1e-3, 2.0
"""A fit as good as this is not tried again from another first guess: up to `_FEW` poles, with more,
and never above slope 2.
"""
LEVEL = 0.09
"""Relative departure of the variance from that of the law, flat below f_min, from which complex
pairs make the corner.
"""
PAIRS = 2
_BELOW_SHARP = 0.1, 0.02
"""Weights of the level below f_min where complex pairs make the corner: with more than `_SOME`
poles the second is tried first, which takes less of the accuracy above."""
_SOME = 12
_WIDEST = 0.995
"""Largest angle of a root of the power response from the negative axis of 4 sin^2(pi f), in units
of pi.
"""
_RIDGE = 1e-4
"""Weight that keeps poles without influence near where they began."""
_DAMPING, _EVALUATIONS, _CHANGE = 1e-3, 120, 1e-5
"""Of the fit: first damping, as a share of the largest curvature; most steps; relative change of
the misfit that ends it.
"""


@dataclass(frozen=True)
class PowerLawFilter:
    """Poles, zeros and gain of a recursive filter whose power response falls as f^-slope, equation
    (1); `power_law_filter` makes one.

    Attributes
    ----------
    poles, zeros
        (K,) 1 - pole and 1 - zero, by falling pole frequency.
    gain
        g of (1).
    error
        Largest relative error of the power response from f_min to the Nyquist frequency.
    plateau
        Response at f -> 0 over its value at f_min.
    variance
        Of the output for unit white input and unit g.
    """

    poles: Floats
    zeros: Floats
    gain: float
    error: float
    plateau: float
    variance: float
    start: Floats
    """(K, K): stationary states are ``start @ n`` with n (K,) standard normal; K counts two for
    each pair, Re s and Im s.
    """
    pair_poles: Complexes = field(default_factory=lambda: np.zeros(0, np.complex128))
    pair_zeros: Complexes = field(default_factory=lambda: np.zeros(0, np.complex128))
    """(M,) q and z of equation (3)."""

    @property
    def pairs(self) -> Floats:
        """(M, 4): Re q, Im q, and the factors of Re s and Im s in y, of equation (3)."""
        q = self.pair_poles
        r = _residues(self.pair_poles, self.pair_zeros)
        return np.stack([q.real, q.imag, 2 * r.real, -2 * r.imag], axis=1)

    def response(self, frequency: ArrayLike) -> Floats:
        """g |H|^2 at frequencies in units of the sampling rate (0 to 1/2)."""
        sine = 4 * np.sin(np.pi * np.asarray(frequency, np.float64)) ** 2
        log = _log_power(self.zeros, sine).sum(0) - _log_power(self.poles, sine).sum(0)
        if self.pair_poles.size:
            log = log + 2 * (
                _log_power(self.pair_zeros, sine) - _log_power(self.pair_poles, sine)
            ).real.sum(0)
        return np.asarray(self.gain * np.exp(log))


@lru_cache(maxsize=64)
def power_law_filter(f_min: float, slope: float, poles: int) -> PowerLawFilter:
    """Fit equation (1); 0.01 to 0.3 s, kept for later calls.

    Parameters
    ----------
    f_min
        In units of the sampling rate, below 1/2.
    slope
        0 < slope <= 3.
    poles
        Number of sections, at least 2.

    Raises
    ------
    InputError
        When ``f_min`` is not below the Nyquist frequency, or the fit errs by more than `TOLERANCE`.
    """
    if not 0 < f_min < 0.5:
        text = f"minimum_frequency is {2 * f_min:.3g} times the Nyquist frequency"
        raise InputError(text, cure="choose a lower minimum_frequency")
    fits: list[PowerLawFilter] = []
    enough = _GOOD if poles <= _FEW else _BETTER
    for ends in [e for e in (1, 0, 2, 3, 4) if e <= poles - 2]:
        fits.append(_fit(f_min, slope, poles, ends))
        if slope <= _STEEP and (fits[-1].error < enough or ends == 2):
            break
    best = min(fits, key=lambda fit: fit.error)
    if not _is_level(best, f_min, slope):
        best = _sharp(f_min, slope, poles) or best
    if best.error > TOLERANCE:
        raise InputError(
            f"{poles} poles fit f^-{slope:g} from {f_min:.2g} of the sampling rate up only to"
            f" {100 * best.error:.0f} %",
            cure="raise poles or minimum_frequency",
        )
    return best


def _sharp(f_min: float, slope: float, poles: int) -> PowerLawFilter | None:
    """The best fit with complex pairs that is level below f_min; None: none is."""
    few = poles <= _FEW
    for weight in _BELOW_SHARP if poles <= _SOME else _BELOW_SHARP[::-1]:
        fits = [
            _fit(f_min, slope, poles, ends, weight)
            for ends in ((1, 0, 2) if few else (2, 3))
            if ends <= poles - 2
        ]
        if level := [fit for fit in fits if _is_level(fit, f_min, slope)]:
            return min(level, key=lambda fit: fit.error)
    return None


def _log_power(root: Any, sine: Floats) -> Any:
    """ln |1 - (1 - r) / z|^2 = ln(r^2 + (1 - r) 4 sin^2(pi f)) for each r: (K, n).

    The real part of that of a complex r is half of what r and r* make.
    """
    return np.log(root[:, None] ** 2 + (1 - root[:, None]) * sine)


def _is_level(law: PowerLawFilter, f_min: float, slope: float) -> bool:
    """True if the variance is that of a response that is flat below f_min, within `LEVEL`."""
    up = (
        -np.expm1((1 - slope) * np.log(0.5 / f_min)) / (slope - 1)
        if slope != 1
        else np.log(0.5 / f_min)
    )
    return bool(abs(law.gain * law.variance / (2 * f_min * (1 + up)) - 1) < LEVEL)


def _residues(poles: Complexes, zeros: Complexes) -> Complexes:
    """r of equation (3)."""
    return (zeros - poles) * (zeros.conj() - poles) / (poles.conj() - poles)


def _fit(f_min: float, slope: float, n: int, ends: int, sharp: float = 0.0) -> PowerLawFilter:
    """Levenberg-Marquardt from poles in geometric progression, ``ends`` of them at the Nyquist end
    (its cusp needs some).

    ``sharp``: weight of the level below f_min, with `PAIRS` pairs of complex roots, which begin
    there; 0: without any. In v = 4 sin^2(pi f) a pair is |v + R e^(i phi)|^2; ln R and the logit of
    phi / (`_WIDEST` pi) are fitted.
    """
    pairs = PAIRS if sharp else 0
    band = np.geomspace(f_min, 0.5, _N_BAND)
    if pairs:  # beside the corner
        more = f_min * (1 + np.geomspace(1e-4, 0.3, _N_CORNER))
        band = np.sort(np.r_[band, more[more < 0.5]])
    nyquist = 0.5 - np.geomspace(1e-4, 0.4 * (0.5 - f_min), _N_NYQUIST)
    below = f_min * np.geomspace(1e-3, 0.3, _N_BELOW)
    if pairs:
        below = (
            f_min
            * np.r_[np.geomspace(1e-3, 0.5, _N_BELOW), 1 - np.geomspace(0.5, 0.01, 2 * _N_BELOW)]
        )
    frequency = np.r_[band, nyquist, below]
    sine = 4 * np.sin(np.pi * frequency) ** 2
    target = -slope * np.log(np.maximum(frequency / f_min, 1.0))
    below_weight = _BELOW * (_FEW / max(n, _FEW)) ** 3 if slope <= _STEEP else _BELOW
    if pairs:
        below_weight = sharp
    weights = np.repeat([1.0, 0.5, below_weight], [len(band), _N_NYQUIST, len(below)])
    slowest = 2 * np.pi * f_min * _SLOWEST
    span = _FASTEST - slowest

    def roots(x: Floats) -> tuple[Floats, Floats]:
        """Roots within their bounds, and their derivatives."""
        s = 1 / (1 + np.exp(-np.clip(x, -40, 40)))
        return slowest + span * s, span * s * (1 - s)

    first = _first_guess(f_min, slope, n, ends)
    share = np.clip((first - slowest) / span, 1e-9, 1 - 1e-9)
    x0 = np.r_[np.log(share / (1 - share)), 0.0]
    if pairs:
        angles = np.array([[0.95], [0.9]]) - 0.35 * np.arange(pairs) / pairs  # of poles, of zeros
        radius = np.log(4 * np.sin(np.pi * f_min) ** 2) + np.repeat([0.0, 0.5], pairs)
        x0 = np.r_[x0[:-1], radius, np.log(angles / (_WIDEST - angles)).ravel(), 0.0]
    count = np.repeat([-1.0, 1.0], pairs)[:, None]

    def wide(x: Floats) -> tuple[Floats, Floats, Floats]:
        """R, phi, and the derivative of phi, of the pairs' poles and zeros (2 pairs,)."""
        s = 1 / (1 + np.exp(-np.clip(x[2 * n + 2 * pairs : -1], -40, 40)))
        return (
            np.exp(x[2 * n : 2 * n + 2 * pairs]),
            np.pi * _WIDEST * s,
            np.pi * _WIDEST * s * (1 - s),
        )

    def squares(x: Floats) -> Floats:
        """|v + R e^(i phi)|^2 (2 pairs, n)."""
        radius, angle, _ = wide(x)
        return np.asarray(
            sine**2 + (2 * radius * np.cos(angle))[:, None] * sine + radius[:, None] ** 2
        )

    def misfit(x: Floats) -> Floats:
        poles, zeros = roots(x[:n])[0], roots(x[n : 2 * n])[0]
        log_response = _log_power(zeros, sine).sum(0) - _log_power(poles, sine).sum(0) + x[-1]
        if pairs:
            log_response = log_response + (count * np.log(squares(x))).sum(0)
        return np.asarray(np.r_[(log_response - target) * weights, _RIDGE * (x - x0)])

    def jacobian(x: Floats) -> Floats:
        blocks: list[Any] = []
        for sign, part in ((-1, x[:n]), (1, x[n : 2 * n])):
            root, slope_of_root = roots(part)
            r = root[:, None]
            blocks.append(
                sign * ((2 * r - sine) / (r**2 + (1 - r) * sine) * slope_of_root[:, None]).T
            )
        if pairs:
            (radius, angle, turn), each = wide(x), squares(x)
            r = radius[:, None]
            both = count / each
            blocks.append((both * (2 * r * np.cos(angle)[:, None] * sine + 2 * r**2)).T)
            blocks.append((both * (-2 * r * (np.sin(angle) * turn)[:, None] * sine)).T)
        blocks.append(np.ones((frequency.size, 1)))
        return np.vstack([np.hstack(blocks) * weights[:, None], _RIDGE * np.eye(x.size)])

    x0[-1] = -np.mean(misfit(x0)[: len(band)])
    found = _least_squares(misfit, jacobian, x0)
    error = np.abs(
        np.expm1((misfit(found)[: frequency.size] / weights)[: len(band) + _N_NYQUIST])
    ).max()
    poles, zeros = np.sort(roots(found[:n])[0])[::-1], np.sort(roots(found[n : 2 * n])[0])[::-1]
    radius, angle, _ = wide(found)
    both = _of_squares(-radius * np.exp(1j * angle))
    pair_poles = both[:pairs]
    pair_zeros = both[pairs:]
    covariance = _state_covariance(poles, zeros, pair_poles, pair_zeros)
    tap = zeros - poles
    if pairs:
        r = 2 * _residues(pair_poles, pair_zeros)
        tap = np.r_[tap, np.stack([r.real, -r.imag], axis=1).ravel()]
    scale = np.sqrt(np.maximum(np.diag(covariance), 0))
    if not (
        np.diag(covariance) > 0
    ).all():  # so far from the law that its states cannot be told apart
        error = np.inf
        scale = np.ones(len(covariance))
        covariance = np.eye(len(covariance))
    value, vector = np.linalg.eigh(covariance / np.outer(scale, scale))
    gain = float(np.exp(found[-1]) * np.prod(np.abs(1 - pair_poles) / np.abs(1 - pair_zeros)) ** 2)
    return PowerLawFilter(
        poles=poles,
        zeros=zeros,
        gain=gain,
        error=float(error),
        plateau=float(
            gain * np.prod((zeros / poles) ** 2) * np.prod(np.abs(pair_zeros / pair_poles)) ** 4
        ),
        variance=float(1 + tap @ covariance @ tap),
        start=scale[:, None]
        * vector
        * np.sqrt(np.maximum(value, 0)),  # eigenvalues of a correlation: negative by rounding only
        pair_poles=pair_poles,
        pair_zeros=pair_zeros,
    )


def _of_squares(root: Complexes) -> Complexes:
    """The distance q from 1 of the root in the unit circle whose q^2 + (1 - q) v is 0 at v =
    ``root``; Im q > 0.
    """
    half = root / 2
    away = np.sqrt(root * (root / 4 - 1))
    q = np.where(np.abs(1 - half - away) < 1, half + away, half - away)
    return np.asarray(np.where(q.imag < 0, q.conj(), q), np.complex128)


def _least_squares(
    misfit: Callable[[Floats], Floats],
    jacobian: Callable[[Floats], Floats],
    x: Floats,
) -> Floats:
    """Levenberg-Marquardt (Nielsen's damping, Madsen et al. 2004, algorithm 3.16): argmin
    |misfit|^2 from ``x``.
    """
    f = misfit(x)
    j = jacobian(x)
    matrix = j.T @ j
    slope = j.T @ f
    cost = f @ f
    damping = _DAMPING * matrix.diagonal().max()
    raised = 2.0
    for _ in range(_EVALUATIONS):
        step = np.linalg.solve(matrix + damping * np.eye(x.size), -slope)
        f = misfit(x + step)
        gained = cost - f @ f
        promised = step @ (damping * step - slope)
        if gained > 0:
            x, j = x + step, jacobian(x + step)
            matrix = j.T @ j
            slope = j.T @ f
            before = cost
            cost = f @ f
            damping = damping * max(1 / 3, 1 - (2 * gained / promised - 1) ** 3)
            raised = 2.0
            if gained < _CHANGE * before:
                break
        elif promised < _CHANGE * cost:
            break
        else:
            damping = damping * raised
            raised = 2 * raised
    return x


def _first_guess(f_min: float, slope: float, n: int, ends: int) -> Floats:
    """Poles then zeros (2 n,): above slope 2 one pole stands alone, the others alternate with
    zeros.
    """
    alone = int(slope > 2)
    rest = slope - 2 * alone
    chain = n - ends - alone
    bottom = np.pi * f_min
    step = np.log(max(0.75 / bottom, 2.0)) / max(chain, 1)
    pole = bottom * np.exp(step * (np.arange(chain) + 0.5 - rest / 4))
    zero = pole * np.exp(step * rest / 2)
    end = 0.5 * 0.15 ** np.arange(ends)
    lone = np.full(alone, bottom)
    return np.concatenate(
        [
            lone,
            -np.expm1(-pole),
            2 - end,
            np.ones(alone),
            np.minimum(-np.expm1(-zero), 1.1),
            2 - 1.2 * end,
        ]
    )


def _state_covariance(
    poles: Floats,
    zeros: Floats,
    pair_poles: Complexes | None = None,
    pair_zeros: Complexes | None = None,
) -> Floats:
    """Stationary covariance S (K, K) of the states of (2), and behind them of (3), for unit white
    input.

    S = (1 + D) S (1 + D)^T + b b^T. Written with D = A - 1, so that nothing cancels for slow poles.
    A pair counts as s and s*, which do not act on each other.
    """
    n = poles.size
    more = 0 if pair_poles is None else 2 * pair_poles.size
    every: Any = poles
    tap: Any = zeros - poles
    if pair_poles is not None and pair_zeros is not None and more:
        r = _residues(pair_poles, pair_zeros)
        every = np.r_[poles, np.stack([pair_poles, pair_poles.conj()], axis=1).ravel()]
        tap = np.r_[tap, np.stack([r, r.conj()], axis=1).ravel()]
    drift = np.diag(-every) + np.tril(np.broadcast_to(tap, (n + more, n + more)), -1)
    for k in range(n, n + more, 2):
        drift[k + 1, k] = 0
    n += more
    eye = np.eye(n)
    system = -(
        np.kron(drift, eye) + np.kron(eye, drift) + np.kron(drift, drift)
    )  # lower triangular, like drift
    solved = np.ones(n * n, drift.dtype)
    for k in range(n * n):
        solved[k] = (1 - system[k, :k] @ solved[:k]) / system[k, k]
    covariance = solved.reshape(n, n)
    if more:  # of Re s = (s + s*) / 2 and Im s = (s - s*) / 2i
        real = np.eye(n, dtype=np.complex128)
        for k in range(n - more, n, 2):
            real[k : k + 2, k : k + 2] = np.array([[0.5, 0.5], [-0.5j, 0.5j]])
        covariance = (real @ covariance @ real.T).real
    return (covariance + covariance.T) / 2
