"""Place of an input map on the sky by its header alone, for `zonda check` and ``target: map``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zonda.core.configuration.target import Target
from zonda.core.numerics.projection import pixel_matrix
from zonda.core.numerics.sphere import angle_between, angles, unit_vectors
from zonda.core.types import Floats

from .geometry import moved, placed
from .input_map import ImageMap, InputMap


@dataclass(frozen=True)
class Footprint:
    """Centre and extent of a map on the sky.

    Attributes
    ----------
    centre
        ICRS direction (3,) of the middle of the image.
    radius
        Largest distance of its pixels from there, rad.
    matrix
        From ICRS directions to pixels (`pixel_matrix`) of a TAN image, else None.
    shape
        (ny, nx).
    """

    centre: Floats
    radius: float
    matrix: Floats | None
    shape: tuple[int, int]

    def holds(self, direction: Floats) -> bool:
        """True if an ICRS direction (3,) is on the map; in other projections than TAN, within its
        `radius`.
        """
        if self.matrix is None:
            return bool(direction @ self.centre >= np.cos(self.radius))
        x, y, depth = self.matrix @ direction
        ny, nx = self.shape
        return bool(depth > 0 and -0.5 <= x / depth <= nx - 0.5 and -0.5 <= y / depth <= ny - 0.5)

    @classmethod
    def of(cls, image: InputMap, centre: Target | None, place: str) -> Footprint | None:
        """Of a map that is put at ``centre``; None where it has no place of its own: HEALPix, or an
        image without a WCS. Raises InputError as `moved`.
        """
        if not isinstance(image, ImageMap) or (image.placeless and centre is None):
            return None
        at = None if centre is None else centre.icrs()
        wcs = placed(image, at)
        disc, _ = (image if at is None else moved(image, at, place)).extent
        matrix = None if wcs is None else pixel_matrix(wcs)
        return None if disc is None else cls(disc.centre, disc.radius, matrix, image.shape)

    @property
    def target(self) -> Target:
        """Its centre as text, to 1e-9 deg."""
        ra, dec = np.degrees(angles(self.centre))
        return Target.parse(f"{ra:.9f} deg {dec:.9f} deg")


def off_the_map(found: Footprint, centre: tuple[float, float], label: str) -> str:
    """The warning about a scan about ``centre``, ICRS (ra, dec) [rad], that is not on the map;
    empty where it is.
    """
    ra, dec = centre
    direction = unit_vectors(ra, dec)
    if found.holds(direction):
        return ""
    away = np.degrees(angle_between(direction, found.centre))
    return (
        f"{label}: the target {position(ra, dec)} is not on the input map, whose centre,"
        f" {position(*found.target.icrs())}, is {away:.3g} deg away; `target: map` looks there"
    )


def position(ra: float, dec: float) -> str:
    """ICRS coordinates as a pipeline file takes them."""
    return f"{np.degrees(ra):.5f} deg {np.degrees(dec):.5f} deg"
