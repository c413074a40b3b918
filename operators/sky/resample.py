"""Bringing maps that are not gnomonic (other projections, HEALPix) onto a gnomonic grid about the observation.

The grid is worked on in blocks, and of each block the tiles that a scan reaches; each block takes of the map what lies under it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.numerics.projection import frame_rotation, pixel_matrix, wcs_frame_rotation
from zonda.core.numerics.sphere import angles, unit_vectors
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import Floats

from .inputs import HealpixMap, WcsMap
from .region import MARGIN, TILE

Progress = Callable[[int, int], None]
"""Called with the number of points that are done, and of all."""

NEIGHBOURS = 24
"""HEALPix pixels in each local fit: two rings and a few more."""
ROWS = 64
BLOCK = 8 * TILE
AT_ONCE = 16384


@dataclass(frozen=True)
class _Block:
    """Points of a grid: ``y``, ``x`` (n,) and their ICRS directions ``d`` (n, 3)."""

    y: NDArray[np.int64]
    x: NDArray[np.int64]
    d: Floats


def _blocks(target: Any, tiles: NDArray[np.bool_] | None, progress: Progress, thin: int = 1) -> Iterator[_Block]:
    """The points of the TAN grid ``target`` in squares of `BLOCK`; of the ``tiles`` that are True, where given.

    ``thin``: only every ``thin``-th point along each axis.
    """
    nx, ny = target.pixel_shape
    to_sky = np.linalg.inv(pixel_matrix(target)).T
    total, done = nx * ny if tiles is None else int(tiles.sum()) * TILE**2, 0
    progress(0, total)
    for first in range(0, ny, BLOCK):
        for left in range(0, nx, BLOCK):
            y, x = (k.ravel() for k in np.mgrid[first : min(first + BLOCK, ny) : thin, left : min(left + BLOCK, nx) : thin])
            if tiles is not None:
                wanted = tiles[y // TILE, x // TILE]
                y, x = y[wanted], x[wanted]
            if not y.size:
                continue
            rays = np.stack([x, y, np.ones(y.size)], axis=1) @ to_sky
            yield _Block(y, x, rays / np.linalg.norm(rays, axis=1, keepdims=True))
            done += y.size * thin * thin
            progress(min(done, total), total)


def no_progress(done: int, total: int) -> None:
    """Progress callback that does nothing."""


# ------------------------------------------------------------------------------------------------------------ images


def resample_image(
    image: WcsMap,
    target: Any,
    tiles: NDArray[np.bool_] | None = None,
    progress: Progress = no_progress,
    per_area: bool = False,
    axis: Floats | None = None,
) -> tuple[Floats, NDArray[np.bool_]]:
    """(values, covered) of an image on the TAN grid ``target``, by cubic B-splines. NaN-free: not covered is 0.

    A cylindrical map that goes round the sky is joined at its seam.

    Parameters
    ----------
    tiles
        `region.Region.tiles`: where False nothing is worked on, and not covered.
    per_area
        Divide each pixel by its solid angle [sr]; one beyond the projection, which has none, counts as 0.
    axis
        ICRS direction (3,) of a pole: values are (3, ny, nx) I, Q and U, and each pixel's Q and U are turned to the meridians
        through that pole before they are interpolated. None: I alone, (ny, nx).
    """
    from scipy.ndimage import map_coordinates, spline_filter

    nx, ny = target.pixel_shape
    planes, covered = np.zeros((1 if axis is None else 3, ny, nx)), np.zeros((ny, nx), bool)
    coordinates = _coordinates(image)
    for block in _blocks(target, tiles, progress):
        x, y, inside = _on_image(image, coordinates, block.d)
        if not inside.any():
            continue
        x, y = x[inside], y[inside]
        rows, columns = _under(image, x, y)
        sources = [image.values[np.ix_(rows, columns % image.values.shape[1])]]
        if axis is not None:
            sources += _turned(image, rows, columns, axis)
        if per_area:
            areas = pixel_areas(image.wcs, rows, columns)
            with np.errstate(divide="ignore", invalid="ignore"):
                sources = [np.where(np.isfinite(areas) & (areas > 0), source / areas, 0.0) for source in sources]
        at = np.array([y - rows[0], x - columns[0]])
        for values, source in zip(planes, sources, strict=True):
            found = map_coordinates(spline_filter(source, 3, mode="mirror"), at, order=3, prefilter=False, mode="mirror")
            values[block.y[inside], block.x[inside]] = found
        covered[block.y[inside], block.x[inside]] = True
    return planes if axis is not None else planes[0], covered


def _turned(image: WcsMap, rows: NDArray[np.int64], columns: NDArray[np.int64], axis: Floats) -> list[Floats]:
    """Q and U of some rows and columns of an image, from the meridians through the ICRS direction ``axis``; 0 beyond the sky."""
    assert image.polarization is not None  # asked for only where there are Q and U
    lon, lat = from_pixels(image.wcs, *np.meshgrid(columns.astype(np.float64), rows.astype(np.float64)))
    d = unit_vectors(*np.radians((lon, lat)))
    known = np.asarray(np.isfinite(d).all(axis=-1))
    to = (wcs_frame_rotation(image.wcs) if image.turn is None else image.turn) @ axis
    turn = between_meridians(np.where(known[..., None], d, 0.0), np.array([0.0, 0.0, 1.0]), to)
    found = image.polarization[:, rows][:, :, columns % image.values.shape[1]]
    return list(turned_by(np.where(known, found, 0.0), turn))


def _on_image(
    image: WcsMap, coordinates: Callable[[Floats], tuple[Floats, Floats]], d: Floats
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """0-based pixels (x, y) of directions (n, 3), and whether they are on the image; x is continuous across a seam."""
    rows, columns = image.values.shape
    x, y = _to_pixels(image.wcs, *coordinates(d))
    period = _period(image.wcs)
    if period:
        x = (x + 0.5) % period - 0.5
    inside = (x >= -0.5) & (x < columns - 0.5) & (y >= -0.5) & (y < rows - 0.5)
    if period and abs(columns - period) < 0.5 and inside.any():  # all round the sky: from where most of the points are
        middle = np.median(x[inside])
        x = (x - middle + period / 2) % period - period / 2 + middle
    return x, y, inside


def _under(image: WcsMap, x: Floats, y: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the image, with a margin, that splines at pixels (x, y) feel; columns beyond a seam go on counting."""
    rows, columns = image.values.shape
    period = _period(image.wcs)
    joined = bool(period and abs(columns - period) < 0.5)
    low, high = int(np.floor(x.min())) - MARGIN, int(np.ceil(x.max())) + MARGIN + 1
    across = np.arange(low, high) if joined else np.arange(max(low, 0), min(high, columns))
    return np.arange(max(int(np.floor(y.min())) - MARGIN, 0), min(int(np.ceil(y.max())) + MARGIN + 1, rows)), across


