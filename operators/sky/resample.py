"""Bringing maps that are not gnomonic (other projections, HEALPix) onto a gnomonic grid about the observation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.numerics.projection import pixel_matrix, wcs_frame_rotation

from .inputs import HealpixMap, WcsMap

Floats = NDArray[np.float64]

WIDEST = np.radians(60.0)
"""Largest radius of a working grid: beyond it a gnomonic projection stretches pixels by more than 1 / cos^2 = 4."""
MOST_PIXELS = 2**27
NEIGHBOURS = 24
"""HEALPix pixels in each local fit: two rings and a few more."""
ROWS = 64


def tangent_wcs(ra: float, dec: float, radius: float, step: float, place: str = "") -> Any:
    """A square north-up TAN `WCS` (ICRS) about (ra, dec) that holds ``radius``; `pixel_shape` is set. All in rad.

    Raises InputError where the radius or the number of pixels is too large.
    """
    from astropy.wcs import WCS

    if radius > WIDEST:
        raise InputError(
            f"the scan reaches {np.degrees(radius):.0f} deg from its centre; a map that must be resampled serves up to "
            f"{np.degrees(WIDEST):.0f} deg",
            place=place,
            cure="scan a smaller field, or give a TAN map",
        )
    size = 2 * int(np.ceil(np.tan(radius) / step)) + 1
    if size * size > MOST_PIXELS:
        raise InputError(
            f"the working grid would have {size} x {size} pixels",
            place=place,
            cure="scan a smaller field, or give a TAN map of it",
        )
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [np.degrees(ra), np.degrees(dec)]
    wcs.wcs.crpix = [(size + 1) / 2, (size + 1) / 2]
    wcs.wcs.cdelt = [-np.degrees(step), np.degrees(step)]
    wcs.wcs.radesys = "ICRS"
    wcs.pixel_shape = (size, size)
    wcs.wcs.set()
    return wcs


def directions(wcs: Any, first: int, last: int) -> Floats:
    """ICRS unit vectors (last - first, nx, 3) of the pixel centres in rows first .. last - 1 of a TAN ``wcs``."""
    nx = wcs.pixel_shape[0]
    y, x = np.mgrid[first:last, 0:nx].astype(np.float64)
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ np.linalg.inv(pixel_matrix(wcs)).T
    return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


def resample_image(image: WcsMap, target: Any) -> tuple[Floats, NDArray[np.bool_]]:
    """(values, covered) of an image on the TAN grid ``target``, by cubic B-splines. NaN-free: not covered is 0.

    A cylindrical map that goes round the sky is joined at its seam.
    """
    from scipy.ndimage import map_coordinates, spline_filter

    coordinates = _coordinates(image)
    rows, columns = image.values.shape
    period = _period(image.wcs)
    wrap = 12 if period and abs(columns - period) < 0.5 else 0
    source = np.pad(image.values, ((0, 0), (wrap, wrap)), mode="wrap") if wrap else image.values
    coefficients = spline_filter(source, 3, mode="mirror")
    nx, ny = target.pixel_shape
    values, covered = np.zeros((ny, nx)), np.zeros((ny, nx), bool)
    for first in range(0, ny, ROWS):
        last = min(first + ROWS, ny)
        d = directions(target, first, last)
        x, y = _to_pixels(image.wcs, *coordinates(d))
        if period:
            x = (x + 0.5) % period - 0.5
        inside = (x >= -0.5) & (x < columns - 0.5) & (y >= -0.5) & (y < rows - 0.5)
        at = np.array([np.where(inside, y, 0.0), np.where(inside, x + wrap, 0.0)])
        values[first:last] = np.where(inside, map_coordinates(coefficients, at, order=3, prefilter=False, mode="mirror"), 0.0)
        covered[first:last] = inside
    return values, covered


def _coordinates(image: WcsMap) -> Callable[[Floats], tuple[Floats, Floats]]:
    """From ICRS directions (..., 3) to the (lon, lat) [deg] in the frame of the image's WCS at which it is looked up."""
    turn = image.turn
    if turn is None:
        try:
            turn = wcs_frame_rotation(image.wcs)
        except InputError:  # FK4 is no rotation of ICRS
            return lambda d: _by_astropy(image.wcs, d)

    def found(d: Floats) -> tuple[Floats, Floats]:
        x, y, z = np.moveaxis(d @ turn.T, -1, 0)
        return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, np.hypot(x, y)))

    return found


def _by_astropy(wcs: Any, d: Floats) -> tuple[Floats, Floats]:
    from astropy.coordinates import SkyCoord
    from astropy.wcs.utils import wcs_to_celestial_frame

    frame = wcs_to_celestial_frame(wcs)
    sky = SkyCoord(*np.moveaxis(d, -1, 0), representation_type="cartesian", frame="icrs").transform_to(frame).spherical
    return np.asarray(sky.lon.deg), np.asarray(sky.lat.deg)


def _to_pixels(wcs: Any, lon: Floats, lat: Floats) -> tuple[Floats, Floats]:
    """0-based pixels of native (lon, lat) [deg]; NaN where the projection has none."""
    pair = (lon, lat) if wcs.wcs.lng == 0 else (lat, lon)
    if wcs.has_distortion:
        x, y = wcs.all_world2pix(*pair, 0, quiet=True)
    else:
        x, y = wcs.wcs_world2pix(*pair, 0)
    return np.asarray(x), np.asarray(y)


def _period(wcs: Any) -> float | None:
    """Columns in a full turn of a cylindrical projection whose first axis is longitude; None for others."""
    matrix = wcs.pixel_scale_matrix
    if str(wcs.wcs.ctype[0])[-3:] not in ("CAR", "CEA", "MER", "CYP") or wcs.wcs.lng != 0 or matrix[0, 1] or matrix[1, 0]:
        return None
    return float(360.0 / abs(matrix[0, 0]))


