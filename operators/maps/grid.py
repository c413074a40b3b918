"""Pixel grids: tangent-plane (TAN) and plate carrée (CAR) images and HEALPix, and which of their
pixels a sample falls in.

Pixels are found tile by tile. Two bands share them where each alone would find the same bits:
`Looking.key` is a fingerprint of all numbers that pixels are computed from.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.errors import InputError
from zonda.core.kernels import kernel
from zonda.core.maps.header import exact_header
from zonda.core.numerics import projection
from zonda.core.numerics.chunks import TILE_DETECTORS, TILE_SAMPLES, chunks
from zonda.core.numerics.projection import (
    boresights,
    directions,
    frame_rotation,
    pixel_matrix,
    ray_coefficients,
)
from zonda.core.numerics.sphere import position
from zonda.core.observation import Observation
from zonda.core.types import Floats

from .healpix import Lookup, healpix_pixels, lookup
from .plate_carree import plate_carree_pixels, rows_of

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.wcs import WCS

MOST_BYTES = 16 << 20
"""Bytes of pixels that a thread holds while it adds a block to maps."""
MOST_PIXELS = 1 << 28
"""Largest grid that is made."""


class PixelGrid:
    """Pixels of a map in a celestial frame, and which of them a sample falls in."""

    frame: str

    @property
    def kernel(self) -> tuple[Any, ...]:
        """The compiled function that finds pixels, and what it is told of the grid."""
        raise NotImplementedError

    def pointing(self, observation: Observation) -> Floats:
        """Coefficients (9, n_samp) of the directions that detectors look at, in the map's frame."""
        turn = frame_rotation(self.frame)
        return ray_coefficients(observation.boresight_radec, turn)

    def pixels(
        self,
        pointing: Floats,
        first: int,
        stop: int,
        xi: Floats,
        eta: Floats,
        out: NDArray[np.int32],
    ) -> None:
        """Flat pixel indices (n_det, stop - first) of detectors at (xi, eta), -1 outside. Into
        ``out``.
        """
        find, *where = self.kernel
        find(pointing, first, stop, xi, eta, *where, out)


@dataclass(frozen=True)
class ImageGrid(PixelGrid):
    """An image: ``shape`` (ny, nx), pixels of side ``pixel`` [rad] in ``frame``; its projection
    says what ``origin`` is.
    """

    origin: tuple[float, float]
    pixel: float
    shape: tuple[int, int]
    frame: str = "icrs"

    @property
    def n_pixels(self) -> int:
        return self.shape[0] * self.shape[1]

    @property
    def wcs(self) -> WCS:
        """World coordinates."""
        raise NotImplementedError

    @property
    def header(self) -> Header:
        """The FITS keywords of `wcs`."""
        return exact_header(self.wcs)

    def seen(self, hits: Any) -> Any:
        """Places of the pixels that a map of ``hits`` (n_pixels,) has: all."""
        return slice(None)

    def places(self, pixels: NDArray[np.intp]) -> Floats:
        """(2, n) rows and columns of pixels."""
        return np.array(np.divmod(pixels, self.shape[1]), np.float64)

    def described(self, seen: Any) -> dict[str, Any]:
        """Header, pixel size and places, as `Map` takes them."""
        return {"header": self.header, "pixel": self.pixel}


class TangentGrid(ImageGrid):
    """A TAN image: its origin is the centre [rad] in ``frame``; pixels are square, east is to the
    left.
    """

    @property
    def wcs(self) -> WCS:
        """World coordinates whose reference point is the middle of the image, for odd and even
        sizes alike.
        """
        return tangent_wcs(self.origin, self.pixel, self.shape, self.frame)

    @property
    def kernel(self) -> tuple[Any, ...]:
        return tangent_pixels, *self.shape

    def pointing(self, observation: Observation) -> Floats:
        """Homographies (9, n_samp), see `core.numerics.projection`."""
        return ray_coefficients(observation.boresight_radec, pixel_matrix(self.wcs))


