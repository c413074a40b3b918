"""The layout that all observations of a map share: its centre, its extent, and the units of its
sums.

Each of several targets has a field, a rectangle on its own tangent plane. A gnomonic projection
turns straight edges into straight edges, so that the box around the images of the corners on
another tangent plane holds the whole field.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from zonda.core.data import Observation
from zonda.core.errors import InputError, PipelineError
from zonda.core.numerics.sphere import ARCSEC, local_axes, position, unit_vectors
from zonda.core.types import Floats

from .grid import (
    MOST_PIXELS,
    Grid,
    HealpixGrid,
    PlateCarreeGrid,
    TangentGrid,
    covered_healpix,
    covering_extent,
    in_frame,
)
from .plate_carree import Box, box_about, box_of, centre_of, middle_of

if TYPE_CHECKING:
    from .parameters import MapParameters


MOST_FIELDS = 1000
"""More are taken together as one."""
FARTHEST = math.radians(45.0)
"""From the middle: there a pixel of a tangent plane is stretched by 1 / cos^2 = 2."""


def whole_of(fields: Sequence[Sequence[float]], place: str) -> tuple[float, float, float, float]:
    """(longitude, latitude, half the width, half the height) [rad] of the image that holds all
    fields, each given likewise.

    Of one field: itself. Raises InputError where they are too far apart for an image.
    """
    if len(fields) == 1:
        longitude, latitude, width, height = fields[0]
        return longitude, latitude, width, height
    corners = np.concatenate([_corners(*field) for field in fields])
    direction = np.array([unit_vectors(field[0], field[1]) for field in fields]).mean(axis=0)
    for _ in range(2):  # towards the middle of the box
        axes = _axes(direction)
        x, y = _projected(corners, axes, place)
        direction = axes.T @ [1.0, (x.min() + x.max()) / 2, (y.min() + y.max()) / 2]
    axes = _axes(direction)
    x, y = _projected(corners, axes, place)
    longitude, latitude = position(axes[0])
    return longitude, latitude, float(abs(x).max()), float(abs(y).max())


def _corners(longitude: float, latitude: float, width: float, height: float) -> Floats:
    """(4, 3) directions of a field's corners."""
    offsets = [[1.0, i * width, j * height] for i in (-1, 1) for j in (-1, 1)]
    corners = np.array(offsets) @ local_axes(longitude, latitude)
    return np.asarray(corners / np.linalg.norm(corners, axis=1)[:, None])


def _axes(direction: Floats) -> Floats:
    return local_axes(*position(direction))


def _projected(corners: Floats, axes: Floats, place: str) -> Floats:
    """(2, n) east and north of corners (n, 3) on the tangent plane of ``axes``."""
    ahead, east, north = axes @ corners.T
    if ahead.min() < math.cos(FARTHEST):
        apart = math.degrees(math.acos(max(float((corners @ corners.T).min()), -1.0)))
        raise InputError(
            f"the scans reach over {apart:.0f} deg, too far for one image (tangent plane)",
            place=place,
            cure=(
                "give nside for a HEALPix map, or make a map of each target (in a campaign: leave"
                " target out of combine)"
            ),
        )
    return np.asarray([east / ahead, north / ahead])


Image = TypeVar("Image", TangentGrid, PlateCarreeGrid)


