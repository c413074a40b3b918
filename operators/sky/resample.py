"""Bringing maps that are not gnomonic (other projections, HEALPix) onto a gnomonic grid about the
observation.

The grid is worked on in blocks, and of each block the tiles that a scan reaches; each block takes
of the map what lies under it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.maps.grid import wcs_grid
from zonda.core.numerics.projection import frame_rotation, pixel_matrix, wcs_frame_rotation
from zonda.core.numerics.sphere import local_axes
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import Floats

from .inputs import HealpixMap, WcsMap
from .region import MARGIN, TILE

Progress = Callable[[int, int], None]
"""Called with the number of points that are done, and of all."""

NEIGHBOURS = 24
"""HEALPix pixels in each local fit: two rings and a few more."""
CUTS = 8
"""Pieces along each side into which a pixel at the edge of a projection is cut."""
ZENITHAL = ("TAN", "SIN", "ARC", "STG", "ZEA")
"""Projections in which no two points stand for the same sky."""
BLOCK = 8 * TILE
AT_ONCE = 16384


@dataclass(frozen=True)
class Block:
    """Points of a grid of ``step`` [rad]: ``y``, ``x`` (n,) and their ICRS directions ``d`` (n,
    3).
    """

    y: NDArray[np.int64]
    x: NDArray[np.int64]
    d: Floats
    step: float


def blocks(
    target: Any, tiles: NDArray[np.bool_] | None, progress: Progress, thin: int = 1
) -> Iterator[Block]:
    """The points of the TAN grid ``target`` in squares of `BLOCK`; of the ``tiles`` that are True,
    where given.

    ``thin``: only every ``thin``-th point along each axis.
    """
    nx, ny = target.pixel_shape
    to_sky, step = (
        np.linalg.inv(pixel_matrix(target)).T,
        float(np.radians(abs(target.wcs.cdelt[1]))),
    )
    total, done = nx * ny if tiles is None else int(tiles.sum()) * TILE**2, 0
    progress(0, total)
    for first in range(0, ny, BLOCK):
        for left in range(0, nx, BLOCK):
            y, x = (
                k.ravel()
                for k in np.mgrid[
                    first : min(first + BLOCK, ny) : thin, left : min(left + BLOCK, nx) : thin
                ]
            )
            if tiles is not None:
                wanted = tiles[y // TILE, x // TILE]
                y, x = y[wanted], x[wanted]
            if not y.size:
                continue
            rays = np.stack([x, y, np.ones(y.size)], axis=1) @ to_sky
            yield Block(y, x, rays / np.linalg.norm(rays, axis=1, keepdims=True), step)
            done += y.size * thin * thin
            progress(min(done, total), total)


def no_progress(done: int, total: int) -> None:
    """Progress callback that does nothing."""


# --------------------------------------------------------------------------------------------------
# images


def resample_image(
    image: WcsMap,
    target: Any,
    tiles: NDArray[np.bool_] | None = None,
    progress: Progress = no_progress,
    per_area: bool = False,
    axis: Floats | None = None,
) -> tuple[Floats, NDArray[np.bool_]]:
    """(values, covered) of an image on the TAN grid ``target``, by cubic B-splines. NaN-free: not
    covered is 0.

    A cylindrical map that goes round the sky is joined at its seam.

    Parameters
    ----------
    tiles
        `region.Region.tiles`: where False nothing is worked on, and not covered.
    per_area
        Divide each pixel by its solid angle [sr]; one beyond the projection, which has none, counts
        as 0.
    axis
        ICRS direction (3,) of a pole: values are (3, ny, nx) I, Q and U, and each pixel's Q and U
        are turned to the meridians through that pole before they are interpolated. None: I alone,
        (ny, nx).
    """
    from scipy.ndimage import map_coordinates, spline_filter

    nx, ny = target.pixel_shape
    found, covered, sky = (
        np.zeros((1 if axis is None else 3, ny, nx)),
        np.zeros((ny, nx), bool),
        ImageOnSky(image),
    )
    for block in blocks(target, tiles, progress):
        x, y, inside = sky.for_splines(block.d)
        if not inside.any():
            continue
        x, y = x[inside], y[inside]
        rows, columns = sky.around(x, y)
        px, py = np.meshgrid(columns % image.values.shape[1], rows)
        planes = sky.planes(px, py, axis)
        if per_area:
            areas = sky.areas(px, py)
            with np.errstate(divide="ignore", invalid="ignore"):
                planes = np.where(np.isfinite(areas) & (areas > 0), planes / areas, 0.0)
        at = np.array([y - rows[0], x - columns[0]])
        for values, plane in zip(found, planes, strict=True):
            smooth = map_coordinates(
                spline_filter(plane, 3, mode="mirror"), at, order=3, prefilter=False, mode="mirror"
            )
            values[block.y[inside], block.x[inside]] = smooth
        covered[block.y[inside], block.x[inside]] = True
    return found if axis is not None else found[0], covered


class ImageOnSky:
    """Pixels of an image by ICRS directions: their places, solid angles and values, in any
    projection.
    """

    def __init__(self, image: WcsMap) -> None:
        self.image = image
        self.grid = wcs_grid(image.wcs, (image.values.shape[0], image.values.shape[1]))
        self._turn = image.turn
        if image.turn is None:
            with suppress(InputError):  # FK4 is no rotation of ICRS
                self._turn = wcs_frame_rotation(image.wcs)
        cylinder = self.grid.cylinder
        self._period = float(2 * np.pi / abs(self.grid.matrix[0, 0])) if cylinder else 0.0
        self._areas = self.grid.areas[:, 0] if cylinder else None  # those of a row are equal

    @property
    def joined(self) -> bool:
        """True if the image goes round the sky, so that its last column stands beside its first."""
        return bool(self._period and abs(self.grid.shape[1] - self._period) < 0.5)

    def directions(self, x: Any, y: Any) -> Floats:
        """ICRS directions (..., 3) of 0-based pixels; NaN beyond the projection."""
        own = self.grid.at(x, y)
        return own @ self._turn if self._turn is not None else _between(own, self._frame, "icrs")

    def areas(self, x: NDArray[np.int64], y: NDArray[np.int64]) -> Floats:
        """Solid angles [sr] of 0-based pixels; NaN beyond the projection."""
        if self._areas is not None:
            return np.asarray(self._areas[y])
        xx, xy, yy = self.grid.metric(x, y)
        found = np.asarray(np.sqrt(np.maximum(xx * yy - xy * xy, 0.0)))
        if (
            edge := ~np.isfinite(found)
        ).any():  # a part is beyond the projection: the mean of the rest
            cuts = np.linspace(-0.5, 0.5, CUTS + 1)
            corner = self.grid.at(x[edge, None, None] + cuts, y[edge, None, None] + cuts[:, None])
            a, b = corner[:, 1:, 1:] - corner[:, :-1, :-1], corner[:, 1:, :-1] - corner[:, :-1, 1:]
            parts = np.linalg.norm(np.cross(a, b), axis=-1) / 2
            there = np.isfinite(parts)
            with np.errstate(invalid="ignore"):
                total = np.where(there, parts, 0.0).sum(axis=(1, 2))
                found[edge] = total * CUTS**2 / there.sum(axis=(1, 2))
        return found

    def is_own(self, x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.bool_]:
        """True for pixels that hold their centres: one of several that stand for the same sky."""
        if self._period or self.grid.kind in ZENITHAL or self.grid.wcs.has_distortion:
            return np.ones(x.shape, bool)
        u, v = self.grid.coordinates(self.grid.at(x, y))
        near = 0.5 if self.grid.kind != "CSC" else 5.0  # whose inverse is known to some 20 arcsec
        with np.errstate(invalid="ignore"):
            return np.asarray((np.abs(u - x) < near) & (np.abs(v - y) < near))

    def planes(self, x: NDArray[np.int64], y: NDArray[np.int64], axis: Floats | None) -> Floats:
        """(k, ...) I of pixels, or I, Q and U from the meridians through the ICRS direction
        ``axis``.
        """
        intensity = self.image.values[None, y, x]
        if axis is None or self.image.polarization is None:
            return np.asarray(intensity)
        own = self.grid.at(x, y)
        known = np.asarray(np.isfinite(own).all(axis=-1))
        to = (wcs_frame_rotation(self.image.wcs) if self._turn is None else self._turn) @ axis
        turn = between_meridians(
            np.where(known[..., None], own, 0.0), np.array([0.0, 0.0, 1.0]), to
        )
        return np.concatenate(
            [intensity, turned_by(np.where(known, self.image.polarization[:, y, x], 0.0), turn)]
        )

    def at(self, d: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """0-based pixels (x, y) of ICRS directions (n, 3), NaN beyond the projection, and whether
        they are on the image.
        """
        own = d @ self._turn.T if self._turn is not None else _between(d, "icrs", self._frame)
        x, y = self.grid.coordinates(own)
        ny, nx = self.grid.shape
        with np.errstate(invalid="ignore"):
            return x, y, (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)

    def for_splines(self, d: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Positions as `at`; if the image goes round the sky, x is continuous about most of the
        directions.
        """
        x, y, inside = self.at(d)
        if self.joined and inside.any():
            middle = np.median(x[inside])
            x = (x - middle + self._period / 2) % self._period - self._period / 2 + middle
        return x, y, inside

    def around(
        self, x: Floats, y: Floats, margin: int = MARGIN
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns with a margin that splines at pixels (x, y) feel; columns beyond a seam
        go on counting.
        """
        ny, nx = self.grid.shape
        low, high = int(np.floor(x.min())) - margin, int(np.ceil(x.max())) + margin + 1
        columns = np.arange(low, high) if self.joined else np.arange(max(low, 0), min(high, nx))
        return (
            np.arange(
                max(int(np.floor(y.min())) - margin, 0), min(int(np.ceil(y.max())) + margin + 1, ny)
            ),
            columns,
        )

    def under(
        self, block: Block, rim: Floats
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Rows and columns that hold all pixels nearest to points of a block, and which of these
        points are on the image.

        ``rim``: ICRS directions (n, 3) around the block, a step beyond it. No column stands for the
        same sky as another one.
        """
        ny, nx = self.grid.shape
        x, y, there = self.at(np.concatenate([block.d, rim]))
        known = np.isfinite(x) & np.isfinite(y)
        x, y, more = x[known], y[known], 2
        if not x.size:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), there[: len(block.d)]
        columns = np.arange(nx)
        if self._period:
            columns = columns[columns < self._period - 0.5]
            off = (x - x[0] + self._period / 2) % self._period - self._period / 2
            if float(np.ptp(off)) > self._period / 2:  # a pole is near
                more += int(np.ceil(block.step / abs(self.grid.matrix[1, 1])))
            else:
                first = x[0] + off.min() - more
                columns = columns[(columns - first) % self._period <= np.ptp(off) + 2 * more]
        else:
            columns = columns[(columns >= x.min() - more) & (columns <= x.max() + more)]
        rows = np.arange(
            max(int(np.floor(y.min())) - more, 0), min(int(np.ceil(y.max())) + more + 1, ny)
        )
        return rows, columns, there[: len(block.d)]

    def to_own(self, ra: float, dec: float) -> Floats:
        """(3, 3) from ICRS directions to those in the image's frame; of FK4 as it is at (ra, dec)
        [rad].
        """
        if self._turn is not None:
            return self._turn
        axes = local_axes(ra, dec)
        centre, other = _between(np.stack([axes[0], axes[0] + 1e-5 * axes[2]]), "icrs", self._frame)
        north = other - centre * (other @ centre)
        north /= np.linalg.norm(north)
        return np.stack([centre, np.cross(north, centre), north], axis=1) @ axes

    @property
    def _frame(self) -> Any:
        from astropy.wcs.utils import wcs_to_celestial_frame

        return wcs_to_celestial_frame(self.image.wcs)


