"""The layout that all observations of a map share: its centre, its extent, and the units of its
sums.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from zonda.core.data import Observation, percent
from zonda.core.errors import InputError, PipelineError
from zonda.core.numerics.projection import pixel_matrix, share_outside

from . import plate_carree
from .grid import (
    MOST_PIXELS,
    Grid,
    HealpixGrid,
    TangentGrid,
    covered_healpix,
    covering_extent,
    in_frame,
)
from .mosaic import MOST_FIELDS, whole_of
from .plate_carree import (
    Box,
    PlateCarreeGrid,
    box_about,
    box_of,
    grid_of_box,
    layout_about,
    middle_of,
)

if TYPE_CHECKING:
    from .parameters import MapParameters

Image = TypeVar("Image", TangentGrid, PlateCarreeGrid)


@dataclass(frozen=True)
class MapLayout:
    """Centre, extent and grid of the map that some parameters ask for."""

    parameters: MapParameters

    def common(
        self, observations: Sequence[Observation], before: Mapping[str, Any] | None
    ) -> Mapping[str, Any] | None:
        """Centre, extent and units of the sums: about the middle of all observations, and wide
        enough for them.

        ``before``: the layout of those before. Raises PipelineError for maps that cannot be added
        up.
        """
        asked = self.parameters
        if not observations:
            return before
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
        if asked.nside:
            pixels = covered_healpix(
                observations, asked.nside, asked.ordering == "nested", asked.frame
            )
            found["pixels"] = np.union1d(found["pixels"], pixels) if "pixels" in found else pixels
        found["fields"] = self.fields(observations, found.get("fields", []))
        if asked.projection == "CAR" and not asked.nside:
            found["pixel"] = asked.pixel
            found["box"] = self.box(found["fields"], observations, found.get("box"))
            found["middle"] = layout_about(found)
            return found
        *found["middle"], half_width, half_height = whole_of(found["fields"], asked.label)
        found["half"] = [half_width, half_height]
        return found

    def fields(
        self, observations: Sequence[Observation], before: Sequence[Sequence[float]]
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
                asked.centre.icrs() if asked.centre else observation.centre, []
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
        """The grid of a layout."""
        asked = self.parameters
        if asked.nside:
            return HealpixGrid(
                asked.nside,
                asked.ordering == "nested",
                np.asarray(layout["pixels"], np.int64),
                asked.frame,
            )
        if "box" in layout:
            return checked(grid_of_box(layout["box"], asked.pixel, asked.frame), asked.label)
        longitude, latitude = layout["middle"]
        return self.image((longitude, latitude), layout.get("half", (0.0, 0.0)))

    def image(self, middle: tuple[float, float], half: Sequence[float]) -> TangentGrid:
        """The grid of an image about ``middle`` that reaches ``half`` [rad] far, where no width is
        given.
        """
        asked = self.parameters
        width, height = asked.width, asked.height if asked.height is not None else asked.width
        width = width if width is not None else 2 * half[0] + 2 * asked.pixel
        height = height if height is not None else 2 * half[1] + 2 * asked.pixel
        nx, ny = (max(1, math.ceil(side / asked.pixel - 1e-6)) for side in (width, height))
        return checked(TangentGrid(middle, asked.pixel, (ny, nx), asked.frame), asked.label)

    def check_size(self, observations: Sequence[Observation]) -> None:
        """Refuse an image that is too large for what is known of the scans: some instants of them
        (InputError).
        """
        asked = self.parameters
        fields = self.fields(observations, [])
        if asked.projection == "CAR":
            box = self.box(fields, observations)
            checked(grid_of_box(box, asked.pixel, asked.frame), asked.label)
        else:
            *middle, half_width, half_height = whole_of(fields, asked.label)
            self.image((middle[0], middle[1]), (half_width, half_height))

    def outside(self, observations: Sequence[Observation]) -> str:
        """The share of the samples outside an image of a given width."""
        asked = self.parameters
        fields = self.fields(observations, [])
        if asked.projection == "CAR":
            car = grid_of_box(self.box(fields, observations), asked.pixel, asked.frame)
            return (
                "samples outside the map: about"
                f" {percent(plate_carree.share_outside(car, observations), 2)}"
            )
        longitude, latitude, *_ = whole_of(fields, asked.label)
        grid = self.image((longitude, latitude), (0.0, 0.0))
        scans = ((o.boresight_radec, o.focalplane.xi, o.focalplane.eta) for o in observations)
        return (
            "samples outside the map: about"
            f" {percent(share_outside(scans, pixel_matrix(grid.wcs), grid.shape), 2)}"
        )


def checked(grid: Image, place: str) -> Image:
    """``grid``; InputError where it has more than `MOST_PIXELS` pixels."""
    ny, nx = grid.shape
    if nx * ny > MOST_PIXELS:
        cure = "choose larger pixels or a smaller width, or nside for a HEALPix map"
        raise InputError(f"a map of {nx} x {ny} pixels is too large", place=place, cure=cure)
    return grid