@dataclass(frozen=True)
class PlateCarreeGrid(ImageGrid):
    """A CAR image: its origin is the (column, row) of its first pixel on the full sky."""

    origin: tuple[int, int]

    @property
    def wcs(self) -> WCS:
        """World coordinates whose reference point lies on the equator, at the longitude of the
        image's middle column.
        """
        from astropy.wcs import WCS

        rows, middle = rows_of(self.pixel), self.shape[1] // 2
        degrees = 180.0 / rows
        wcs = WCS(naxis=2)
        wcs.wcs.ctype = ("GLON-CAR", "GLAT-CAR")
        if self.frame == "icrs":
            wcs.wcs.ctype, wcs.wcs.radesys = ("RA---CAR", "DEC--CAR"), "ICRS"
        wcs.wcs.crval = [(180.0 - (self.origin[0] + middle) * degrees) % 360.0, 0.0]
        wcs.wcs.crpix = [middle + 1.0, rows / 2 + 0.5 - self.origin[1]]
        wcs.wcs.cdelt = [-degrees, degrees]
        wcs.wcs.set()
        return wcs

    @property
    def header(self) -> Header:
        """The FITS keywords of `wcs`, with 14 digits."""
        return self.wcs.to_header(relax=True)

    @property
    def kernel(self) -> tuple[Any, ...]:
        return plate_carree_pixels, rows_of(self.pixel), *self.origin, *self.shape

    @classmethod
    def of_box(cls, box: Sequence[int], pixel: float, frame: str) -> PlateCarreeGrid:
        """The image of the full-sky pixels in a box."""
        left, low, right, high = box
        return cls((left, low), pixel, (high - low + 1, right - left + 1), frame)


@dataclass(frozen=True)
class HealpixGrid(PixelGrid):
    """The pixels ``pixels_covered`` (sorted) of a HEALPix map; a sample's index is its place among
    them.
    """

    nside: int
    nest: bool
    pixels_covered: NDArray[np.int64]
    frame: str = "icrs"
    shape: ClassVar[tuple[int]] = (-1,)

    @property
    def n_pixels(self) -> int:
        return len(self.pixels_covered)

    @cached_property
    def lookup(self) -> Lookup:
        """Places of the covered pixels among them."""
        return lookup(self.pixels_covered)

    @property
    def kernel(self) -> tuple[Any, ...]:
        return healpix_pixels, self.nside, self.nest, *self.lookup

    def seen(self, hits: Any) -> Any:
        """Places of the pixels that a map of ``hits`` (n_pixels,) has: those with some."""
        return np.flatnonzero(hits)

    def places(self, pixels: NDArray[np.intp]) -> Floats:
        """(2, n) latitude and longitude [rad] of pixels about a great circle through their middle,
        along which most of them lie.
        """
        import healpy

        at = np.array(healpy.pix2vec(self.nside, self.pixels_covered[pixels], nest=self.nest))
        axes = np.linalg.eigh(np.einsum("ip,jp->ij", at, at))[1]
        across, along, ahead = np.einsum("ji,jp->ip", axes, at)
        ahead *= 1.0 if ahead.sum() >= 0 else -1.0
        return np.array([np.arcsin(np.clip(across, -1, 1)), np.arctan2(along, ahead)])

    def described(self, seen: Any) -> dict[str, Any]:
        """Header, pixel size and places, as `Map` takes them."""
        return {
            "header": None,
            "pixel": math.sqrt(4 * math.pi / (12 * self.nside**2)),
            "nside": self.nside,
            "nest": self.nest,
            "pixels": self.pixels_covered[seen],
        }


Grid = TangentGrid | PlateCarreeGrid | HealpixGrid


def tangent_wcs(
    centre: tuple[float, float],
    pixel: float,
    shape: tuple[int, int],
    frame: str = "icrs",
) -> WCS:
    """World coordinates of a TAN image: (ny, nx) pixels of side ``pixel`` [rad] around ``centre``
    [rad, in ``frame``].
    """
    if frame not in ("icrs", "galactic"):
        raise InputError(f"unknown frame {frame!r}", place="map grid", cure="use icrs or galactic")
    step = math.degrees(pixel)
    return projection.tangent_wcs(
        frame,
        crval=(math.degrees(centre[0]) % 360.0, math.degrees(centre[1])),
        crpix=((shape[1] + 1) / 2, (shape[0] + 1) / 2),
        cdelt=(-step, step),
    )


