"""What all observations of a map have in common: its centre, its extent, and the units of its sums."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.data import Observation, percent
from zonda.core.errors import InputError, PipelineError
from zonda.core.numerics.projection import pixel_matrix, share_outside

from .grid import MOST_PIXELS, Grid, HealpixGrid, TangentGrid, covered_healpix, covering_extent, in_frame

if TYPE_CHECKING:
    from .parameters import MapParameters


def layout_of(
    step: MapParameters, observations: Sequence[Observation], before: Mapping[str, Any] | None
) -> Mapping[str, Any] | None:
    """Centre, extent and units of the sums: of the first observation, and wide enough for all.

    ``before``: what those before had in common. Raises PipelineError for maps that cannot be added up.
    """
    if not observations:
        return before
    first = observations[0]
    instrument = first.instrument
    if before is None:
        levels = first.expected_net() if step.contents == "all" else first.focalplane.net
        # weights about 1 and below: a sample's weight times its value, mean emission included, must fit the sums
        net = float(max(levels.min(), np.median(levels) / 4)) or instrument.net
        found: dict[str, Any] = {
            "variance": 2.0 ** round(math.log2(net**2 * first.sample_rate)) if net > 0 else 2.0**-12,
            "fwhm": instrument.beam_fwhm,
            "frequency": instrument.band.centre,
            "middle": [float(x) for x in in_frame(step.centre.icrs() if step.centre else first.centre, step.frame)],
            "fixed": step.nside is None and step.width is not None,
        }
    else:
        found = dict(before)
        if not math.isclose(found["frequency"], instrument.band.centre, rel_tol=1e-6):
            raise PipelineError(
                f"maps at {found['frequency'] / 1e9:.4g} GHz and {instrument.band.centre / 1e9:.4g} GHz cannot be added up",
                place=step.label,
                cure="leave the axis over which the band changes out of campaign.combine",
            )
    if step.nside:
        pixels = covered_healpix(observations, step.nside, step.ordering == "nested", step.frame)
        found["pixels"] = np.union1d(found["pixels"], pixels) if "pixels" in found else pixels
    elif not found["fixed"]:
        longitude, latitude = found["middle"]
        reach = covering_extent(observations, (longitude, latitude), step.frame)
        half = found.get("half", (0.0, 0.0))
        found["half"] = [max(half[0], reach[0]), max(half[1], reach[1])]
    return found


def grid_of(step: MapParameters, layout: Mapping[str, Any]) -> Grid:
    """The grid of a layout."""
    if step.nside:
        return HealpixGrid(step.nside, step.ordering == "nested", np.asarray(layout["pixels"], np.int64), step.frame)
    longitude, latitude = layout["middle"]
    return image_grid(step, (longitude, latitude), layout.get("half", (0.0, 0.0)))


def image_grid(step: MapParameters, middle: tuple[float, float], half: Sequence[float]) -> TangentGrid:
    """The grid of an image about ``middle`` that reaches ``half`` [rad] far, where no width is given."""
    width, height = step.width, step.height if step.height is not None else step.width
    width = width if width is not None else 2 * half[0] + 2 * step.pixel
    height = height if height is not None else 2 * half[1] + 2 * step.pixel
    nx, ny = (max(1, math.ceil(side / step.pixel - 1e-6)) for side in (width, height))
    if nx * ny > MOST_PIXELS:
        raise InputError(
            f"a map of {nx} x {ny} pixels is too large", place=step.label, cure="choose larger pixels or a smaller width"
        )
    return TangentGrid(middle, step.pixel, (ny, nx), step.frame)


def outside(step: MapParameters, observations: Sequence[Observation]) -> str:
    """The share of the samples outside an image of a given width."""
    longitude, latitude = in_frame(step.centre.icrs() if step.centre else observations[0].centre, step.frame)
    grid = image_grid(step, (float(longitude), float(latitude)), (0.0, 0.0))
    scans = ((o.boresight_radec, o.focalplane.xi, o.focalplane.eta) for o in observations)
    return f"samples outside the map: about {percent(share_outside(scans, pixel_matrix(grid.wcs), grid.shape), 2)}"
