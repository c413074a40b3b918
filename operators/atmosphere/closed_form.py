"""The power spectrum of the atmosphere's fluctuation in closed form: frozen layers that drift
through the beams.

A layer of covariance C(r) = sum_i w_i exp(-r^2 / 4 e_i) behind a Gaussian beam
(`turbulence.covariance`, equation 4) that passes a line of sight at the speed V has the one-sided
spectrum

    S(f) = 2 int C(V t) cos(2 pi f t) dt
         = (2 / V) sum_i w_i (4 pi e_i)^(1/2) exp(-e_i (2 pi f / V)^2)  (1)

and behind an aperture with a rim, of transform B (`turbulence.beams`), with the two-dimensional
spectrum P,

    S(f) = (2 / V) (1 / pi) int_0^inf P(k) B(k)^2 dq,
    k^2 = (2 pi f / V)^2 + q^2.                                   (2)

The relative fluctuation of the PWV has p^2 sum_l a_l^2 <S_l>, the mean over the speeds of the scan:
this holds above the frequencies of the scan itself. The emission on the calibrated sky has p^2
sum_l kappa_l^2 a_l^2 <S_l> (`response`) times (epsilon dT / dy / (zeta e^-tau))^2, y small.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from zonda.core.observation import Observation
from zonda.core.types import Floats

from .model import AtmosphereModel
from .resolution import layer_speeds
from .turbulence.covariance import NU, mixture
from .turbulence.nodes import Layer

SLOWEST = 1e-4
"""Lowest speed of a layer whose spectrum is computed, m/s."""
NODES = 1500
"""Of the integral over q in equation (2)."""
KNOTS = 160
"""Frequencies at which a longer spectrum is evaluated; between them it is linear in log-log. Behind
a Gaussian beam of 100 m that errs by 0.2 % where the power is 1e-4 of the largest, by 0.4 % at
1e-6."""
WAVE_NUMBERS = 640
"""As `KNOTS`, of one layer's spectrum along a line, which many speeds share. The error is that of
`KNOTS` times (160 / 640)^2.
"""


def layer_spectrum(layer: Layer, frequency: Floats, speeds: Floats) -> Floats:
    """Mean of equation (1) or (2) over ``speeds`` [m/s], of a layer of unit variance before the
    beam: (n,) 1/Hz.
    """
    v = np.maximum(speeds, SLOWEST)[:, None]
    along = between_knots(_along(layer), (2 * np.pi * frequency / v).ravel(), WAVE_NUMBERS)
    return np.asarray((2 / v * along.reshape(len(v), -1)).mean(axis=0), np.float64)


def _along(layer: Layer) -> Callable[[Floats], Floats]:
    """The layer's spectrum along a line, int C(r) cos(k r) dr: (n,) m of k (n,) in rad/m."""
    if layer.aperture is None:
        e, w = mixture(layer.outer_scale, layer.sigma, 0.5, 1e-6)
        weights = w * np.sqrt(4 * np.pi * e)
        return lambda k: np.asarray(np.exp(-np.multiply.outer(k * k, e)) @ weights, np.float64)
    known = np.geomspace(1e-3 / layer.outer_scale, 400 / layer.aperture.diameter, 200)
    q = np.concatenate(
        [[0.0], np.geomspace(1e-4 / layer.outer_scale, 400 / layer.aperture.diameter, NODES)]
    )
    table = np.empty(known.size)
    for n, own in enumerate(known):
        square = own**2 + q * q
        power = (
            4
            * np.pi
            * NU
            * layer.outer_scale ** (-2 * NU)
            * (square + layer.outer_scale**-2) ** (-NU - 1)
        )
        table[n] = np.trapezoid(power * layer.aperture.transform(np.sqrt(square)) ** 2, q) / np.pi

    def along(k: Floats) -> Floats:
        found = np.exp(np.interp(np.log(np.maximum(k, known[0])), np.log(known), np.log(table)))
        return np.where(k <= known[-1], found, 0.0)

    return along


def closed_form(
    model: AtmosphereModel,
    observation: Observation,
) -> Callable[[Floats], Floats] | None:
    """The spectrum of ``atmosphere`` on the calibrated sky, K_RJ^2/Hz, as a function of the
    frequency [Hz].

    None where the PWV is log-normal, for which there is no closed form.
    """
    if model.fluctuation.log_normal:
        return None

    def spectrum(frequency: Floats) -> Floats:
        speeds = layer_speeds(observation, model.plane, model.layers)
        parts = (
            model.emitting[k].amplitude ** 2 * layer_spectrum(model.layers[k], frequency, speeds[k])
            for k in model.simulated
        )
        return np.asarray(
            _emission_per_fluctuation(model, observation) ** 2
            * model.fluctuation.scale**2
            * sum(parts)
        )

    return lambda frequency: between_knots(spectrum, frequency)


def between_knots(
    law: Callable[[Floats], Floats],
    frequency: Floats,
    number: int = KNOTS,
) -> Floats:
    """A spectrum that is smooth in log-log at frequencies (n,) >= 0 [Hz], evaluated at ``number``
    of them if there are more.
    """
    positive = frequency[frequency > 0]
    if positive.size <= number:
        return law(frequency)
    knots = np.geomspace(positive.min(), positive.max(), number)
    values = np.log(np.maximum(law(knots), np.finfo(np.float64).tiny))
    found = np.exp(np.interp(np.log(np.maximum(frequency, knots[0])), np.log(knots), values))
    return (
        np.where(frequency > 0, found, law(np.zeros(1)))
        if positive.size < frequency.size
        else np.asarray(found)
    )


def _emission_per_fluctuation(model: AtmosphereModel, observation: Observation) -> float:
    """epsilon dT/dy / (zeta e^-tau) at the scan's mean elevation, rms over detectors that are not
    flagged, K_RJ.
    """
    elevation = np.array([float(np.mean(observation.elevation))])
    y = 1e-3
    rise = (
        float(model.band.emission_difference(model.pwv, np.array([model.pwv * y]), elevation)[0])
        / y
    )
    transmission = float(model.band.transmission(model.pwv, elevation[0]))
    plane, good = observation.focalplane, observation.good_detectors
    ratio = plane.illumination_efficiency[good] / plane.main_beam_efficiency[good]
    return rise / transmission * math.sqrt(float(np.mean(ratio**2)))
