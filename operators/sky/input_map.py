"""Input maps of the sky: images of any projection and HEALPix maps. Their pixels are looked up by
directions; values between the pixels of HEALPix maps are local fits of third degree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import InputError
from zonda.core.maps.grid import ImagePixels, wcs_grid
from zonda.core.maps.map_reading import Frame
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.projection import frame_rotation, some_directions, wcs_frame_rotation
from zonda.core.numerics.sphere import angle_between, angles, local_axes
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import Bools, Floats, Integers

from .region import MARGIN, Block, Disc
from .sampling import NEIGHBOURS, local_fit

CUTS = 8
"""Pieces along each side into which a pixel at the edge of a projection is cut."""
ZENITHAL = ("TAN", "SIN", "ARC", "STG", "ZEA")
"""Projections in which no two points stand for the same sky."""
AT_ONCE = 2**18
"""Pixels of a map that are placed together."""
LATTICE = 17
"""Pixels along each side from which the extent of a map is taken."""
NARROWEST = 8
"""Shortest side of pixels that are not skipped, as a part of their nominal one. (Near a pole those
of CAR have none.)
"""
ALIKE = 1.01
"""Ratio of sides up to which these count as the nominal ones."""
NORTH = np.array([0.0, 0.0, 1.0])

Pixels = tuple[NDArray[Any], ...]
"""Pixels of a map as an index of its values: rows and columns, or places in the list."""


@dataclass(kw_only=True)
class InputMap:
    """A map of the sky as its file has it.

    Attributes
    ----------
    values
        float64 in `unit`: (ny, nx), row 0 the file's first row; or (n,) of a list of pixels.
    unit
        ``Jy/pixel``, ``Jy/beam``, ``MJy/sr``, ``K_RJ``, ``K_CMB`` or ``y``.
    notes
        What was chosen or changed, for the log.
    zeroed
        Missing pixels set to zero on request.
    polarization
        (2, ...) Q and U in `unit`, COSMO, from the meridians of the map's frame; None: there are
        none, or none are wanted.
    beam
        FWHM (major, minor) [rad] of the beam that it was made with; None: the file names none.
    """

    values: Floats
    unit: str
    notes: dict[str, str] = field(default_factory=dict)
    zeroed: int = 0
    polarization: Floats | None = None
    beam: tuple[float, float] | None = None

    @property
    def nbytes(self) -> int:
        return self.values.nbytes + (0 if self.polarization is None else self.polarization.nbytes)

    @property
    def beam_solid_angle(self) -> float | None:
        """Solid angle, sr."""
        if self.beam is None:
            return None
        return float(np.pi / (4 * np.log(2)) * self.beam[0] * self.beam[1])

    @property
    def kind(self) -> str:
        """Projection or resolution, for the log."""
        raise NotImplementedError

    @property
    def turn(self) -> Floats:
        """(3, 3) from ICRS directions to those in the map's frame."""
        raise NotImplementedError

    @property
    def sides(self) -> Floats:
        """(2,) nominal sides of a pixel along (x, y), rad."""
        raise NotImplementedError

    @property
    def extent(self) -> tuple[Disc | None, bool]:
        """A circle that holds the map, None if it may be anywhere; and whether all of the map is on
        the sky.
        """
        raise NotImplementedError

    def own_directions(self, at: Pixels) -> Floats:
        """(..., 3) directions of pixels in the map's frame; NaN beyond the projection."""
        raise NotImplementedError

    def areas(self, at: Pixels) -> Floats:
        """Solid angles [sr] of pixels; NaN beyond the projection."""
        raise NotImplementedError

    def own_centre(self, at: Pixels) -> Bools:
        """True for pixels that hold their centres: one of several that stand for the same sky."""
        raise NotImplementedError

    def around(self, block: Block) -> Pixels:
        """Pixels about the points of a block that the map covers, with a margin."""
        raise NotImplementedError

    def under(self, block: Block) -> tuple[Bools, Iterator[Pixels]]:
        """The points of a block that the map covers; and, part by part, pixels among which are all
        that are nearest to points of the block. No two stand for the same sky.
        """
        raise NotImplementedError

    def interpolated(
        self,
        block: Block,
        axis: Floats | None,
        per_area: bool,
    ) -> tuple[Bools, Floats, int]:
        """The points of a block that the map covers; its planes (k, n) there, interpolated; and for
        how many of them a mean is taken instead.
        """
        raise NotImplementedError

    @property
    def lost(self) -> int:
        """Number of bright pixels in Jy/pixel beyond the projection, where there is no sky."""
        return 0

    def directions(self, at: Pixels) -> Floats:
        """(..., 3) ICRS directions of pixels; NaN beyond the projection."""
        return self.own_directions(at) @ self.turn

    def planes(self, at: Pixels, axis: Floats | None) -> Floats:
        """(k, ...) I of pixels, or I, Q and U from the meridians through the ICRS direction
        ``axis``.
        """
        intensity = self.values[at][None]
        if axis is None or self.polarization is None:
            return intensity
        own = self.own_directions(at)
        known = np.asarray(np.isfinite(own).all(axis=-1))
        turn = between_meridians(np.where(known[..., None], own, 0.0), NORTH, self.turn @ axis)
        places: Any = slice(None), *at
        q_and_u = np.where(known, self.polarization[places], 0.0)
        return np.concatenate([intensity, turned_by(q_and_u, turn)])

    def has_pixels_of(self, other: InputMap) -> bool:
        """True if the pixels of an ``other`` map lie where those of this one do."""
        raise NotImplementedError

    def sides_seen(self, observation: Observation) -> tuple[float, float]:
        """The shortest width and the longest side of pixels [rad] where an observation looks."""
        return float(self.sides.min()), float(self.sides.max())


