"""A source mask in a FITS image: pixels that are not zero are masked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from astropy.wcs import WCS
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.maps.header import with_known_frame
from zonda.core.numerics.projection import pixel_matrix, ray_coefficients
from zonda.core.observation import Observation
from zonda.core.storage.files import reading
from zonda.core.storage.fits_files import check_size, opened
from zonda.core.types import Floats

CURE = "give a two-dimensional image with a celestial WCS, 0 where there is no source"


@dataclass(frozen=True)
class MaskImage:
    """``masked`` (ny, nx); ``matrix`` (3, 3) from directions on the sky to its pixels
    (`projection.pixel_matrix`).
    """

    masked: NDArray[np.bool_]
    matrix: Floats

    def of(self, observation: Observation) -> InsideImage:
        """Samples of a scan that are inside."""
        h = np.ascontiguousarray(ray_coefficients(observation.boresight_radec, self.matrix).T)
        return InsideImage(h, observation.focalplane.xi, observation.focalplane.eta, self.masked)


@dataclass(frozen=True)
class InsideImage:
    """Samples in masked pixels; none beyond the image.

    Attributes
    ----------
    h
        (9, n_samp): coefficients of equation (1) of `core.numerics.projection`.
    xi, eta
        (n_det,): offsets of the detectors, rad.
    """

    h: Floats
    xi: Floats
    eta: Floats
    masked: NDArray[np.bool_]

    @property
    def n_detectors(self) -> int:
        """Number of the scan's detectors."""
        return len(self.xi)

    def at(self, detectors: slice, samples: slice) -> NDArray[np.bool_]:
        """(n_det, n): True inside; it depends on absolute detectors and samples alone."""
        xi, eta, h = self.xi[detectors, None], self.eta[detectors, None], self.h[:, samples]
        x, y, w = (h[k] * xi + h[k + 1] * eta + h[k + 2] for k in (0, 3, 6))
        ny, nx = self.masked.shape
        with np.errstate(invalid="ignore", divide="ignore"):
            column, row = np.floor(x / w + 0.5), np.floor(y / w + 0.5)
            here = (w > 0) & (column >= 0) & (column < nx) & (row >= 0) & (row < ny)
        found = np.zeros(here.shape, bool)
        found[here] = self.masked[row[here].astype(np.int64), column[here].astype(np.int64)]
        return found


def read_mask(path: Path) -> MaskImage:
    """The first image of a FITS file.

    Raises InputError for what is no image with a tangent-plane (TAN) WCS, for NaN, which is neither
    masked nor not, and for zeros alone.
    """
    return _read(path, path.stat().st_mtime_ns)


@lru_cache(4)
def _read(path: Path, changed: int) -> MaskImage:
    place = f"source mask {path}"
    with opened(path, place, CURE) as hdus:
        hdu = next((h for h in hdus if h.is_image and len(h.shape) == 2), None)
        if hdu is None:
            raise InputError("has no two-dimensional image", place=place, cure=CURE)
        check_size(hdu, place)
        values, header = np.array(hdu.data), hdu.header.copy()
    if np.isnan(values).any():
        raise InputError(
            "has pixels that are NaN",
            place=place,
            cure="write 1 where samples are masked and 0 elsewhere",
        )
    if not values.any():
        raise InputError(
            "all of its pixels are 0: it masks nothing",
            place=place,
            cure="write 1 where samples are masked, or leave it out",
        )
    header, _ = with_known_frame(header, place)
    try:
        with reading(place, "a FITS image with world coordinates", CURE):
            wcs = WCS(header, naxis=2)
        return MaskImage(values != 0, pixel_matrix(wcs))
    except InputError as err:
        raise InputError(err.message, place=place, cure=err.cure or CURE) from None