@dataclass(frozen=True)
class MapLayout:
    """Centre, extent and grid of the map that some parameters ask for."""

    parameters: MapParameters

    def warn_of_pixels(self, observations: Sequence[Observation]) -> None:
        """Warn of pixels that are too large for the beam."""
        asked, beam = self.parameters, observations[0].instrument.beam_fwhm
        most, effect = asked.largest_pixel
        side = math.sqrt(math.pi / 3) / asked.nside if asked.nside else asked.pixel
        if 0 < most * beam < side:
            pixel, fwhm, third = (f"{a / ARCSEC:.3g} arcsec" for a in (side, beam, beam / 3))
            cure = "raise nside" if asked.nside else f"choose pixel: {third} or less"
            text = f"{asked.label}: a pixel of {pixel} for a beam of {fwhm}"
            warnings.warn(f"{text}: {effect}; {cure}", stacklevel=1)

    def common(
        self,
        observations: Sequence[Observation],
        before: Mapping[str, Any] | None,
    ) -> Mapping[str, Any] | None:
        """Centre, extent and units of the sums: about the middle of all observations, and wide
        enough for them.

        ``before``: the layout of those before. Raises PipelineError for maps that cannot be added
        up.
        """
        asked = self.parameters
        if not observations:
            return before
        self.warn_of_pixels(observations)
        first = observations[0]
        instrument = first.instrument
        if before is None:
            levels = first.expected_net() if asked.contents == "all" else first.focalplane.net
            # weights about 1 and below: a sample's weight times its value, mean emission included,
            # must fit the sums
            net = float(max(levels.min(), np.median(levels) / 4)) or instrument.net
            found: dict[str, Any] = {
                "variance": (
                    2.0 ** round(math.log2(net**2 * first.sample_rate)) if net > 0 else 2.0**-12
                ),
                "fwhm": instrument.beam_fwhm,
                "frequency": instrument.band.centre,
                "fixed": asked.nside is None and asked.width is not None,
            }
        else:
            found = dict(before)
            if not math.isclose(found["frequency"], instrument.band.centre, rel_tol=1e-6):
                raise PipelineError(
                    f"maps at {found['frequency'] / 1e9:.4g} GHz and"
                    f" {instrument.band.centre / 1e9:.4g} GHz cannot be added up",
                    place=asked.label,
                    cure="leave the axis over which the band changes out of campaign.combine",
                )
        return found | self.place(observations, found)

    def place(
        self,
        observations: Sequence[Observation],
        before: Mapping[str, Any],
    ) -> dict[str, Any]:
        """Fields of the targets, middle and extent of the map: ``half`` [rad] of a TAN image, the
        ``box`` of a CAR one, or HEALPix ``pixels``. ``before``: the layout of those before.
        """
        asked = self.parameters
        found: dict[str, Any] = {}
        fields = found["fields"] = self.fields(observations, before.get("fields", []))
        if asked.nside:
            nest = asked.ordering == "nested"
            pixels = covered_healpix(observations, asked.nside, nest, asked.frame)
            found["pixels"] = np.union1d(before["pixels"], pixels) if "pixels" in before else pixels
        elif asked.projection == "CAR":
            box = found["box"] = self.box(fields, observations, before.get("box"))
            one = len(fields) == 1
            found["middle"] = tuple(fields[0][:2]) if one else centre_of(box, asked.pixel)
            return found
        *found["middle"], width, height = whole_of(fields, asked.label)
        found["half"] = [width, height]
        return found

    def fields(
        self,
        observations: Sequence[Observation],
        before: Sequence[Sequence[float]],
    ) -> list[list[float]]:
        """Each target's field, (longitude, latitude, half its width, half its height) [rad, on its
        own tangent plane].

        ``before``: fields so far. Of a given centre there is one field about it; extents are 0
        where they are not wanted.
        """
        asked = self.parameters
        found = [list(field) for field in before]
        together: dict[tuple[float, float], list[Observation]] = {}
        for observation in observations:
            together.setdefault(
                asked.centre.icrs() if asked.centre else observation.centre,
                [],
            ).append(observation)
        known = {(field[0], field[1]): field for field in found}
        for icrs, scans in together.items():
            longitude, latitude = (float(x) for x in in_frame(icrs, asked.frame))
            reach = (0.0, 0.0)
            if asked.nside is None and asked.width is None and asked.projection == "TAN":
                reach = covering_extent(scans, (longitude, latitude), asked.frame)
            if (field := known.get((longitude, latitude))) is None:
                field = known[longitude, latitude] = [longitude, latitude, 0.0, 0.0]
                found.append(field)
            field[2:] = [max(field[2], reach[0]), max(field[3], reach[1])]
        if len(found) > MOST_FIELDS and asked.nside is None and asked.projection == "TAN":
            return [list(whole_of(found, asked.label))]
        return found[:1] if asked.nside else found

    def box(
        self,
        fields: Sequence[Sequence[float]],
        observations: Sequence[Observation],
        before: Sequence[int] | None = None,
    ) -> Box:
        """The pixels of a CAR image: of the given width about the middle of the fields, else those
        that hold all samples of the observations and a box ``before``.
        """
        asked = self.parameters
        if asked.width is None:
            return box_of(observations, asked.pixel, asked.frame, before)
        height = asked.height if asked.height is not None else asked.width
        return box_about(middle_of(fields, asked.pixel), asked.width, height, asked.pixel)

    def grid(self, layout: Mapping[str, Any]) -> Grid:
        """The grid of a layout. InputError for an image that is too large."""
        asked = self.parameters
        if asked.nside:
            pixels = np.asarray(layout["pixels"], np.int64)
            return HealpixGrid(asked.nside, asked.ordering == "nested", pixels, asked.frame)
        if "box" in layout:
            box = PlateCarreeGrid.of_box(layout["box"], asked.pixel, asked.frame)
            return checked(box, asked.label)
        height = asked.width if asked.height is None else asked.height
        nx, ny = (
            max(
                1,
                math.ceil(
                    (2 * half / asked.pixel + 2 if side is None else side / asked.pixel) - 1e-6
                ),
            )
            for side, half in zip((asked.width, height), layout["half"], strict=True)
        )
        longitude, latitude = layout["middle"]
        image = TangentGrid((longitude, latitude), asked.pixel, (ny, nx), asked.frame)
        return checked(image, asked.label)

    def outside(self, observations: Sequence[Observation], grid: Grid | None = None) -> float:
        """Share of the samples outside an image of a given width, of some hundred instants of each
        scan. ``grid``: of the image, if it is known. InputError for an image that is too large.
        """
        grid = grid or self.grid(self.place(observations, {}))
        beyond = looked = 0
        for scan in observations if self.parameters.width is not None else ():
            plane, at = scan.focalplane, slice(None, None, -(-scan.n_samples // 256))
            some = slice(None, None, -(-len(plane) // 37))
            h = np.ascontiguousarray(grid.pointing(scan)[:, at])
            index = np.empty((len(plane.xi[some]), h.shape[1]), np.int32)
            grid.pixels(h, 0, h.shape[1], plane.xi[some], plane.eta[some], index)
            beyond, looked = beyond + int(np.count_nonzero(index < 0)), looked + index.size
        return beyond / max(looked, 1)


def checked(grid: Image, place: str) -> Image:
    """``grid``; InputError where it has more than `MOST_PIXELS` pixels."""
    ny, nx = grid.shape
    if nx * ny > MOST_PIXELS:
        cure = "choose larger pixels or a smaller width, or nside for a HEALPix map"
        raise InputError(f"a map of {nx} x {ny} pixels is too large", place=place, cure=cure)
    return grid