def _between(d: Floats, frame: Any, other: Any) -> Floats:
    """Directions (..., 3) of one of astropy's frames in another one, by astropy."""
    from astropy.coordinates import SkyCoord

    known = np.isfinite(d).all(axis=-1, keepdims=True)
    sky = SkyCoord(
        *np.moveaxis(np.where(known, d, 1.0), -1, 0), representation_type="cartesian", frame=frame
    )
    found = np.moveaxis(np.asarray(sky.transform_to(other).cartesian.xyz.value), 0, -1)
    return np.where(known, found / np.linalg.norm(found, axis=-1, keepdims=True), np.nan)


# --------------------------------------------------------------------------------------------------
# HEALPix


def resample_healpix(
    sky: HealpixMap,
    target: Any,
    tiles: NDArray[np.bool_] | None = None,
    progress: Progress = no_progress,
    axis: Floats | None = None,
) -> tuple[Floats, NDArray[np.bool_], int]:
    """(values, covered, poor) of a HEALPix map on the TAN grid ``target``. A grid point is covered
    where its HEALPix pixel is.

    Each value comes from the polynomial of third degree that best fits the `NEIGHBOURS` nearest
    covered pixel centres in the tangent plane, with weights 1 / distance^4 (moving least squares):
    it passes through the pixel values, whatever the orientation of the pixels. Where the neighbours
    do not determine it, it is their weighted mean: ``poor`` counts those. Of a map with fewer
    pixels all are neighbours. ``tiles`` and ``axis`` as of `resample_image`.
    """
    import healpy
    from scipy.spatial import cKDTree

    to_frame, matrix = frame_rotation(sky.frame), pixel_matrix(target)
    nx, ny = target.pixel_shape
    planes, covered, poor = (
        np.zeros((1 if axis is None else 3, ny, nx)),
        np.zeros((ny, nx), bool),
        0,
    )
    values = planes if axis is not None else planes[0]
    if not len(sky.values):
        return values, covered, poor
    for block in blocks(target, tiles, progress):
        own = healpy.vec2pix(sky.nside, *(block.d @ to_frame.T).T, nest=sky.nest)
        seen = slots(sky, own)[1]
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
        parts = [
            _local_fit(tree, points, data, at[k : k + AT_ONCE]) for k in range(0, len(at), AT_ONCE)
        ]
        planes[:, block.y[seen], block.x[seen]] = np.concatenate(
            [found for found, _ in parts], axis=1
        )
        covered[block.y[seen], block.x[seen]] = True
        poor += sum(undetermined for _, undetermined in parts)
    return values, covered, poor


