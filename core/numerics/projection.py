"""From the focal plane to the pixels of a tangent-plane image: one 3 x 3 matrix per time sample.

A gnomonic projection of the focal plane and a gnomonic (TAN) image are both central projections of
the sphere, so the map from one to the other is a homography (Hartley & Zisserman 2004, section
2.3):

    x = (h0 xi + h1 eta + h2) / w,   y = (h3 xi + h4 eta + h5) / w,
    w = h6 xi + h7 eta + h8            (1)

exact, without trigonometry. ``w`` is the cosine to the image centre times the length of (xi, eta,
1): where w <= 0 the direction lies in the opposite hemisphere and has no pixel.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..types import Floats
from .chunks import chunks, empty

if TYPE_CHECKING:
    from astropy.wcs import WCS

GALACTIC = (
    (-0.05487565771259163, -0.8734370519556159, -0.48383507361671546),
    (0.4941094371927268, -0.4448297212232952, 0.7469821839866676),
    (-0.8676661375596576, -0.19807633727300053, 0.4559838136873016),
)
"""The rotation from ICRS to Galactic coordinates as astropy makes it, which takes half a second to
import.
"""


def rotation_matrices(quaternions: Floats) -> Floats:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4) in the order x, y, z, w; they need not be
    normalized.
    """
    return np.moveaxis(_rotations(quaternions), 2, 0)


def _rotations(quaternions: Floats) -> Floats:
    """Rotation matrices (3, 3, n), see `rotation_matrices`: each element lies in one piece."""
    found = np.empty((3, 3, len(quaternions)))
    for s in chunks(len(quaternions)):
        x, y, z, w = _normalized(quaternions[s])
        found[0, 0, s], found[0, 1, s], found[0, 2, s] = (
            1 - 2 * (y * y + z * z),
            2 * (x * y - z * w),
            2 * (x * z + y * w),
        )
        found[1, 0, s], found[1, 1, s], found[1, 2, s] = (
            2 * (x * y + z * w),
            1 - 2 * (x * x + z * z),
            2 * (y * z - x * w),
        )
        found[2, 0, s], found[2, 1, s], found[2, 2, s] = (
            2 * (x * z - y * w),
            2 * (y * z + x * w),
            1 - 2 * (x * x + y * y),
        )
    return found


def boresights(quaternions: Floats) -> Floats:
    """Unit vectors (3, n) that boresight quaternions (n, 4) look at: the last column of
    `rotation_matrices`.
    """
    found = empty((3, len(quaternions)))
    for s in chunks(len(quaternions)):
        x, y, z, w = _normalized(quaternions[s])
        found[0, s], found[1, s], found[2, s] = (
            2 * (x * z + y * w),
            2 * (y * z - x * w),
            1 - 2 * (x * x + y * y),
        )
    return found


def _normalized(quaternions: Floats) -> Floats:
    """(4, n)"""
    q = np.ascontiguousarray(np.asarray(quaternions, np.float64).T)
    return np.asarray(q / np.sqrt((q * q).sum(axis=0)))


def frame_rotation(frame: str) -> Floats:
    """Matrix (3, 3) that turns an ICRS direction into one in ``frame`` (``icrs``, ``fk5``,
    ``galactic`` or astropy's name).
    """
    if frame == "icrs":
        return np.eye(3)
    if frame == "galactic":
        return np.array(GALACTIC)
    from astropy.coordinates.baseframe import frame_transform_graph

    if frame_transform_graph.lookup_name(frame) is None:
        raise InputError(
            f"unknown celestial frame {frame!r}",
            place="frame",
            cure="use icrs or galactic",
        )
    return _rotation_into(frame, frame, "frame")


def wcs_frame_rotation(wcs: WCS) -> Floats:
    """Matrix (3, 3) from ICRS directions to directions in the frame of ``wcs``."""
    from astropy.wcs.utils import wcs_to_celestial_frame

    try:
        frame = wcs_to_celestial_frame(wcs)
    except ValueError:
        raise InputError(
            "the WCS has no celestial frame",
            place="WCS",
            cure="set CTYPE1, CTYPE2 and RADESYS",
        ) from None
    if frame.name in ("icrs", "galactic"):
        return frame_rotation(frame.name)
    return _rotation_into(frame, f"the WCS's frame {frame.name}", "WCS")


def _rotation_into(frame: Any, called: str, place: str) -> Floats:
    from astropy.coordinates import SkyCoord

    axes = SkyCoord(
        x=[1, 0, 0],
        y=[0, 1, 0],
        z=[0, 0, 1],
        representation_type="cartesian",
        frame="icrs",
    ).transform_to(frame)
    matrix: Floats = np.array(axes.cartesian.xyz.value, dtype=np.float64)
    if not np.allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=1e-12):
        raise InputError(
            f"{called} is not a rotation of ICRS",
            place=place,
            cure="use icrs or galactic",
        )
    return matrix


def pixel_matrix(wcs: WCS) -> Floats:
    """Matrix P (3, 3): an ICRS direction d has the 0-based pixel (x, y) = ((P d)_0, (P d)_1) / (P
    d)_2.

    ``wcs`` is a two-dimensional celestial TAN WCS; CRPIX, CDELT (signs too), PC/CD, LONPOLE, the
    order of the axes and the frame are honoured (Calabretta & Greisen 2002). Raises InputError for
    other projections and for distortions.
    """
    lng = wcs.wcs.lng
    lat = wcs.wcs.lat
    kinds = [str(c) for c in wcs.wcs.ctype]
    if wcs.naxis != 2 or lng < 0 or lat < 0:
        cure = "set CTYPE1 and CTYPE2, e.g. RA---TAN and DEC--TAN"
        raise InputError(f"needs two celestial axes, has {kinds}", place="WCS", cure=cure)
    if not all(k.endswith("-TAN") for k in kinds) or wcs.has_distortion:
        raise InputError(
            f"projection {kinds} is not a plain TAN",
            place="WCS",
            cure="reproject to TAN without distortion",
        )
    wcs.wcs.set()
    return central(wcs) @ wcs_frame_rotation(wcs)


