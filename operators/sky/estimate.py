"""Bounds and costs of the sky, see `core.plan`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.plan.estimate import Choice, Cost, Effect, Estimate, full, not_simulated

if TYPE_CHECKING:
    from zonda.core.instrument import Band
    from zonda.core.plan.context import Context

    from .skymap import SkyMap
    from .working import Working

CUBIC = 3e-3
"""Largest error of cubic B-splines on 4 points per FWHM, of a point source's peak (`SkyMap`)."""

COORDINATES = 5e-4 / 4
"""Error of float32 coordinates, beams (`sampling`)."""

LINEAR = 1.1 * 2 * 8 * math.log(2) / 12
"""Times n^-2: error of linear sampling on n points per FWHM, of a point source's peak: 1.1 h^2 / 12 (|f_xx| + |f_yy|)."""

FASTER = 1.6e-9
"""Seconds per sample that linear sampling saves."""


def chromaticity(band: Band) -> float:
    """Relative change of a point source's peak where FWHM ~ 1 / nu: |<(nu / nu_0)^2> - 1| over the band."""
    nu, t = band.frequency, band.transmission
    return abs(float(np.trapezoid(t * (nu / band.centre) ** 2, nu) / np.trapezoid(t, nu)) - 1)


def sky_estimate(operator: SkyMap, context: Context, grids: list[Working], reached: bool) -> Estimate:
    """Beam, sampling, chromaticity. ``grids``: of each observation."""
    sky, distinct = grids[0], {w.key: w for w in grids}
    o = context.first
    fwhm = float(operator.fwhm or o.focalplane.fwhm.max()) if operator.beam == "gaussian" else 0.0
    size = float(np.prod(sky.shape))
    points = 2.0 * size
    convolution = 6e-7 * sum(2.0 * float(np.prod(w.shape)) for w in distinct.values())
    made = sky.seconds + sum(w.interpolation for k, w in distinct.items() if k != sky.key)
    cost = Cost(fixed=0.01 + 3e-8 * points, per_time=5e-8, per_sample=5e-9 if reached else 0.3e-9,
                once=made + (convolution if reached else 0.0), bytes=8.0 * size + 24.0 * points)  # fmt: skip
    choices = [full("none" if fwhm == 0 else "Gaussian" if reached else "not convolved: no detector reaches the map")]
    if fwhm and reached and context.coverage:
        # a pencil beam changes waves on the map by 1 - exp(-2 pi^2 sigma^2 k^2), most at the pixels' Nyquist frequency
        sigma, k = fwhm / math.sqrt(8 * math.log(2)), 1 / (2 * context.coverage.pixel)
        error = -math.expm1(-2 * math.pi**2 * sigma**2 * k**2)
        text = "1 - exp(-2 pi^2 sigma^2 k^2) at k = 1 / (2 pixel) of the map, of the sky's peak"
        settings = {"beam": "none", "fwhm": None}
        bound = context.sky_error(error)
        bound["transfer"] = math.expm1(min(2 * math.pi**2 * sigma**2 * k**2, 700.0))  # of the waves under the beam
        choices.append(Choice("dropped", "no beam", settings, bound=bound, formula=text, seconds=convolution))
    effects = [Effect("beam convolution", tuple(choices), context.sky_error(1.0), "the sky's peak")]
    effects.append(_order(operator, context, sky, fwhm if reached else 0.0))
    effects.append(
        Effect("coordinate precision", (full("float32 offsets, float64 origins"),), context.sky_error(1.43 * COORDINATES),
               "1.43 x 5e-4 pixel of a quarter beam")
    )  # fmt: skip
    effects.append(
        not_simulated("beam chromaticity", "one beam for the band", context.sky_error(chromaticity(o.instrument.band)),
                      "|<(nu / nu_0)^2> - 1| over the band: FWHM ~ 1 / nu, a point source's peak")
    )  # fmt: skip
    return Estimate(tuple(effects), cost)


def _order(operator: SkyMap, context: Context, sky: Working, fwhm: float) -> Effect:
    """Linear sampling for cubic splines: on the grid there is, or on one twice as fine."""
    cubic = context.sky_error(CUBIC)
    if operator.interpolation == "linear" or not fwhm:
        what = "linear" if operator.interpolation == "linear" else "cubic B-spline"
        return Effect("sampling order", (full(what),), cubic, "0.3 % of a point source's peak")
    step = math.radians(math.sqrt(abs(float(np.linalg.det(sky.wcs.pixel_scale_matrix)))))
    points = fwhm / step
    n = points * (math.ceil(operator.pixels_per_fwhm / points - 1e-9) if 2 <= points < operator.pixels_per_fwhm else 1)
    runs, saved = max(context.runs.get(operator.label, 1), 1), FASTER * context.samples
    text = "1.1 h^2 / 12 (|f_xx| + |f_yy|) of a point source on n points h apart per FWHM: 1.02 / n^2 of its peak"
    choices = [full("cubic B-spline")]
    wanted = 2 * points * math.ceil(n / points - 1e-9)
    if points >= 2 and wanted <= 16:  # the finest grid that the operator makes
        dearer = 6e-7 * 2.0 * float(np.prod(sky.shape)) * 3 / runs
        settings = {"interpolation": "linear", "pixels_per_fwhm": min(wanted, 16.0)}
        bound = context.sky_error(LINEAR / wanted**2)
        choices.append(
            Choice("coarse", "linear, on twice as fine a grid", settings, bound=bound, formula=text, seconds=saved - dearer)
        )
    bound = context.sky_error(LINEAR / n**2)
    choices.append(Choice("coarse", "linear", {"interpolation": "linear"}, bound=bound, formula=text, seconds=saved))
    return Effect("sampling order", tuple(choices), bound, text)