def slots(
    sky: HealpixMap, numbers: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Indices of pixels of these numbers in ``sky.values``, and whether they are there."""
    if sky.pixels is None:
        return numbers, np.ones(len(numbers), bool)
    found = np.minimum(np.searchsorted(sky.pixels, numbers), len(sky.pixels) - 1)
    return found, sky.pixels[found] == numbers


def _near(sky: HealpixMap, d: Floats) -> NDArray[np.int64]:
    """Places in ``sky.values`` of the pixels about directions (n, 3) in the map's frame; more of
    them where few are covered.
    """
    import healpy

    middle = d.mean(axis=0)
    middle /= np.linalg.norm(middle)
    radius, pixel = (
        float(np.arccos(np.clip((d @ middle).min(), -1, 1))),
        float(np.sqrt(healpy.nside2pixarea(sky.nside))),
    )
    numbers = np.zeros(0, np.int64)
    for margin in (MARGIN * pixel, 8 * MARGIN * pixel, np.pi):
        numbers, there = slots(
            sky,
            np.sort(
                healpy.query_disc(sky.nside, middle, min(radius + margin, np.pi), nest=sky.nest)
            ),
        )
        numbers = numbers[there]
        if len(numbers) >= NEIGHBOURS:
            break
    return numbers


def _local_fit(tree: Any, points: Floats, data: Floats, at: Floats) -> tuple[Floats, int]:
    """Moving least squares of third degree at ``at`` (n, 2) from scattered ``data`` (k, m) at
    ``points`` (m, 2).

    The values (k, n), and at how many points they are weighted means because the fit is not
    determined.
    """
    distance, index = tree.query(at, np.arange(1, min(NEIGHBOURS, tree.n) + 1))
    scale = np.maximum(distance[:, -1:], 1e-300)
    u, v = np.moveaxis((points[index] - at[:, None, :]) / scale[:, :, None], 2, 0)
    weight = 1.0 / ((distance / scale) ** 2 + 1e-6)
    if tree.n < 10:  # fewer than the coefficients
        return np.sum(weight**2 * data[:, index], axis=2) / np.sum(weight**2, axis=1), len(at)
    cubic = np.stack(
        [np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=2
    )
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


# --------------------------------------------------------------------------------------------------
# extremes


def extremes(
    source: WcsMap | HealpixMap,
    target: Any,
    tiles: NDArray[np.bool_] | None,
    per_area: bool = False,
) -> tuple[float, float]:
    """Least and largest value of the map's pixels under a grid, from a thinned set of its points;
    (0, 0) where there are none.

    ``per_area``: of values divided by the solid angles of their pixels [sr].
    """
    import healpy

    found: list[Floats] = []
    sky = ImageOnSky(source) if isinstance(source, WcsMap) else None
    for block in blocks(target, tiles, no_progress, thin=16):
        if isinstance(source, HealpixMap):
            d = block.d @ frame_rotation(source.frame).T
            there = slots(source, healpy.vec2pix(source.nside, *d.T, nest=source.nest))[1]
            if there.any():
                found.append(source.values[_near(source, d[there])])
        elif sky:
            x, y, inside = sky.for_splines(block.d)
            if inside.any():
                rows, columns = sky.around(x[inside], y[inside])
                px, py = np.meshgrid(columns % source.values.shape[1], rows)
                values, areas = (
                    sky.planes(px, py, None)[0],
                    sky.areas(px, py) if per_area else np.ones(1),
                )
                found.append((values / areas)[np.isfinite(values / areas)])
    if not any(values.size for values in found):
        return 0.0, 0.0
    return min(float(v.min()) for v in found if v.size), max(
        float(v.max()) for v in found if v.size
    )
