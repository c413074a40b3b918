"""What several metrics need of the products of a run."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Data
from zonda.core.errors import InputError, PipelineError
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.angles import FWHM_PER_SIGMA
from zonda.core.numerics.projection import wcs_frame_rotation
from zonda.core.signal import Signal, product_name, stream_of
from zonda.core.types import Floats

COVERED = 0.1
"""Share of the 99th percentile of the hits from which a pixel counts as covered."""

SKY_ALONE = Signal(only=["sky"])
UNFILTERED = Signal(only=["sky"], filters="none")


def map_of(data: Data, metric: str, signal: str = "", name: str = "map") -> MapProduct:
    """The map ``name`` of a signal (empty: the complete one); else an InputError about ``metric``."""
    product = data.products.get(product_name(stream_of(signal), name))
    if not isinstance(product, MapProduct):
        there = ", ".join(sorted(key for key, p in data.products.items() if isinstance(p, MapProduct))) or "none"
        wanted = product_name(stream_of(signal), name)
        raise InputError(f"there is no map {wanted!r}", place=metric, cure=f"the maps of this run: {there}")
    if product.contents == "hits":
        raise InputError(f"the map {name!r} counts samples and has no signal", place=metric, cure="leave contents: hits out")
    return product


def at_beam(product: MapProduct, fwhm: float | None = None) -> MapProduct:
    """A map smoothed with its beam, or with ``fwhm`` [rad] where that is given; one that was smoothed when it was made stays."""
    width = product.fwhm if fwhm is None else fwhm
    return product if product.smoothed_by or not width else product.smoothed(width)


def covered(product: MapProduct) -> NDArray[np.bool_]:
    """Where a map has a value and at least `COVERED` of the usual samples."""
    seen = product.hits[product.known]
    least = COVERED * float(np.percentile(seen, 99)) if seen.size else 1.0
    return np.asarray(np.isfinite(product.signal) & (product.hits >= max(least, 1e-9)))


def as_seen(image: Image, product: MapProduct, fwhm: float | None = None) -> Floats:
    """The input map, smoothed with a Gaussian (``fwhm`` [rad]; the beam), at the centres of the map's pixels."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    width = product.fwhm if fwhm is None else fwhm
    scale = np.radians(np.sqrt(abs(np.linalg.det(image.wcs.pixel_scale_matrix))))
    smooth = gaussian_filter(np.nan_to_num(image.values), width / FWHM_PER_SIGMA / scale)
    rows, columns = np.indices(product.signal.shape)
    lon, lat = np.radians(product.wcs.pixel_to_world_values(columns, rows))
    directions = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    directions = directions @ wcs_frame_rotation(product.wcs) @ wcs_frame_rotation(image.wcs).T  # either may be galactic
    lon, lat = np.arctan2(directions[..., 1], directions[..., 0]), np.arcsin(np.clip(directions[..., 2], -1, 1))
    x, y = image.wcs.world_to_pixel_values(np.degrees(lon), np.degrees(lat))
    return np.asarray(map_coordinates(smooth, [y, x], order=1), np.float64)


def extreme(values: Floats, where: NDArray[np.bool_], metric: str) -> tuple[int, float]:
    """(flat index, value) of the largest absolute value; InputError about ``metric`` where there is none."""
    if not where.any():
        cure = "map a larger field, or choose a larger radius"
        raise InputError("no pixel has enough samples", place=metric, cure=cure)
    index = int(np.argmax(np.where(where, abs(values), -1.0)))
    return index, float(values.flat[index])


def relative_error_of_rms(product: MapProduct, where: NDArray[np.bool_]) -> float:
    """Standard error of a weighted rms over pixels, relative, of white noise behind the smoothing of the map:

        (2 N)^(-1/2),   N = (sum w)^2 / sum_ij w_i w_j rho_ij^2,   rho = exp(-d^2 / 4 sigma^2)

    sigma that of the smoothing. HEALPix and CAR: N is the area divided by 2 pi sigma^2. NaN without pixels.
    """
    from zonda.core.numerics.transforms import convolved, gaussian_taps

    w = np.where(where & np.isfinite(product.signal), product.weights, 0.0)
    if not w.any():
        return math.nan
    sigma = product.smoothed_by / FWHM_PER_SIGMA / product.pixel
    per_cell = 2 * math.pi * sigma**2
    if product.projection != "TAN":
        area = float(np.broadcast_to(product.areas(), w.shape)[w != 0].sum())
        independent = min(area / product.pixel**2 / per_cell if per_cell else np.inf, float(np.count_nonzero(w)))
    else:
        rows, columns = np.flatnonzero(w.any(axis=1)), np.flatnonzero(w.any(axis=0))
        w = w[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        pairs = per_cell * float((w * convolved(w, gaussian_taps(sigma))).sum()) if per_cell > 1 else float((w * w).sum())
        independent = float(w.sum()) ** 2 / pairs
    return 1 / math.sqrt(2 * independent)


def flat(product: MapProduct, metric: str) -> MapProduct:
    """A TAN map; PipelineError about ``metric`` for another."""
    if product.projection != "TAN":
        raise PipelineError(f"{metric} needs a TAN map", place=metric, cure="leave BinMap.nside and projection out")
    return product


def input_of(data: Data, metric: str) -> Image:
    """The input map that a `SkyMap` kept; InputError about ``metric`` where there is none."""
    image = next((p for p in data.products.values() if isinstance(p, Image)), None)
    if image is None:
        raise InputError("no step kept the input map", place=metric, cure="use a SkyMap")
    return image