def in_frame(icrs: tuple[float, float], frame: str) -> tuple[float, float]:
    """(lon, lat) [rad] in ``frame`` of an ICRS position [rad]."""
    ra, dec = icrs
    if frame == "icrs":
        return ra, dec
    ray = [math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]
    return position(frame_rotation(frame) @ ray)


def covering_extent(
    observations: Sequence[Observation],
    centre: tuple[float, float],
    frame: str,
) -> tuple[float, float]:
    """Half-width and half-height [rad, on the tangent plane] of the TAN image around ``centre``
    that holds every sample.
    """
    matrix = pixel_matrix(tangent_wcs(centre, 1.0, (1, 1), frame))
    half = np.zeros(2)
    for observation in observations:
        for some in chunks(observation.n_samples):
            half = np.maximum(half, _extent(observation, some, matrix))
    return float(half[0]), float(half[1])


def _extent(observation: Observation, samples: slice, matrix: Floats) -> Floats:
    """(2,) how far from the centre some samples reach; ``matrix`` turns ICRS directions towards
    it.
    """
    x, y, ahead = matrix @ boresights(observation.boresight_radec[samples])
    if (ahead < math.cos(math.radians(75.0))).any():
        raise InputError(
            f"{observation.name} reaches more than 75 deg from the map centre, too far for a"
            " tangent plane",
            place="map grid",
            cure="give width and height, or nside for a HEALPix map",
        )
    offset = np.stack([x, y]) / ahead
    reach = observation.focalplane.radius
    far = np.hypot(*offset) * reach
    # a circle of radius r around a point at tangent distance s appears at most r (1 + s^2) / (1 - r
    # s) wide
    if (far > 0.5).any():
        raise InputError(
            "the field of view is too wide for a tangent plane",
            place="map grid",
            cure="give nside for a HEALPix map",
        )
    grown = reach * (1 + (offset**2).sum(axis=0)) / (1 - far)
    return np.asarray((np.abs(offset) + grown).max(axis=1))


LEAST_TOGETHER = 1 << 18
"""Pixels of overlapping discs that are kept before they are united."""


def covered_healpix(
    observations: Sequence[Observation],
    nside: int,
    nest: bool,
    frame: str,
) -> NDArray[np.int64]:
    """Pixels that any sample may hit: discs of the field of view's radius around the boresights.
    Sorted.
    """
    import healpy

    size = float(healpy.nside2resol(nside))
    found, pieces, together = np.zeros(0, np.int64), list[NDArray[np.int64]](), 0
    for observation in observations:
        radius = math.atan(observation.focalplane.radius)
        spacing = max(radius, size) / 4
        boresight = (
            directions(observation.boresight_radec, np.zeros(1), np.zeros(1))[0]
            @ frame_rotation(frame).T
        )
        fine = 1
        while fine < nside and healpy.nside2resol(fine) > spacing:
            fine *= 2
        cells, first = np.unique(healpy.vec2pix(fine, *boresight.T), return_index=True)
        del cells
        margin = min(radius + float(healpy.max_pixrad(fine)) * 2, math.pi)
        for k in first:
            pieces.append(healpy.query_disc(nside, boresight[k], margin, inclusive=True, nest=nest))
            together += pieces[-1].size
            if together > max(found.size, LEAST_TOGETHER):
                found, pieces, together = _union([found, *pieces]), [], 0  # discs overlap
    return _union([found, *pieces])


