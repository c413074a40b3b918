"""What a map says of itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.sphere import ARCMIN
from zonda.operators.maps.grid import tangent_wcs

ARCSEC = np.pi / 648000


def product(shape, centre=(1.3, 0.3), seed=1):
    rng = np.random.default_rng(seed)
    hits = rng.integers(0, 4, shape)
    signal = np.where(hits > 0, rng.normal(0, 1e-4, shape), np.nan)
    half = np.where(rng.random(shape) < 0.9, rng.normal(0, 1e-4, shape), np.nan)
    wcs = tangent_wcs((1.3, 0.3), 2 * ARCSEC, shape)
    noise = 1e-4 / np.sqrt(np.maximum(hits, 1))
    return MapProduct(
        signal, hits, hits * 1e8, noise, half, wcs.to_header(), centre, 2 * ARCSEC, fwhm=9 * ARCSEC
    )


@pytest.mark.parametrize("of", ["signal", "half_difference"])
@pytest.mark.parametrize("shape", [(120, 90), (31, 30), (8, 100), (1, 1)])
@pytest.mark.parametrize("offset", [0.0, 40 * ARCSEC, 0.1])
def test_the_rms_of_a_smoothed_circle_is_that_of_the_smoothed_map(of, shape, offset):
    made = product(shape, (1.3, 0.3 + offset))
    whole = made.smoothed(made.fwhm).rms(0.25 * ARCMIN, of)
    assert made.smoothed_rms(made.fwhm, 0.25 * ARCMIN, of) == pytest.approx(
        whole, rel=1e-12, nan_ok=True
    )
    assert np.isnan(whole) == (offset == 0.1 or (offset > 0 and shape[0] < 30))


def test_a_map_without_a_half_difference_has_no_rms_of_it():
    with pytest.raises(Exception, match="no half-difference"):
        replace(product((20, 20)), half_difference=None).smoothed_rms(
            9 * ARCSEC, of="half_difference"
        )
