"""The noise of a map at a resolution, checked against the difference of its scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from zonda.core.maps.map_product import MapProduct

from .planes import Plane

LEAST = 0.1
"""Share of the 99th percentile of the samples that a pixel needs to take part in the check."""


def with_noise(plane: Plane, product: MapProduct, fwhm: float) -> Plane:
    """A map smoothed to ``fwhm`` [rad] with the noise that its half-difference has there.

    The shape of the noise is that of the product (or 1 / sqrt(samples) where it is not known), smoothed as white noise; where
    there is a half-difference, it is multiplied by the rms of half-difference / noise, smoothed alike, over pixels with at least
    `LEAST` of the samples. So noise that is correlated between pixels counts in full.
    """
    if product.projection != "TAN" or product.contents != "all":
        return plane.smoothed(fwhm)
    known = bool(np.isfinite(product.noise).any())
    with np.errstate(divide="ignore"):
        shape = product.noise if known else np.where(product.known, 1 / np.sqrt(product.hits), np.nan)
    half = product.half_difference
    if half is None:
        return replace(plane, noise=product.noise if known else None).smoothed(fwhm)
    both = replace(plane, values=half, noise=np.where(np.isfinite(half), shape, np.nan)).smoothed(fwhm)
    well = (product.hits >= LEAST * np.percentile(product.hits[product.known], 99)) & np.isfinite(both.values)
    assert both.noise is not None
    factor = float(np.sqrt(np.mean((both.values[well] / both.noise[well]) ** 2))) if well.any() else np.nan
    made = replace(plane, noise=shape).smoothed(fwhm)
    return replace(made, noise=None if made.noise is None or not factor > 0 else made.noise * factor)