def _coordinates(image: WcsMap) -> Callable[[Floats], tuple[Floats, Floats]]:
    """From ICRS directions (..., 3) to the (lon, lat) [deg] in the frame of the image's WCS at which it is looked up."""
    turn = image.turn
    if turn is None:
        try:
            turn = wcs_frame_rotation(image.wcs)
        except InputError:  # FK4 is no rotation of ICRS
            return lambda d: _by_astropy(image.wcs, d)

    def found(d: Floats) -> tuple[Floats, Floats]:
        lon, lat = np.degrees(angles(d @ turn.T))
        return lon % 360.0, lat

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


def pixel_areas(wcs: Any, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Floats:
    """Solid angles (ny, nx) [sr] of an image's pixels of any projection, by the edges' midpoints; NaN beyond the projection."""
    areas = np.empty((len(rows), len(columns)))
    for first in range(0, len(rows), ROWS):
        chunk = slice(first, first + ROWS)
        x, y = np.meshgrid(columns.astype(np.float64), rows[chunk].astype(np.float64))

        def ray(dx: float, dy: float, x: Floats = x, y: Floats = y) -> Floats:
            return unit_vectors(*np.radians(from_pixels(wcs, x + dx, y + dy)))

        h = 0.25
        across, along = ray(h, 0.0) - ray(-h, 0.0), ray(0.0, h) - ray(0.0, -h)
        areas[chunk] = np.linalg.norm(np.cross(across, along), axis=2) / (2 * h) ** 2
    return areas


def from_pixels(wcs: Any, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Native (lon, lat) [deg] of 0-based pixels; NaN beyond the projection."""
    pair = wcs.all_pix2world(x, y, 0)
    lon, lat = pair if wcs.wcs.lng == 0 else pair[::-1]
    return np.asarray(lon), np.asarray(lat)


# ----------------------------------------------------------------------------------------------------------- HEALPix


def resample_healpix(
    sky: HealpixMap,
    target: Any,
    tiles: NDArray[np.bool_] | None = None,
    progress: Progress = no_progress,
    axis: Floats | None = None,
) -> tuple[Floats, NDArray[np.bool_], int]:
    """(values, covered, poor) of a HEALPix map on the TAN grid ``target``. A grid point is covered where its HEALPix pixel is.

    Each value comes from the polynomial of third degree that best fits the `NEIGHBOURS` nearest covered pixel centres in the
    tangent plane, with weights 1 / distance^4 (moving least squares): it passes through the pixel values, whatever the
    orientation of the pixels. Where the neighbours do not determine it, it is their weighted mean: ``poor`` counts those. Of a
    map with fewer pixels all are neighbours.
    ``tiles`` and ``axis`` as of `resample_image`.
    """
    import healpy
    from scipy.spatial import cKDTree

    to_frame, matrix = frame_rotation(sky.frame), pixel_matrix(target)
    nx, ny = target.pixel_shape
    planes, covered, poor = np.zeros((1 if axis is None else 3, ny, nx)), np.zeros((ny, nx), bool), 0
    values = planes if axis is not None else planes[0]
    if not len(sky.values):
        return values, covered, poor
    for block in _blocks(target, tiles, progress):
        own = healpy.vec2pix(sky.nside, *(block.d @ to_frame.T).T, nest=sky.nest)
        seen = _slots(sky, own)[1]
        near = _near(sky, block.d[seen] @ to_frame.T) if seen.any() else np.zeros(0, np.int64)
        if not len(near):
            continue
        numbers = near if sky.pixels is None else sky.pixels[near]
        d = np.stack(healpy.pix2vec(sky.nside, numbers, nest=sky.nest), axis=1)
        projected = d @ to_frame @ matrix.T
        front = projected[:, 2] > 0
        points, data = projected[front, :2] / projected[front, 2:], sky.values[None, near[front]]
        if axis is not None and sky.polarization is not None:
            turn = between_meridians(d[front], np.array([0.0, 0.0, 1.0]), to_frame @ axis)
            data = np.concatenate([data, turned_by(sky.polarization[:, near[front]], turn)])
        tree = cKDTree(points)
        at = np.stack([block.x[seen], block.y[seen]], axis=1).astype(np.float64)
        parts = [_local_fit(tree, points, data, at[k : k + AT_ONCE]) for k in range(0, len(at), AT_ONCE)]
        planes[:, block.y[seen], block.x[seen]] = np.concatenate([found for found, _ in parts], axis=1)
        covered[block.y[seen], block.x[seen]] = True
        poor += sum(undetermined for _, undetermined in parts)
    return values, covered, poor


def _slots(sky: HealpixMap, numbers: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Where pixels of these numbers stand in ``sky.values``, and whether they are there."""
    if sky.pixels is None:
        return numbers, np.ones(len(numbers), bool)
    slots = np.minimum(np.searchsorted(sky.pixels, numbers), len(sky.pixels) - 1)
    return slots, sky.pixels[slots] == numbers


def _near(sky: HealpixMap, d: Floats) -> NDArray[np.int64]:
    """Places in ``sky.values`` of the pixels about directions (n, 3) in the map's frame; more of them where few are covered."""
    import healpy

    middle = d.mean(axis=0)
    middle /= np.linalg.norm(middle)
    radius, pixel = float(np.arccos(np.clip((d @ middle).min(), -1, 1))), float(np.sqrt(healpy.nside2pixarea(sky.nside)))
    slots = np.zeros(0, np.int64)
    for margin in (MARGIN * pixel, 8 * MARGIN * pixel, np.pi):
        slots, there = _slots(sky, np.sort(healpy.query_disc(sky.nside, middle, min(radius + margin, np.pi), nest=sky.nest)))
        slots = slots[there]
        if len(slots) >= NEIGHBOURS:
            break
    return slots


def _local_fit(tree: Any, points: Floats, data: Floats, at: Floats) -> tuple[Floats, int]:
    """Moving least squares of third degree at ``at`` (n, 2) from scattered ``data`` (k, m) at ``points`` (m, 2).

    The values (k, n), and at how many points they are weighted means because the fit is not determined.
    """
    distance, index = tree.query(at, np.arange(1, min(NEIGHBOURS, tree.n) + 1))
    scale = np.maximum(distance[:, -1:], 1e-300)
    u, v = np.moveaxis((points[index] - at[:, None, :]) / scale[:, :, None], 2, 0)
    weight = 1.0 / ((distance / scale) ** 2 + 1e-6)
    if tree.n < 10:  # fewer than the coefficients
        return np.sum(weight**2 * data[:, index], axis=2) / np.sum(weight**2, axis=1), len(at)
    cubic = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=2)
    q, r = np.linalg.qr(cubic * weight[:, :, None])
    pivots = np.abs(np.diagonal(r, axis1=1, axis2=2))
    poor = pivots.min(axis=1) < 1e-6 * pivots.max(axis=1)
    found = np.empty((len(data), len(at)))
    for value, plane in zip(found, data, strict=True):
        right = np.einsum("nkj,nk->nj", q, weight * plane[index])[:, :, None]
        value[:] = np.linalg.solve(r + 1e-300 * np.eye(10), right)[:, 0, 0]
        if poor.any():
            w2 = weight[poor] ** 2
            value[poor] = np.sum(w2 * plane[index[poor]], axis=1) / np.sum(w2, axis=1)
    return found, int(poor.sum())


# ----------------------------------------------------------------------------------------------------------- extremes


def extremes(source: WcsMap | HealpixMap, target: Any, tiles: NDArray[np.bool_] | None) -> tuple[float, float]:
    """Least and largest value of the map's pixels under a grid, from a thinned set of its points; (0, 0) where there are none."""
    import healpy

    found: list[Floats] = []
    coordinates = _coordinates(source) if isinstance(source, WcsMap) else None
    for block in _blocks(target, tiles, no_progress, thin=16):
        if isinstance(source, HealpixMap):
            d = block.d @ frame_rotation(source.frame).T
            there = _slots(source, healpy.vec2pix(source.nside, *d.T, nest=source.nest))[1]
            if there.any():
                found.append(source.values[_near(source, d[there])])
        elif coordinates:
            x, y, inside = _on_image(source, coordinates, block.d)
            if inside.any():
                rows, columns = _under(source, x[inside], y[inside])
                found.append(source.values[np.ix_(rows, columns % source.values.shape[1])].ravel())
    if not found:
        return 0.0, 0.0
    return min(float(v.min()) for v in found), max(float(v.max()) for v in found)
