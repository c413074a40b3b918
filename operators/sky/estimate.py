"""Bounds and costs of the sky, see `core.plan`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.plan.estimate import Choice, Cost, Effect, Estimate, full, not_simulated

if TYPE_CHECKING:
    from zonda.core.instrument import Band
    from zonda.core.plan.context import Context

    from .skymap import Sky, SkyMap

CUBIC = 3e-3
"""Largest error of cubic B-splines on 4 points per FWHM, of a point source's peak (`SkyMap`)."""

COORDINATES = 5e-4 / 4
"""Error of float32 coordinates, beams (`sampling`)."""

LINEAR = 2 * 8 * math.log(2) / (8 * 16)
"""Error of linear sampling on 4 points per FWHM: h^2 / 8 (f_xx + f_yy) = 2 x 8 ln 2 / (8 x 4^2) of a point source's peak."""


def chromaticity(band: Band) -> float:
    """Relative change of a point source's peak where FWHM ~ 1 / nu: |<(nu / nu_0)^2> - 1| over the band."""
    nu, t = band.frequency, band.transmission
    return abs(float(np.trapezoid(t * (nu / band.centre) ** 2, nu) / np.trapezoid(t, nu)) - 1)


def sky_estimate(operator: SkyMap, context: Context, sky: Sky, reached: bool) -> Estimate:
    """Beam, sampling, chromaticity."""
    o = context.first
    fwhm = float(operator.fwhm or o.focalplane.fwhm.max()) if operator.beam == "gaussian" else 0.0
    points = 2.0 * sky.values.size
    convolution = 6e-7 * points
    cost = Cost(fixed=0.01 + 3e-8 * points, per_time=1e-7, per_sample=11e-9 if reached else 0.3e-9,
                once=convolution if reached else 0.0, bytes=8.0 * sky.values.size + 24.0 * points)  # fmt: skip
    choices = [full("none" if fwhm == 0 else "Gaussian" if reached else "not convolved: no detector reaches the map")]
    if fwhm and reached and context.coverage:
        # a pencil beam changes waves on the map by 1 - exp(-2 pi^2 sigma^2 k^2), most at the pixels' Nyquist frequency
        sigma, k = fwhm / math.sqrt(8 * math.log(2)), 1 / (2 * context.coverage.pixel)
        error = -math.expm1(-2 * math.pi**2 * sigma**2 * k**2)
        text = "1 - exp(-2 pi^2 sigma^2 k^2) at k = 1 / (2 pixel) of the map, of the sky's peak"
        settings = {"beam": "none", "fwhm": None}
        choices.append(Choice("dropped", "no beam", settings, bound=context.sky_error(error), formula=text, seconds=convolution))
    effects = [Effect("beam convolution", tuple(choices), context.sky_error(1.0), "the sky's peak")]
    linear = f"cubic B-spline; linear would err by {LINEAR:.1%} of a point source's peak"
    effects.append(Effect("sampling order", (full(linear),), context.sky_error(CUBIC), "0.3 % of a point source's peak"))
    effects.append(
        Effect("coordinate precision", (full("float32 offsets, float64 origins"),), context.sky_error(1.43 * COORDINATES),
               "1.43 x 5e-4 pixel of a quarter beam")
    )  # fmt: skip
    effects.append(
        not_simulated("beam chromaticity", "one beam for the band", context.sky_error(chromaticity(o.instrument.band)),
                      "|<(nu / nu_0)^2> - 1| over the band: FWHM ~ 1 / nu, a point source's peak")
    )  # fmt: skip
    return Estimate(tuple(effects), cost)
