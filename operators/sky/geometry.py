"""Directions of an image's pixels by its header (the WCS, or pixels of a known size), or as the
user places them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from astropy import units as u
from astropy.wcs import WCS

from zonda.core.configuration.target import Target
from zonda.core.errors import InputError
from zonda.core.maps.header import ANGLES, is_celestial, with_known_frame, with_known_units
from zonda.core.numerics.projection import pixel_matrix, wcs_frame_rotation
from zonda.core.numerics.sphere import angle_between, angles, local_axes, unit_vectors
from zonda.core.storage.files import first_line
from zonda.core.types import Floats

from .input_map import ImageMap, InputMap
from .map_header import MapHeader


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
        """The footprint of a map that is put at ``centre``; None where it has no place of its own:
        HEALPix, or an image without a WCS. Raises InputError as `moved`.
        """
        if not isinstance(image, ImageMap) or (image.placeless and centre is None):
            return None
        at = None if centre is None else centre.icrs()
        wcs = placed(image, at)
        disc, _ = moved(image, at, place).extent
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


ROUNDED = 1e-12
"""rad by which a map that is moved along is not turned."""
FARTHEST = 1e9
"""Pixel of the reference point."""
EQUINOXES = (1500.0, 2500.0)
UNITS = "CUNIT1 and CUNIT2 ('deg' or 'rad')"


class ImageHeader(MapHeader):
    """The header of an image, from which its world coordinates follow."""

    def geometry(self, shape: tuple[int, ...]) -> tuple[Any, bool]:
        """`ImageMap`'s ``wcs`` and ``placeless`` of an image of ``shape`` (..., ny, nx), or the
        error that says what is missing.
        """
        header = with_known_units(self.header, self.place)
        wanted = self.wanted
        scaled = any(f"CD{i}_{j}" in header for i in (1, 2) for j in (1, 2)) or all(
            f"CDELT{k}" in header for k in (1, 2)
        )
        or_size = "or the operator's parameter pixel_size: 1 arcsec"
        if not scaled and wanted.pixel_size is None:
            cure = f"set the header keys CDELT1, CDELT2, {UNITS}, {or_size}"
            raise self.error("the pixel size is missing", cure)
        if not all(is_celestial(header, axis) for axis in "12"):
            if wanted.pixel_size is None and not header.get("CUNIT1"):
                cure = f"set the header keys {UNITS}, {or_size}"
                raise self.error("the unit of the pixel size is missing", cure)
            if wanted.pixel_size is None:
                self._check_position(["CTYPE1", "CTYPE2", "CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2"])
            self.notes["position"] = (
                "the file has no WCS: its centre is put on the target, its first axis runs west,"
                " its second north"
            )
            bare = WCS(naxis=2)
            bare.wcs.ctype, bare.wcs.radesys = ["RA---TAN", "DEC--TAN"], "ICRS"
            bare.wcs.crpix = (np.array(shape[:-3:-1]) + 1) / 2
            # the first axis runs west whatever the sign of its CDELT
            return rescaled(bare, self._sides(header) * [[-1, 0], [0, 1]]), True
        header = self._with_frame(header)
        needed = ("CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2")
        self._check_position([key for key in needed if key not in header])
        wcs, matrix = self._wcs(header)
        if wanted.pixel_size is None:
            self.check_sides(np.hypot(*matrix), "check CDELT1, CDELT2, PC and CD")
            return wcs, False
        if not is_plain_tan(wcs):
            kind = ", ".join(wcs.wcs.ctype)
            message = f"pixel_size cannot replace the scale of a map in projection {kind}"
            raise self.error(message, "remove pixel_size, or give a TAN map")
        size = np.degrees(wanted.pixel_size)
        self.notes["pixel size"] = (
            f"{size * 3600:g} arcsec as given; the header's scale is overridden"
        )
        cd = matrix if scaled else np.diag([-1.0, 1.0])
        return rescaled(wcs, cd / np.linalg.norm(cd, axis=0) * size), False

    def _check_position(self, absent: list[str]) -> None:
        """Raise InputError if keys of the position are ``absent`` and it is needed."""
        if absent and not self.wanted.centred:
            raise self.error(
                "the map has no world coordinates, so its position on the sky is unknown",
                f"set the header keys {', '.join(absent)}, or the operator's parameter centre"
                " (a position, or 'target')",
            )

    def _with_frame(self, header: Any) -> Any:
        """`with_known_frame`; axes that are neither equatorial nor Galactic are refused."""
        kinds = {str(header[f"CTYPE{axis}"]).upper()[:4] for axis in "12"}
        if kinds not in ({"GLON", "GLAT"}, {"RA--", "DEC-"}):
            axes = f"{header['CTYPE1']}, {header['CTYPE2']}"
            raise self.error(
                f"the axes {axes} are neither equatorial nor Galactic",
                "give a map in ICRS, FK5, FK4 or Galactic coordinates",
            )
        header, note = with_known_frame(header, self.place)
        if note:
            self.notes["coordinates"] = note
        for key in ("EQUINOX", "EPOCH"):
            year = header.get(key)
            if isinstance(year, int | float) and not EQUINOXES[0] <= year <= EQUINOXES[1]:
                message = f"{key} = {year:g} is no year of an equinox"
                raise self.error(message, f"set {key}, e.g. to 2000.0")
        return header

    def _wcs(self, header: Any) -> tuple[Any, Floats]:
        """The WCS of a header and its pixel scale matrix (2, 2) [deg]."""
        try:
            wcs = WCS(header, naxis=2)
            wcs.wcs.set()
            matrix = np.asarray(wcs.pixel_scale_matrix)
        except Exception as err:  # wcslib has a dozen exception classes of its own
            message = f"the WCS is broken: {first_line(err)}"
            raise self.error(message, "check CTYPE, CRVAL, CRPIX, CDELT, PC or CD") from err
        with np.errstate(over="ignore"):
            area = np.linalg.det(matrix)
        numbers = [*matrix.ravel(), *wcs.wcs.crval, *wcs.wcs.crpix]
        if not np.isfinite(numbers).all() or area == 0.0:
            message = "the WCS is singular: its pixels have no area"
            raise self.error(message, "check CDELT1, CDELT2, PC and CD")
        if np.abs(wcs.wcs.crpix).max() > FARTHEST:
            message = f"the reference point is pixel {', '.join(f'{p:.3g}' for p in wcs.wcs.crpix)}"
            raise self.error(message, f"CRPIX1 and CRPIX2 may be up to {FARTHEST:g}")
        return wcs, matrix

    def _sides(self, header: Any) -> Floats:
        """(2,) sides [deg] of the pixels of a map without celestial axes."""
        if self.wanted.pixel_size is not None:
            return np.asarray(np.degrees(np.full(2, self.wanted.pixel_size)))
        units = [str(header.get(f"CUNIT{k}") or header.get("CUNIT1")).strip() for k in (1, 2)]
        for k, written in enumerate(units, 1):
            if written not in ANGLES:
                raise self.no_angle(f"CUNIT{k}", written)
        sides = np.linalg.norm(self._wcs(header)[1], axis=0)
        sides = np.degrees(sides * [u.Unit(ANGLES[written]).to("rad") for written in units])
        self.check_sides(sides, "check CDELT1 and CDELT2")
        return np.asarray(sides)


def rescaled(wcs: Any, matrix: Floats) -> Any:
    """A copy of a plain TAN ``wcs`` with the pixel scale matrix (2, 2) [deg], whether it had CD,
    PC, CDELT or CROTA.
    """
    made = WCS(naxis=2)
    for key in ("ctype", "crval", "crpix", "radesys", "equinox", "lonpole", "latpole"):
        setattr(made.wcs, key, getattr(wcs.wcs, key))
    made.wcs.cdelt = [1.0, 1.0]
    made.wcs.pc = matrix
    made.wcs.set()
    return made


def is_plain_tan(wcs: Any) -> bool:
    """True for a gnomonic projection without distortions, which needs no resampling; in a frame
    that is a rotation of ICRS.
    """
    if (
        not all(str(c).endswith("-TAN") for c in wcs.wcs.ctype)
        or wcs.has_distortion
        or len(wcs.wcs.get_pv())
    ):
        return False
    try:
        wcs_frame_rotation(wcs)
    except InputError:
        return False
    return True


def placed(image: ImageMap, centre: tuple[float, float] | None) -> Any:
    """The TAN `WCS` of an image, or None where it must be resampled (another projection,
    distortions).

    Parameters
    ----------
    centre
        ICRS (ra, dec) [rad]: the image's centre, pixel ((nx + 1) / 2, (ny + 1) / 2) counted from 1,
        is put there. An image that has a place is moved as a whole (`moved`); one that has none
        touches the sky there, its second axis north. None: where the header puts it.

    """
    if not is_plain_tan(image.wcs):
        return None
    if centre is None:
        return image.wcs
    rows, columns = image.shape
    wcs = WCS(naxis=2)
    old = image.wcs.wcs
    wcs.wcs.radesys, wcs.wcs.lonpole = "ICRS", 180.0
    wcs.wcs.ctype = ["DEC--TAN", "RA---TAN"] if old.lng == 1 else ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crpix = np.asarray(old.crpix[:2], np.float64)
    # the axes of the tangent point, in ICRS there
    own = local_axes(*np.radians([old.crval[old.lng], old.crval[old.lat]])) @ _turned(image, centre)
    is_middle = (wcs.wcs.crpix == [(columns + 1) / 2, (rows + 1) / 2]).all()
    ra, dec = centre if is_middle else (float(v) for v in angles(own[0]))
    _, east, north = local_axes(ra, dec)
    angle = float(np.arctan2(own[2] @ east, own[2] @ north)) + np.radians(
        float(old.lonpole) - 180.0
    )
    matrix = np.asarray(image.wcs.pixel_scale_matrix, np.float64)
    if abs(angle) > ROUNDED:
        # east and north of the image's matrix are its own: each is turned from north to east
        c = np.cos(angle)
        s = np.sin(angle)
        matrix = np.array([[c, s], [-s, c]] if old.lng == 0 else [[c, -s], [s, c]]) @ matrix
    wcs.wcs.crval = np.degrees([dec, ra] if old.lng == 1 else [ra, dec])
    return rescaled(wcs, matrix)


def moved(image: ImageMap, centre: tuple[float, float] | None, place: str) -> ImageMap:
    """An image of any projection moved over the sky with its centre to ``centre``, ICRS (ra, dec)
    [rad]; None: as it is.

    The sphere is turned, so that the image keeps its shape, and directions at its centre keep their
    angles from ICRS north: what lies east stays east, whatever the frame of the image. Its Q and U
    turn with it; those of an image without a place are counted from the meridians there.

    Raises InputError where the image's centre is beyond its projection.
    """
    if centre is None:
        return image
    if image.placeless:
        return replace(image, wcs=placed(image, centre), placeless=False)
    turn = _turned(image, centre)
    if not np.isfinite(turn).all():
        raise InputError(
            f"the middle of the map is beyond its projection {', '.join(image.wcs.wcs.ctype)}",
            place=place,
            cure="remove centre, or cut the map",
        )
    return replace(image, moved=turn)


def _turned(image: ImageMap, centre: tuple[float, float]) -> Floats:
    """(3, 3) from ICRS directions about ``centre`` to the image's own about its middle."""
    middle = local_axes(*(float(v) for v in angles(image.directions(image.middle))))
    return image.turn @ (middle.T @ local_axes(*centre))
