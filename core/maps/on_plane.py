"""HEALPix and CAR maps on a plane, for pictures and comparisons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..numerics.sphere import separation, unit_vectors
from ..types import AnyFloats, Floats
from .map_arrays import MapArrays


def on_plane(
    product: MapArrays,
    planes: Mapping[str, AnyFloats],
    size: int = 400,
) -> tuple[dict[str, AnyFloats], Any]:
    """``planes`` of a TAN map and its astropy WCS; of others on a grid of at most ``size`` x
    ``size`` points of a plane about its centre.

    The plane is the tangent plane, or for maps of more than 60 deg the equal-area one (ZEA); the
    grid reaches as far as the pixels with hits (of a HEALPix map, its pixels). Each point takes the
    value of the pixel it lies in; elsewhere counts (integers) are 0, other planes NaN.
    """
    if product.projection == "TAN":
        return dict(planes), product.wcs
    wcs, (nx, ny) = _plane(product, size)
    x, y = np.meshgrid(np.arange(nx), np.arange(ny))
    world = wcs.pixel_to_world_values(x, y)
    known = np.isfinite(world[0]) & np.isfinite(world[1])
    lon, lat = np.where(known, world, 0.0)
    place = product.grid.pixels_at(unit_vectors(np.radians(lon), np.radians(lat)))
    there = known & (place >= 0)
    found = {}
    for name, values in planes.items():
        flat = values.ravel() if values.size else np.zeros(1, values.dtype)
        found[name] = np.where(there, flat[place], 0 if flat.dtype.kind in "iu" else np.nan)
    return found, wcs


def _positions(product: MapArrays) -> Floats:
    """(2, n) longitudes and latitudes [deg] of the pixels of a list; of an image those with hits,
    all where none has.
    """
    if product.pixels is not None:
        import healpy as hp

        return np.array(hp.pix2ang(product.nside, product.pixels, nest=product.nest, lonlat=True))
    y, x = np.nonzero(product.hits if product.hits.any() else np.ones(product.hits.shape))
    return np.array(product.wcs.wcs_pix2world(x, y, 0))


def _plane(product: MapArrays, size: int) -> tuple[Any, tuple[int, int]]:
    """A WCS about the centre, and the numbers (nx, ny) of points that take in every pixel."""
    from astropy.wcs import WCS

    longitudes, latitudes = _positions(product)
    lon, lat = np.degrees(product.centre)
    apart = separation(np.radians(longitudes), np.radians(latitudes), product.centre)
    far = float(apart.max(initial=0.0)) > math.acos(0.86)
    wcs = WCS(naxis=2)
    axes = ("RA", "DEC") if product.frame == "icrs" else ("GLON", "GLAT")
    wcs.wcs.ctype = [f"{a}{'-' * (8 - len(a) - 3)}{'ZEA' if far else 'TAN'}" for a in axes]
    wcs.wcs.crval = [float(lon), float(lat)]
    wcs.wcs.crpix = [1.0, 1.0]
    wcs.wcs.cdelt = [-1.0, 1.0]
    x, y = wcs.wcs_world2pix(longitudes, latitudes, 0)
    spare = math.degrees(product.pixel)
    places = np.stack([x, y]) if x.size else np.zeros((2, 1))
    low, high = places.min(axis=1) - spare, places.max(axis=1) + spare
    step = float((high - low).max()) / size
    numbers = np.maximum(1, np.ceil((high - low) / step - 1e-9)).astype(int)
    wcs.wcs.cdelt = [-step, step]
    wcs.wcs.crpix = (1 - (low + high) / 2 / step + (numbers - 1) / 2).tolist()
    return wcs, (int(numbers[0]), int(numbers[1]))