def tangent_wcs(
    frame: str,
    crval: tuple[float, float],
    crpix: tuple[float, float],
    cdelt: tuple[float, float],
) -> WCS:
    """World coordinates of a TAN image in ``icrs`` or ``galactic`` coordinates, parameters as in a
    FITS header [deg].
    """
    from astropy.wcs import WCS

    wcs = WCS(naxis=2)
    axes = ("GLON-TAN", "GLAT-TAN") if frame == "galactic" else ("RA---TAN", "DEC--TAN")
    wcs.wcs.ctype, wcs.wcs.cunit = axes, ("deg", "deg")
    wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = crval, crpix, cdelt
    if frame == "icrs":
        wcs.wcs.radesys = "ICRS"
    wcs.wcs.lonpole = 180.0
    wcs.wcs.set()
    return wcs


LOOKED_AT = 256, 37
"""Instants of a scan and detectors that `some_directions` takes, at most."""


def some_directions(quaternions: Floats, xi: Floats, eta: Floats) -> Floats:
    """`directions` (n_det, n, 3) of some detectors at some instants of a scan."""
    at, of = (
        slice(None, None, -(-n // most))
        for n, most in zip((len(quaternions), len(xi)), LOOKED_AT, strict=True)
    )
    return directions(quaternions[at], xi[of], eta[of])


def share_outside(
    scans: Iterable[tuple[Floats, Floats, Floats]],
    matrix: Floats,
    shape: tuple[int, int],
) -> float:
    """About what share of all samples lies beyond an image (ny, nx) whose `pixel_matrix` is
    ``matrix``.

    ``scans``: boresight quaternions (n, 4), ICRS, and offsets of the detectors (n_det,), (n_det,)
    of each; some of them are used.
    """
    ny, nx = shape
    beyond = looked = 0
    for quaternions, xi, eta in scans:
        x, y, depth = np.moveaxis(some_directions(quaternions, xi, eta) @ matrix.T, -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            inside = (
                (depth > 0)
                & (abs(x / depth - (nx - 1) / 2) <= nx / 2)
                & (abs(y / depth - (ny - 1) / 2) <= ny / 2)
            )
        beyond = beyond + int(np.count_nonzero(~inside))
        looked = looked + inside.size
    return beyond / looked if looked else 0.0


def central(wcs: WCS) -> Floats:
    """`pixel_matrix` for directions in the frame of ``wcs`` itself."""
    lng = wcs.wcs.lng
    lat = wcs.wcs.lat
    lon0, lat0 = np.radians([wcs.wcs.crval[lng], wcs.wcs.crval[lat]])
    centre = np.array([np.cos(lat0) * np.cos(lon0), np.cos(lat0) * np.sin(lon0), np.sin(lat0)])
    east = np.array([-np.sin(lon0), np.cos(lon0), 0.0])
    north = np.cross(centre, east)
    turn = np.radians(wcs.wcs.lonpole - 180.0)
    plane = np.empty((2, 3))
    plane[lng] = np.cos(turn) * east - np.sin(turn) * north
    plane[lat] = np.sin(turn) * east + np.cos(turn) * north
    per_unit = np.linalg.inv(np.asarray(wcs.pixel_scale_matrix, np.float64)) * np.degrees(1.0)
    pixel = per_unit @ plane + np.outer(np.asarray(wcs.wcs.crpix[:2]) - 1.0, centre)
    return np.vstack([pixel, centre])


def ray_coefficients(quaternions: Floats, matrix: Floats) -> Floats:
    """Coefficients h (9, n) float64: ``matrix`` (3, 3) times the direction of a detector, times the
    length of (xi, eta, 1), for boresight quaternions (n, 4) in ICRS.

    Its components are h0 xi + h1 eta + h2, h3 xi + h4 eta + h5, h6 xi + h7 eta + h8. A detector at
    focal-plane offsets (xi, eta) looks at R(q) (-eta, -xi, 1) (TOAST's boresight frame). With the
    `pixel_matrix` of a TAN image they are those of equation (1): pixels are 0-based, with integer
    coordinates at pixel centres; error: some 1e-13 of the distance to the image centre in pixels.
    """
    h = empty((9, len(quaternions)))
    for s in chunks(len(quaternions)):
        turn = _rotations(quaternions[s])
        for row in range(3):
            for column, (sign, axis) in enumerate(((-1, 1), (-1, 0), (1, 2))):
                a, b, c = sign * matrix[row]
                h[3 * row + column, s] = a * turn[0, axis] + b * turn[1, axis] + c * turn[2, axis]
    return h


def directions(quaternions: Floats, xi: Floats, eta: Floats) -> Floats:
    """Unit vectors (n_det, n, 3) that detectors at offsets (n_det,) look at, for boresight
    quaternions (n, 4).
    """
    rays = np.stack([-np.asarray(eta), -np.asarray(xi), np.ones(len(xi))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turned: Floats = np.einsum("nij,dj->dni", rotation_matrices(quaternions), rays)
    return turned
