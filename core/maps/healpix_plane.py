"""HEALPix maps on a plane, for pictures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..types import AnyFloats
from .map_arrays import MapArrays


def on_plane(product: MapArrays, planes: Mapping[str, AnyFloats], size: int = 400) -> tuple[dict[str, AnyFloats], Any]:
    """``planes`` (n_pixel,) on a grid of at most ``size`` x ``size`` points of a plane about the map's centre; its astropy WCS.

    The plane is the tangent plane, or for maps of more than 60 deg the equal-area one (ZEA); the grid reaches as far as the
    pixels. Each point takes the value of the HEALPix pixel it lies in; elsewhere ``hits`` are 0, other planes NaN.
    """
    import healpy as hp

    assert product.pixels is not None
    wcs, (nx, ny) = _plane(product, size)
    x, y = np.meshgrid(np.arange(nx), np.arange(ny))
    world = wcs.pixel_to_world_values(x, y)
    known = np.isfinite(world[0]) & np.isfinite(world[1])
    lon, lat = np.where(known, world, 0.0)
    wanted = np.where(known, hp.ang2pix(product.nside, lon, lat, nest=product.nest, lonlat=True), -1)
    place = np.clip(np.searchsorted(product.pixels, wanted), 0, len(product.pixels) - 1)
    there = product.pixels[place] == wanted
    return {k: np.where(there, v[place], 0 if k == "hits" else np.nan) for k, v in planes.items()}, wcs


def _plane(product: MapArrays, size: int) -> tuple[Any, tuple[int, int]]:
    """A WCS about the centre, and the numbers (nx, ny) of points that take in every pixel."""
    import healpy as hp
    from astropy.wcs import WCS

    lon, lat = np.degrees(product.centre)
    directions = np.array(hp.pix2vec(product.nside, product.pixels, nest=product.nest))
    far = float((hp.ang2vec(lon, lat, lonlat=True) @ directions).min(initial=1.0)) < 0.86
    wcs = WCS(naxis=2)
    axes = ("RA", "DEC") if product.frame == "icrs" else ("GLON", "GLAT")
    wcs.wcs.ctype = [f"{a}{'-' * (8 - len(a) - 3)}{'ZEA' if far else 'TAN'}" for a in axes]
    wcs.wcs.crval = [float(lon), float(lat)]
    wcs.wcs.crpix = [1.0, 1.0]
    wcs.wcs.cdelt = [-1.0, 1.0]
    x, y = wcs.wcs_world2pix(*hp.pix2ang(product.nside, product.pixels, nest=product.nest, lonlat=True), 0)
    spare = np.degrees(hp.nside2resol(product.nside))
    places = np.stack([x, y]) if x.size else np.zeros((2, 1))
    low, high = places.min(axis=1) - spare, places.max(axis=1) + spare
    step = float((high - low).max()) / size
    numbers = np.maximum(1, np.ceil((high - low) / step - 1e-9)).astype(int)
    wcs.wcs.cdelt = [-step, step]
    wcs.wcs.crpix = (1 - (low + high) / 2 / step + (numbers - 1) / 2).tolist()
    return wcs, (int(numbers[0]), int(numbers[1]))