def _union(pieces: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Sorted union of the pieces."""
    every = np.concatenate(pieces)
    low, high = int(every.min()), int(every.max())
    if high - low > 64 * every.size:
        return np.unique(every)
    found = np.zeros(high - low + 1, np.bool_)  # five times faster than to sort them
    found[every - low] = True
    return low + np.flatnonzero(found)


@dataclass(frozen=True)
class Looking:
    """Pointing of one observation's detectors.

    Attributes
    ----------
    pointing
        What `Grid.pointing` gives.
    """

    observation: Observation
    grid: Grid
    pointing: Floats

    @classmethod
    def of(cls, observation: Observation, grid: Grid) -> Looking:
        """The pointing of all detectors of an observation."""
        return cls(observation, grid, grid.pointing(observation))

    @cached_property
    def key(self) -> Hashable:
        """Fingerprint of what pixels are made of; None where there is no other band."""
        if self.observation.common is None:
            return None
        grid, plane = self.grid, self.observation.focalplane
        known = (
            (grid.nside, grid.nest, fingerprint(grid.pixels_covered))
            if isinstance(grid, HealpixGrid)
            else grid
        )
        return "pixels", known, fingerprint(self.pointing, plane.xi, plane.eta)

    def pixels(self, which: NDArray[np.intp], start: int, stop: int) -> NDArray[np.int32]:
        """(n, stop - start) pixels of the detectors ``which`` (n,), -1 outside."""
        plane, index = self.observation.focalplane, np.empty((which.size, stop - start), np.int32)
        self.grid.pixels(self.pointing, start, stop, plane.xi[which], plane.eta[which], index)
        return index


class Cells:
    """Pixels of one block, found once for all bands and sums that look at the same; up to
    `MOST_BYTES` are held.
    """

    def __init__(self) -> None:
        self._found: dict[Hashable, NDArray[np.int32]] = {}
        self._left = MOST_BYTES

    def of(
        self,
        looking: Looking,
        which: NDArray[np.intp],
        start: int,
        stop: int,
    ) -> NDArray[np.int32]:
        """`Looking.pixels`. Read only."""
        key = looking.key or id(looking), which.tobytes(), start, stop
        if key in self._found:
            return self._found[key]
        found = looking.pixels(which, start, stop)
        if found.nbytes <= self._left:
            self._found[key], self._left = found, self._left - found.nbytes
        return found


def fingerprint(*arrays: NDArray[Any]) -> bytes:
    """Sixteen bytes that differ where the arrays do."""
    found = hashlib.blake2b(digest_size=16)
    for array in arrays:
        found.update(f"{array.dtype}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.digest()


def tiles(block: Block, used: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.int64], int, int]]:
    """Pieces of a block that stay in the cache: rows of the detectors that are ``used``
    (n_det,), first and last sample.

    Which detectors are together does not depend on the others.
    """
    for first in range(0, used.size, TILE_DETECTORS):
        some = first + np.flatnonzero(used[first : first + TILE_DETECTORS])
        if some.size:
            for start in range(block.samples.start, block.samples.stop, TILE_SAMPLES):
                yield some, start, min(start + TILE_SAMPLES, block.samples.stop)


@kernel(fastmath={"contract"})
def tangent_pixels(h, first, stop, xi, eta, ny, nx, out):  # type: ignore[no-untyped-def]
    """Flat index y nx + x of the pixel that holds each sample, -1 outside the image or behind it.
    ``h`` (9, n_samp).
    """
    wide, high, row_length = np.float64(nx), np.float64(ny), np.int32(nx)
    for low in range(first, stop, 256):  # coefficients stay in the first cache for all detectors
        end = min(low + 256, stop)
        h0, h1, h2 = h[0, low:end], h[1, low:end], h[2, low:end]
        h3, h4, h5 = h[3, low:end], h[4, low:end], h[5, low:end]
        h6, h7, h8 = h[6, low:end], h[7, low:end], h[8, low:end]
        for d in range(xi.size):
            a, b, pixel = xi[d], eta[d], out[d, low - first : end - first]
            for t in range(pixel.size):
                w = h6[t] * a + h7[t] * b + h8[t]
                scale = 1.0 / w
                x = (h0[t] * a + h1[t] * b + h2[t]) * scale + 0.5
                y = (h3[t] * a + h4[t] * b + h5[t]) * scale + 0.5
                inside = (w > 0.0) & (x >= 0.0) & (x < wide) & (y >= 0.0) & (y < high)
                x = x if inside else 0.0
                y = y if inside else 0.0
                p = np.int32(np.int32(y) * row_length + np.int32(x))
                pixel[t] = p if inside else np.int32(-1)