@dataclass(kw_only=True)
class ImageMap(InputMap):
    """An image.

    Attributes
    ----------
    wcs
        Two-dimensional celestial `astropy.wcs.WCS`.
    placeless
        True where the file says nothing of its place: ``wcs`` is then about longitude and latitude
        0.
    moved
        (3, 3) a direction on the sky (ICRS) to the one in the frame of `wcs` at which the image is
        looked up; None: the same one.
    """

    wcs: Any
    placeless: bool = False
    moved: Floats | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return self.values.shape[0], self.values.shape[1]

    @property
    def kind(self) -> str:
        return f"projection {', '.join(self.wcs.wcs.ctype)}"

    def has_pixels_of(self, other: InputMap) -> bool:
        """See `InputMap.has_pixels_of`; an image without a place has those of any of its size."""
        if not isinstance(other, ImageMap) or other.shape != self.shape:
            return False
        rows, columns = (np.array([0.0, (n - 1) / 2, n - 1.0]) for n in self.shape)
        at: Any = np.meshgrid(rows, columns, indexing="ij")
        apart = np.linalg.norm(self.directions(at) - other.directions(at), axis=-1)
        near = not (apart > 0.1 * self.sides.min()).any()  # NaN beyond the projection
        return self.placeless or other.placeless or near

    @cached_property
    def grid(self) -> ImagePixels:
        """Pixels of the image in the frame of `wcs`."""
        return wcs_grid(self.wcs, self.shape)

    @cached_property
    def turn(self) -> Floats:
        """See `InputMap.turn`; FK4, which is no rotation of ICRS, is taken as the one at the middle
        of the image: right to 0.4 arcsec times the distance from there [rad].
        """
        if self.moved is not None:
            return self.moved
        try:
            return wcs_frame_rotation(self.wcs)
        except InputError:
            from astropy.coordinates import SkyCoord
            from astropy.wcs.utils import wcs_to_celestial_frame

            axes = local_axes(*(float(v) for v in angles(self.own_directions(self.middle))))
            points = np.stack([axes[0], axes[0] + 1e-5 * axes[2]], axis=1)
            frame = wcs_to_celestial_frame(self.wcs)
            sky = SkyCoord(*points, representation_type="cartesian", frame=frame).icrs
            centre, other = (d / np.linalg.norm(d) for d in sky.cartesian.xyz.value.T)
            north = other - centre * (other @ centre)
            north /= np.linalg.norm(north)
            return np.asarray(axes.T @ np.stack([centre, np.cross(north, centre), north]))

    @property
    def middle(self) -> Any:
        """Row and column of its middle."""
        return tuple((np.array(self.shape) - 1) / 2)

    @property
    def sides(self) -> Floats:
        matrix = np.asarray(self.wcs.pixel_scale_matrix)
        return np.asarray(np.radians(np.linalg.norm(matrix, axis=0)))

    @property
    def extent(self) -> tuple[Disc | None, bool]:
        rows, columns = (np.linspace(0, n - 1, LATTICE) for n in self.shape)
        lattice: Any = np.meshgrid(rows, columns, indexing="ij")
        middle = self.directions(self.middle)
        rays = self.directions(lattice)
        known = np.isfinite(rays).all(axis=-1)
        if not np.isfinite(middle).all():
            return None, False
        radius = float(angle_between(rays[known], middle).max(initial=0.0)) * (1 + 2 / LATTICE)
        return Disc(middle, min(radius, np.pi)), bool(known.all())

    def own_directions(self, at: Pixels) -> Floats:
        return self.grid.at(at[1], at[0])

    @cached_property
    def _period(self) -> float:
        """Columns of a full turn of a cylindrical projection; 0 of another one."""
        return float(2 * np.pi / abs(self.grid.matrix[0, 0])) if self.grid.cylinder else 0.0

    @property
    def _joined(self) -> bool:
        """True if the image goes round the sky, so that its last column stands beside its first."""
        return bool(self._period and abs(self.shape[1] - self._period) < 0.5)

    @cached_property
    def _areas_of_rows(self) -> Floats:
        return self.grid.areas[:, 0]

    def areas(self, at: Pixels) -> Floats:
        if self._period:  # those of a row are equal
            return self._areas_of_rows[at[0]]
        y, x = at
        xx, xy, yy = self.grid.metric(x, y)
        found = np.asarray(np.sqrt(np.maximum(xx * yy - xy * xy, 0.0)))
        edge = ~np.isfinite(found)
        if edge.any():  # a part is beyond the projection: the mean of the rest
            cuts = np.linspace(-0.5, 0.5, CUTS + 1)
            corner = self.grid.at(x[edge, None, None] + cuts, y[edge, None, None] + cuts[:, None])
            a = corner[:, 1:, 1:] - corner[:, :-1, :-1]
            b = corner[:, 1:, :-1] - corner[:, :-1, 1:]
            parts = np.linalg.norm(np.cross(a, b), axis=-1) / 2
            there = np.isfinite(parts)
            with np.errstate(invalid="ignore"):
                total = np.where(there, parts, 0.0).sum(axis=(1, 2))
                found[edge] = total * CUTS**2 / there.sum(axis=(1, 2))
        return found

    def own_centre(self, at: Pixels) -> Bools:
        y, x = at
        if self._period or self.grid.kind in ZENITHAL or self.wcs.has_distortion:
            return np.ones(x.shape, bool)
        u, v = self.grid.coordinates(self.own_directions(at))
        near = 0.5 if self.grid.kind != "CSC" else 5.0  # whose inverse is known to some 20 arcsec
        with np.errstate(invalid="ignore"):
            return (np.abs(u - x) < near) & (np.abs(v - y) < near)

    def at(self, d: Floats) -> tuple[Floats, Floats, Bools]:
        """0-based pixels (x, y) of ICRS directions (n, 3), NaN beyond the projection, and whether
        they are on the image.
        """
        x, y = self.grid.coordinates(d @ self.turn.T)
        ny, nx = self.shape
        with np.errstate(invalid="ignore"):
            return x, y, (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)

    def _for_splines(self, block: Block) -> tuple[Bools, Floats, Floats, Pixels]:
        """The points of a block on the image, their pixels (x, y), and rows and columns with a
        margin that splines there feel. Columns beyond a seam go on counting.
        """
        x, y, inside = self.at(block.d)
        x, y, (ny, nx) = x[inside], y[inside], self.shape
        if not x.size:
            return inside, x, y, (np.zeros(0, np.int64), np.zeros(0, np.int64))
        if self._joined:
            middle = np.median(x)
            x = (x - middle + self._period / 2) % self._period - self._period / 2 + middle
        first = np.floor(x.min()) - MARGIN
        last = np.ceil(x.max()) + MARGIN + 1
        low = max(np.floor(y.min()) - MARGIN, 0)
        high = min(np.ceil(y.max()) + MARGIN + 1, ny)
        if not self._joined:
            first = max(first, 0)
            last = min(last, nx)
        return inside, x, y, (np.arange(int(low), int(high)), np.arange(int(first), int(last)))

    def _pixels(self, rows: Integers, columns: Integers) -> Pixels:
        rows, columns = np.meshgrid(rows, columns % self.shape[1], indexing="ij")
        return rows, columns

    def around(self, block: Block) -> Pixels:
        return self._pixels(*self._for_splines(block)[3])

    def interpolated(
        self,
        block: Block,
        axis: Floats | None,
        per_area: bool,
    ) -> tuple[Bools, Floats, int]:
        """See `InputMap.interpolated`: by cubic B-splines.

        ``per_area``: each pixel is divided by its solid angle; one beyond the projection, which has
        none, counts as 0.
        """
        from scipy.ndimage import map_coordinates, spline_filter

        inside, x, y, (rows, columns) = self._for_splines(block)
        if not x.size:
            return inside, np.zeros((1 if axis is None else 3, 0)), 0
        at = self._pixels(rows, columns)
        planes = self.planes(at, axis)
        if per_area:
            areas = self.areas(at)
            with np.errstate(divide="ignore", invalid="ignore"):
                planes = np.where(np.isfinite(areas) & (areas > 0), planes / areas, 0.0)
        where = np.array([y - rows[0], x - columns[0]])
        splines = (spline_filter(plane, 3, mode="mirror") for plane in planes)
        found = [
            map_coordinates(spline, where, order=3, prefilter=False, mode="mirror")
            for spline in splines
        ]
        return inside, np.array(found), 0

    def under(self, block: Block) -> tuple[Bools, Iterator[Pixels]]:
        ny, nx = self.shape
        x, y, there = self.at(np.concatenate([block.d, block.rim]))
        known = np.isfinite(x) & np.isfinite(y)
        there = there[: len(block.d)]
        x = x[known]
        y = y[known]
        more = 2
        if not x.size:
            return there, iter(())
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
        low = np.floor(y.min()) - more
        high = np.ceil(y.max()) + more + 1
        rows = np.arange(max(int(low), 0), min(int(high), ny))
        parts = chunks(len(rows), max(AT_ONCE // max(len(columns), 1), 1))
        pixels = (self._pixels(rows[part], columns) for part in parts)
        return there, ((y.ravel(), x.ravel()) for y, x in pixels)

    @property
    def lost(self) -> int:
        """See `InputMap.lost`; an estimate for `AT_ONCE` pixels and more."""
        if self.unit != "Jy/pixel":
            return 0
        step = int(np.ceil(np.sqrt(self.values.size / (16 * AT_ONCE))))
        rows, columns = np.nonzero(self.values[::step, ::step])
        d = self.own_directions((rows * step, columns * step))
        return int(np.count_nonzero(~np.isfinite(d).all(axis=-1))) * step * step

    def sides_seen(self, observation: Observation) -> tuple[float, float]:
        """See `InputMap.sides_seen`; those of the header where it looks beside the map.

        The former is rounded down in steps of 2^(1/2) of the nominal one (`NARROWEST` at least),
        the latter up in steps of 2^(1/8), `ALIKE` apart.
        """
        least, most = super().sides_seen(observation)
        plane = observation.focalplane
        d = some_directions(observation.sky_boresight, plane.xi, plane.eta).reshape(-1, 3)
        x, y, inside = self.at(d)
        if not inside.any():
            return least, most
        xx, xy, yy = self.grid.metric(x[inside], y[inside])
        half = (xx + yy) / 2
        rest = np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
        narrow = float(np.nanmin(np.sqrt(np.maximum(half - rest, 0.0)), initial=least)) / least
        long = np.sqrt(np.maximum(xx, yy))
        wide = float(np.max(long[np.isfinite(long)], initial=0.0)) / most or 1.0
        down = np.floor(2 * np.log2(max(narrow, 1e-9)) + 1e-6)
        up = np.ceil(8 * np.log2(wide / ALIKE))
        return least * float(max(2.0 ** (down / 2), 1 / NARROWEST)), most * float(2.0 ** (up / 8))


@dataclass(kw_only=True)
class HealpixMap(InputMap):
    """A HEALPix map: ``values[k]`` belongs to pixel ``pixels[k]`` (sorted; the others are not
    covered); None: to pixel k.

    ``pixels`` are numbers in the ordering ``nest``; ``frame`` is an astropy frame name.
    """

    pixels: Integers | None
    nside: int
    nest: bool
    frame: Frame

    @property
    def nbytes(self) -> int:
        return super().nbytes + (0 if self.pixels is None else self.pixels.nbytes)

    def has_pixels_of(self, other: InputMap) -> bool:
        if not isinstance(other, HealpixMap):
            return False
        own, others = ((m.nside, m.nest, m.frame) for m in (self, other))
        listed: Any = self.pixels, other.pixels  # None: all of them
        return own == others and np.array_equal(*listed)

    @property
    def kind(self) -> str:
        return f"HEALPix of nside {self.nside}"

    @cached_property
    def turn(self) -> Floats:
        return frame_rotation(self.frame)

    @property
    def sides(self) -> Floats:
        return np.full(2, np.sqrt(np.pi / 3) / self.nside)

    @property
    def extent(self) -> tuple[Disc | None, bool]:
        import healpy

        if self.pixels is None or not len(self.pixels):
            return None, True
        d = self.own_directions((np.arange(len(self.pixels)),))
        middle = d.mean(axis=0)
        length = float(np.linalg.norm(middle))
        if length < 0.1:  # all round the sky
            return None, True
        radius = float(np.arccos(np.clip((d @ middle).min() / length, -1, 1)))
        radius += float(healpy.max_pixrad(self.nside))
        return Disc(self.turn.T @ (middle / length), radius), True

    def own_directions(self, at: Pixels) -> Floats:
        import healpy

        numbers = at[0] if self.pixels is None else self.pixels[at[0]]
        return np.stack(healpy.pix2vec(self.nside, numbers, nest=self.nest), axis=1)

    def areas(self, at: Pixels) -> Floats:
        import healpy

        return np.full(len(at[0]), float(healpy.nside2pixarea(self.nside)))

    def own_centre(self, at: Pixels) -> Bools:
        return np.ones(len(at[0]), bool)

    def _covers(self, own: Floats) -> Bools:
        """True for directions (n, 3) in the map's frame whose pixels are there."""
        import healpy

        return self._places(healpy.vec2pix(self.nside, *own.T, nest=self.nest))[1]

    def _places(self, numbers: Integers) -> tuple[Integers, Bools]:
        """Indices of pixels of these numbers in ``values``, and whether they are there."""
        if self.pixels is None:
            return numbers, np.ones(len(numbers), bool)
        if not len(self.pixels):
            return numbers, np.zeros(len(numbers), bool)
        found = np.minimum(np.searchsorted(self.pixels, numbers), len(self.pixels) - 1)
        return found, self.pixels[found] == numbers

    def _within(self, own: Floats, margin: float) -> Integers:
        """Sorted numbers of the pixels about directions (n, 3) in the map's frame, ``margin`` [rad]
        beyond them.
        """
        import healpy

        middle = own.mean(axis=0)
        middle /= np.linalg.norm(middle)
        radius = float(np.arccos(np.clip((own @ middle).min(), -1, 1))) + margin
        disc = healpy.query_disc(self.nside, middle, min(radius, np.pi), nest=self.nest)
        return np.sort(disc)

    def around(self, block: Block) -> Pixels:
        return (self._near(block)[1],)

    def _near(self, block: Block) -> tuple[Bools, Integers]:
        """The points of a block that are covered, and the pixels about them; more of them where few
        are covered.
        """
        own = block.d @ self.turn.T
        seen = self._covers(own)
        near = np.zeros(0, np.int64)
        for reach in (MARGIN, 8 * MARGIN, np.inf) if seen.any() else ():
            found, there = self._places(self._within(own[seen], reach * float(self.sides[0])))
            near = found[there]
            if len(near) >= NEIGHBOURS:
                break
        return seen, near

    def interpolated(
        self,
        block: Block,
        axis: Floats | None,
        per_area: bool,
    ) -> tuple[Bools, Floats, int]:
        """See `InputMap.interpolated`: by `local_fit`, whatever the orientation of the pixels."""
        seen, near = self._near(block)
        if not len(near):
            return seen, np.zeros((1 if axis is None else 3, int(seen.sum()))), 0
        projected = self.directions((near,)) @ block.matrix.T
        front = projected[:, 2] > 0
        points = projected[front, :2] / projected[front, 2:]
        where = np.stack([block.x[seen], block.y[seen]], axis=1).astype(np.float64)
        return seen, *local_fit(points, self.planes((near[front],), axis), where)

    def under(self, block: Block) -> tuple[Bools, Iterator[Pixels]]:
        own = block.d @ self.turn.T
        numbers = self._within(own, block.step)
        parts = (self._places(numbers[part]) for part in chunks(len(numbers), AT_ONCE))
        return self._covers(own), ((found[there],) for found, there in parts)
