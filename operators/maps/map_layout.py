"""What all observations of a map have in common: its centre, its extent, and the units of its
sums.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from .plate_carree import PlateCarreeGrid, box_about, box_of, grid_of_box, layout_about, middle_of

if TYPE_CHECKING:
    from .parameters import MapParameters

Image = TypeVar("Image", TangentGrid, PlateCarreeGrid)


def layout_of(
    step: MapParameters, observations: Sequence[Observation], before: Mapping[str, Any] | None
) -> Mapping[str, Any] | None:
    """Centre, extent and units of the sums: about the middle of all observations, and wide enough
    for them.

    ``before``: what those before had in common. Raises PipelineError for maps that cannot be added
    up.
    """
    if not observations:
        return before
    first = observations[0]
    instrument = first.instrument
    if before is None:
        levels = first.expected_net() if step.contents == "all" else first.focalplane.net
        # weights about 1 and below: a sample's weight times its value, mean emission included, must
        # fit the sums
        net = float(max(levels.min(), np.median(levels) / 4)) or instrument.net
        found: dict[str, Any] = {
            "variance": (
                2.0 ** round(math.log2(net**2 * first.sample_rate)) if net > 0 else 2.0**-12
            ),
            "fwhm": instrument.beam_fwhm,
            "frequency": instrument.band.centre,
            "fixed": step.nside is None and step.width is not None,
        }
    else:
        found = dict(before)
        if not math.isclose(found["frequency"], instrument.band.centre, rel_tol=1e-6):
            raise PipelineError(
                f"maps at {found['frequency'] / 1e9:.4g} GHz and {instrument.band.centre / 1e9:.4g}"
                " GHz cannot be added up",
                place=step.label,
                cure="leave the axis over which the band changes out of campaign.combine",
            )
    if step.nside:
        pixels = covered_healpix(observations, step.nside, step.ordering == "nested", step.frame)
        found["pixels"] = np.union1d(found["pixels"], pixels) if "pixels" in found else pixels
    found["fields"] = fields_of(step, observations, found.get("fields", []))
    if step.projection == "CAR" and not step.nside:
        found["pixel"] = step.pixel
        if step.width is not None:
            found["box"] = box_about(step, middle_of(found["fields"], step.pixel))
        else:
            found["box"] = box_of(step, observations, found.get("box"))
        found["middle"] = layout_about(found)
        return found
    *found["middle"], half_width, half_height = whole_of(found["fields"], step.label)
    found["half"] = [half_width, half_height]
    return found


def fields_of(
    step: MapParameters, observations: Sequence[Observation], before: Sequence[Sequence[float]]
) -> list[list[float]]:
    """Each target's field, (longitude, latitude, half its width, half its height) [rad, on its own
    tangent plane].

    ``before``: fields so far. Of a given centre there is one field about it; extents are 0 where
    they are not wanted.
    """
    found = [list(field) for field in before]
    together: dict[tuple[float, float], list[Observation]] = {}
    for observation in observations:
        together.setdefault(step.centre.icrs() if step.centre else observation.centre, []).append(
            observation
        )
    known = {(field[0], field[1]): field for field in found}
    for icrs, scans in together.items():
        longitude, latitude = (float(x) for x in in_frame(icrs, step.frame))
        reach = (0.0, 0.0)
        if step.nside is None and step.width is None and step.projection == "TAN":
            reach = covering_extent(scans, (longitude, latitude), step.frame)
        if (field := known.get((longitude, latitude))) is None:
            field = known[longitude, latitude] = [longitude, latitude, 0.0, 0.0]
            found.append(field)
        field[2:] = [max(field[2], reach[0]), max(field[3], reach[1])]
    if len(found) > MOST_FIELDS and step.nside is None and step.projection == "TAN":
        return [list(whole_of(found, step.label))]
    return found[:1] if step.nside else found


def grid_of(step: MapParameters, layout: Mapping[str, Any]) -> Grid:
    """The grid of a layout."""
    if step.nside:
        return HealpixGrid(
            step.nside,
            step.ordering == "nested",
            np.asarray(layout["pixels"], np.int64),
            step.frame,
        )
    if "box" in layout:
        return checked(step, grid_of_box(layout["box"], step.pixel, step.frame))
    longitude, latitude = layout["middle"]
    return image_grid(step, (longitude, latitude), layout.get("half", (0.0, 0.0)))


def image_grid(
    step: MapParameters, middle: tuple[float, float], half: Sequence[float]
) -> TangentGrid:
    """The grid of an image about ``middle`` that reaches ``half`` [rad] far, where no width is
    given.
    """
    width, height = step.width, step.height if step.height is not None else step.width
    width = width if width is not None else 2 * half[0] + 2 * step.pixel
    height = height if height is not None else 2 * half[1] + 2 * step.pixel
    nx, ny = (max(1, math.ceil(side / step.pixel - 1e-6)) for side in (width, height))
    return checked(step, TangentGrid(middle, step.pixel, (ny, nx), step.frame))


def checked(step: MapParameters, grid: Image) -> Image:
    """``grid``; InputError where it has more than `MOST_PIXELS` pixels."""
    ny, nx = grid.shape
    if nx * ny > MOST_PIXELS:
        cure = "choose larger pixels or a smaller width, or nside for a HEALPix map"
        raise InputError(f"a map of {nx} x {ny} pixels is too large", place=step.label, cure=cure)
    return grid


def check_size(step: MapParameters, observations: Sequence[Observation]) -> None:
    """Refuse an image that is too large for what is known of the scans: some instants of them
    (InputError).
    """
    fields = fields_of(step, observations, [])
    if step.projection == "CAR":
        wide = step.width is not None
        box = (
            box_about(step, middle_of(fields, step.pixel))
            if wide
            else box_of(step, observations, None)
        )
        checked(step, grid_of_box(box, step.pixel, step.frame))
    else:
        *middle, half_width, half_height = whole_of(fields, step.label)
        image_grid(step, (middle[0], middle[1]), (half_width, half_height))


def outside(step: MapParameters, observations: Sequence[Observation]) -> str:
    """The share of the samples outside an image of a given width."""
    fields = fields_of(step, observations, [])
    if step.projection == "CAR":
        car = grid_of_box(box_about(step, middle_of(fields, step.pixel)), step.pixel, step.frame)
        return (
            "samples outside the map: about"
            f" {percent(plate_carree.share_outside(car, observations), 2)}"
        )
    longitude, latitude, *_ = whole_of(fields, step.label)
    grid = image_grid(step, (longitude, latitude), (0.0, 0.0))
    scans = ((o.boresight_radec, o.focalplane.xi, o.focalplane.eta) for o in observations)
    return (
        "samples outside the map: about"
        f" {percent(share_outside(scans, pixel_matrix(grid.wcs), grid.shape), 2)}"
    )