def pixel_areas(wcs: Any, shape: tuple[int, int]) -> Floats:
    """Solid angles (ny, nx) [sr] of the pixels of any projection, by the edges' midpoints; NaN beyond the projection."""
    rows, columns = shape
    areas = np.empty(shape)
    for first in range(0, rows, ROWS):
        last = min(first + ROWS, rows)
        y, x = np.mgrid[first:last, 0:columns].astype(np.float64)

        def ray(dx: float, dy: float, x: Floats = x, y: Floats = y) -> Floats:
            lon, lat = (np.radians(c) for c in from_pixels(wcs, x + dx, y + dy))
            return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=2)

        h = 0.25
        across, along = ray(h, 0.0) - ray(-h, 0.0), ray(0.0, h) - ray(0.0, -h)
        areas[first:last] = np.linalg.norm(np.cross(across, along), axis=2) / (2 * h) ** 2
    return areas


def from_pixels(wcs: Any, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Native (lon, lat) [deg] of 0-based pixels; NaN beyond the projection."""
    pair = wcs.all_pix2world(x, y, 0)
    lon, lat = pair if wcs.wcs.lng == 0 else pair[::-1]
    return np.asarray(lon), np.asarray(lat)


def resample_healpix(sky: HealpixMap, target: Any) -> tuple[Floats, NDArray[np.bool_], int]:
    """(values, covered, poor) of a HEALPix map on the TAN grid ``target``. A grid point is covered where its HEALPix pixel is.

    Each value comes from the polynomial of third degree that best fits the `NEIGHBOURS` nearest covered pixel centres in the
    tangent plane, with weights 1 / distance^4 (moving least squares): it passes through the pixel values, whatever the
    orientation of the pixels. Where the neighbours do not determine it, it is their weighted mean: ``poor`` counts those.
    """
    import healpy
    from scipy.spatial import cKDTree

    from zonda.core.numerics.projection import frame_rotation

    to_frame = frame_rotation(sky.frame)
    nx, ny = target.pixel_shape
    matrix = pixel_matrix(target)
    pixel = np.sqrt(healpy.nside2pixarea(sky.nside))
    corners = directions(target, 0, ny)[:: max(ny - 1, 1), :: max(nx - 1, 1)].reshape(-1, 3)
    middle = np.linalg.inv(matrix) @ [(nx - 1) / 2, (ny - 1) / 2, 1.0]
    middle /= np.linalg.norm(middle)
    reach = float(np.arccos(np.clip((corners @ middle).min(), -1, 1))) + 6 * pixel
    near = healpy.query_disc(sky.nside, to_frame @ middle, min(reach, np.pi), nest=sky.nest)
    slot = near if sky.pixels is None else np.flatnonzero(np.isin(sky.pixels, near, assume_unique=True))
    values, covered, poor = np.zeros((ny, nx)), np.zeros((ny, nx), bool), 0
    if len(slot) < NEIGHBOURS:
        return values, covered, poor
    numbers = slot if sky.pixels is None else sky.pixels[slot]
    rays = np.stack(healpy.pix2vec(sky.nside, numbers, nest=sky.nest), axis=1) @ to_frame
    projected = rays @ matrix.T
    front = projected[:, 2] > 0
    slot, points = slot[front], projected[front, :2] / projected[front, 2:]
    tree, data = cKDTree(points), sky.values[slot]
    for first in range(0, ny, ROWS):
        last = min(first + ROWS, ny)
        d = (directions(target, first, last) @ to_frame.T).reshape(-1, 3)
        own = healpy.vec2pix(sky.nside, *d.T, nest=sky.nest)
        seen = np.ones(len(own), bool)
        if sky.pixels is not None:
            seen = sky.pixels[np.minimum(np.searchsorted(sky.pixels, own), len(sky.pixels) - 1)] == own
        y, x = np.mgrid[first:last, 0:nx].astype(np.float64)
        at = np.stack([x.ravel(), y.ravel()], axis=1)[seen]
        flat = np.zeros(len(seen))
        for part in range(0, len(at), 16384):
            found, undetermined = _local_fit(tree, points, data, at[part : part + 16384])
            flat[np.flatnonzero(seen)[part : part + 16384]] = found
            poor += undetermined
        values[first:last], covered[first:last] = flat.reshape(-1, nx), seen.reshape(-1, nx)
    return values, covered, poor


def _local_fit(tree: Any, points: Floats, data: Floats, at: Floats) -> tuple[Floats, int]:
    """Moving least squares of third degree at ``at`` (n, 2) from scattered ``data`` (m,) at ``points`` (m, 2).

    The values (n,), and how many of them are weighted means because the fit is not determined.
    """
    distance, index = tree.query(at, NEIGHBOURS)
    scale = distance[:, -1:]
    u, v = np.moveaxis((points[index] - at[:, None, :]) / scale[:, :, None], 2, 0)
    weight = 1.0 / ((distance / scale) ** 2 + 1e-6)
    cubic = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=2)
    q, r = np.linalg.qr(cubic * weight[:, :, None])
    pivots = np.abs(np.diagonal(r, axis1=1, axis2=2))
    value = np.linalg.solve(r + 1e-300 * np.eye(10), np.einsum("nkj,nk->nj", q, weight * data[index])[:, :, None])[:, 0, 0]
    poor = pivots.min(axis=1) < 1e-6 * pivots.max(axis=1)
    if poor.any():
        w2 = weight[poor] ** 2
        value[poor] = np.sum(w2 * data[index[poor]], axis=1) / np.sum(w2, axis=1)
    return value, int(poor.sum())
