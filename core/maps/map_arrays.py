"""The arrays of a map, and where its pixels are on the sky."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..types import Floats
from .grid import HealpixPixels, ImagePixels, healpix_grid, image_grid

if TYPE_CHECKING:
    from astropy.io.fits import Header

    from ..instrument import Band
    from ..storage.fits_image import Cards
    from .polarized import Polarization
    from .scan_hits import ScanHits


@dataclass
class MapArrays:
    """A map in the TAN or CAR projection, arrays (ny, nx), or in HEALPix, arrays (n_pixel,) for the
    pixels ``pixels``.

    Attributes
    ----------
    signal
        Weighted mean of the samples, `unit`; NaN where there is no value (`known`).
    hits
        Number of samples, int64.
    weights
        Sum of the samples' weights: K^-2 (inverse variance), or a plain count (uniform).
    noise
        Standard deviation of ``signal`` (after smoothing, where it is smoothed), `unit`; NaN where
        unknown.
    half_difference
        Noise map from the difference of two halves of the samples (``difference``: which, ``even -
        odd scans``), (m_1 - m_2) sqrt(w_1 w_2) / (w_1 + w_2): its variance is that of ``signal``
        where both have a value; NaN elsewhere.
    header
        Keywords of the WCS (images), else None; a dict that `astropy.io.fits.Header` takes.
    centre
        (lon, lat) [rad] of the map's centre in ``frame``.
    pixel
        Nominal side of a pixel [rad]: of TAN at the tangent point, of CAR in latitude (and in
        longitude on the equator); for HEALPix the square root of its area. What a pixel covers on
        the sky is in `grid`.
    nside, nest, pixels
        HEALPix parameters and sorted pixel numbers, else 0, False, None.
    fwhm
        FWHM of the beam [rad]; of detectors with several beams that of the map, `core.maps.beams`;
        0: not known. ``smoothed_by``: FWHM of the Gaussian applied to the map, 0 for none.
    scans
        Names of the observations in it.
    sample_rate
        Of all scans [Hz]; 0 where it is unknown or they differ.
    """

    signal: Floats
    hits: NDArray[np.int64]
    weights: Floats
    noise: Floats
    half_difference: Floats | None
    header: Cards | Header | None
    centre: tuple[float, float]
    pixel: float
    frame: str = "icrs"
    unit: str = "K_RJ"
    weighting: Literal["uniform", "inverse_variance"] = "uniform"
    noise_from: Literal["net", "scatter"] = "net"
    nside: int = 0
    nest: bool = False
    pixels: NDArray[np.int64] | None = None
    fwhm: float = 0.0
    smoothed_by: float = 0.0
    scans: list[str] = field(default_factory=list)
    sample_rate: float = 0.0
    contents: Literal["all", "hits"] = "all"
    """``hits``: nothing else was made, ``signal`` and ``noise`` are NaN."""
    difference: str = "even - odd scans"
    polarization: Polarization | None = None
    """Q and U; ``signal`` and the others are of I then, and ``weights`` 0 where I, Q and U are not
    determined.
    """
    directions: Floats | None = None
    """(2, ...) mean cosine and sine of twice the angle, from east to north, in which detectors
    moved through each pixel; NaN where none did. None: not kept (`BinMap: {crosslinking:
    true}`)."""
    scan_hits: ScanHits | None = None
    """Hits of each scan (`BinMap: {scan_hits: true}`)."""
    band: Band | None = None
    """Band of the run, with which `to` converts units; None: not known."""
    beams: tuple[float, float] = (0.0, 0.0)
    """FWHM [rad] of the narrowest and the widest beam in the map; zeros: not known."""

    @property
    def wcs(self) -> Any:
        """The `astropy.wcs.WCS` of an image."""
        from astropy.wcs import WCS

        if self.header is None:
            raise InputError(
                "a HEALPix map has no WCS", place="map", cure="use nside, pixels and healpy"
            )
        return WCS(self.header)

    @property
    def crosslinking(self) -> Floats | None:
        """How one-sided the scan directions in each pixel are: 0 where they cross evenly, 1 where
        all are along one line.

        The modulus of the mean of exp(2 i psi), psi the direction of motion, as of ACT's maps
        (Aiola et al. 2020, `xlink`) and TOAST's `CrossLinking`. NaN where no detector moved; None
        where it was not kept.
        """
        return None if self.directions is None else np.hypot(*self.directions)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where the map has a value: where there are samples and, of a polarized map, enough of
        their angles.
        """
        hit = self.hits > 0
        return hit if self.contents == "hits" else hit & np.isfinite(self.signal)

    @property
    def known_hits(self) -> NDArray[np.int64]:
        """``hits`` where the map has a value, else 0."""
        return np.where(self.known, self.hits, 0)

    def hits_of(self, scan: str | int) -> NDArray[np.int32]:
        """Hits of one scan, by name or number, shape of ``signal``. Raises InputError where they
        were not kept.
        """
        if self.scan_hits is None:
            raise InputError(
                "the hits of each scan were not kept",
                place="map",
                cure="set scan_hits: true of the map maker",
            )
        return self.scan_hits.plane(scan, self.signal.shape)

    @property
    def projection(self) -> Literal["TAN", "CAR", "HEALPix"]:
        """Of its pixels."""
        if self.header is None:
            return "HEALPix"
        return "CAR" if str(self.header["CTYPE1"]).endswith("-CAR") else "TAN"

    @property
    def grid(self) -> ImagePixels | HealpixPixels:
        """Where its pixels are on the sky, and how large: `core.maps.grid`."""
        if self.header is not None:
            return image_grid(self.header, (self.signal.shape[0], self.signal.shape[1]), self.pixel)
        assert self.pixels is not None  # of HEALPix
        return healpix_grid(self.nside, self.nest, self.pixels, self.frame)

    @property
    def latitudes(self) -> Floats:
        """(ny,) latitudes of the rows of a CAR map [rad]."""
        return image_grid(
            self.header, (self.signal.shape[0], self.signal.shape[1]), self.pixel
        ).latitudes

    @property
    def sides(self) -> tuple[float, float]:
        """Steps (y, x) from pixel to pixel on the sky [rad], in the middle of the map."""
        return self.grid.sides if self.projection == "CAR" else (self.pixel, self.pixel)

    def areas(self) -> Floats | float:
        """Solid angles of the pixels [sr]: one number (HEALPix), of rows (ny, 1) (CAR), or of all
        pixels (TAN).

        TAN: side^2 cos^3(distance from the tangent point),   CAR: 2 side sin(side / 2)
        cos(latitude)
        """
        return self.pixel**2 if self.header is None else self.grid.areas

    @property
    def resolution(self) -> float:
        """FWHM [rad] of the beam and of what smoothed the map."""
        return math.hypot(self.fwhm, self.smoothed_by)

    def distance(self) -> Floats:
        """Angle [rad] of every pixel from the centre, shape of ``signal``."""
        return self.grid.distance(self.centre)

    def seconds_per_beam(self) -> Floats | float | None:
        """What one sample in a pixel adds to the integration time of all detectors per beam [s]:
        times ``hits``, that time.

            1 / sample rate x beam area / pixel area,   beam area = pi FWHM^2 / (4 ln 2)

        The beam is the telescope's, not what smoothing made of it. One number where pixels are
        equal to 0.1 %, else an array, shape of ``signal``; None where the rate or the beam is not
        known.
        """
        if not (self.sample_rate > 0 and self.fwhm > 0):
            return None
        beam, areas = (
            math.pi / math.log(16) * self.fwhm**2 / self.sample_rate,
            np.asarray(self.areas()),
        )
        if areas.max() < 1.001 * areas.min():
            return beam / (float(areas.mean()) if self.projection == "CAR" else self.pixel**2)
        return np.asarray(np.broadcast_to(beam / areas, self.signal.shape), np.float64)
