"""A map: what was measured in each pixel, how often, and how well."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..notebook import html_table
from ..numerics import tangent
from ..numerics.angles import ARCMIN, FWHM_PER_SIGMA
from ..numerics.sphere import separation
from ..numerics.transforms import convolved, gaussian_taps
from ..types import Floats

if TYPE_CHECKING:
    from astropy.io.fits import Header

    from ..numerics.tangent import TangentWcs
    from ..storage.fits_image import Cards

SMALL = 1 << 20
"""Pixels of a map whose distances from the centre are kept."""


@dataclass
class MapProduct:
    """A map in the TAN projection, arrays (ny, nx), or in HEALPix, arrays (n_pixel,) for the pixels ``pixels``.

    Attributes
    ----------
    signal
        Weighted mean of the samples, `unit`; NaN where hits == 0.
    hits
        Number of samples, int64.
    weights
        Sum of the samples' weights: K^-2 (inverse variance), or a plain count (uniform).
    noise
        Standard deviation of ``signal`` (after smoothing, where it is smoothed), `unit`; NaN where unknown.
    half_difference
        Noise map from the difference of the even and odd scans,
        (m_e - m_o) sqrt(w_e w_o) / (w_e + w_o): its variance is that of ``signal`` where both have hits; NaN elsewhere.
    header
        Keywords of the WCS (TAN maps), else None; a dict that `astropy.io.fits.Header` takes.
    centre
        (lon, lat) [rad] of the map's centre in ``frame``.
    pixel
        Side of a pixel [rad]; for HEALPix the square root of its area.
    nside, nest, pixels
        HEALPix parameters and sorted pixel numbers, else 0, False, None.
    fwhm
        Main-beam FWHM of the instrument [rad]. ``smoothed_by``: FWHM of the Gaussian applied to the map, 0 for none.
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

    @property
    def wcs(self) -> Any:
        """The `astropy.wcs.WCS` of a TAN map."""
        from astropy.wcs import WCS

        if self.header is None:
            raise InputError("a HEALPix map has no WCS", place="map", cure="use nside, pixels and healpy")
        return WCS(self.header)

    def distance(self) -> Floats:
        """Angle [rad] of every pixel from the centre, shape of ``signal``."""
        if self.header is not None:
            find = _tangent_distance if self.signal.size <= SMALL else _tangent_distance.__wrapped__
            world = tangent.plain(self.header) or self.header.tostring()
            return find(world, self.signal.shape, self.centre)
        import healpy

        colatitude, phi = healpy.pix2ang(self.nside, self.pixels, nest=self.nest)
        return separation(phi, np.pi / 2 - colatitude, self.centre)

    def seconds_per_beam(self) -> Floats | float | None:
        """What one sample in a pixel adds to the integration time of all detectors per beam [s]: times ``hits``, that time.

            1 / sample rate x beam area / pixel area,   pi FWHM^2 / (4 ln 2) / pixel^2 (cos^-3 of the distance, TAN)

        The beam is the telescope's, not what smoothing made of it. One number where pixels are equal to 0.1 %, else an array,
        shape of ``signal``; None where the rate or the beam is not known.
        """
        if not (self.sample_rate > 0 and self.fwhm > 0):
            return None
        per_pixel = math.pi / math.log(16) * (self.fwhm / self.pixel) ** 2 / self.sample_rate
        if self.header is None:
            return per_pixel
        larger = np.cos(self.distance()) ** -3
        return per_pixel if larger.max() < 1.001 else per_pixel * larger

    def rms(self, radius: float = 0.5 * ARCMIN, of: Literal["signal", "half_difference"] = "signal") -> float:
        """Weighted root mean square, sqrt(sum w m^2 / sum w), within ``radius`` [rad] of the centre (the central arcmin).

        NaN where no pixel there has a value.
        """
        values = getattr(self, of)
        if values is None:
            raise InputError("the map has no half-difference", place="map", cure="set half_difference and make two scans")
        return _rms(values, self.weights, self.distance() <= radius)

    def smoothed_rms(
        self, fwhm: float, radius: float = 0.5 * ARCMIN, of: Literal["signal", "half_difference"] = "signal"
    ) -> float:
        """``smoothed(fwhm).rms(radius, of)``; of a TAN map, only what the circle sees is smoothed."""
        if self.header is None or getattr(self, of) is None:
            return self.smoothed(fwhm).rms(radius, of)
        near = self.distance() <= radius
        reach = math.ceil(5 * fwhm / FWHM_PER_SIGMA / self.pixel)
        window = tuple(_around(np.flatnonzero(near.any(axis=axis)), reach) for axis in (1, 0))
        names = ("signal", "hits", "weights", "noise", "half_difference")
        planes: dict[str, Any] = {n: None if getattr(self, n) is None else getattr(self, n)[window] for n in names}
        cut = replace(self, **planes)
        return _rms(getattr(cut.smoothed(fwhm), of), cut.weights, near[window])

    def smoothed(self, fwhm: float) -> MapProduct:
        """The map convolved with a Gaussian of ``fwhm`` [rad], weighted: sum_q K w m / sum_q K w over pixels with hits.

        Empty pixels neither contribute nor are filled. Noise: pixels are independent before, so its variance becomes
        sum K^2 w^2 n^2 / (sum K w)^2. Hits and weights stay those of the pixel itself.
        """
        convolve = self._convolver(fwhm)
        known = self.hits > 0
        weights = np.where(known, self.weights, 0.0)
        total = convolve(weights, 1.0)

        def mean(values: Floats, use: NDArray[np.bool_]) -> Floats:
            w = np.where(use, weights, 0.0)
            below = total if use is known else convolve(w, 1.0)
            with np.errstate(invalid="ignore", divide="ignore"):
                return np.where(use, convolve(w * np.where(use, values, 0.0), 1.0) / below, np.nan)

        quiet = known & np.isfinite(self.noise)
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = convolve((weights * np.where(quiet, self.noise, 0.0)) ** 2, 2.0) / total**2
        with np.errstate(invalid="ignore"):  # where the transform's rounding is all there is, the noise is not known
            noise = np.where(quiet & (variance >= 0), np.sqrt(variance), np.nan)
        half = self.half_difference
        if half is not None:
            half = mean(half, np.isfinite(half))
        return replace(
            self,
            signal=mean(self.signal, known),
            noise=noise,
            half_difference=half,
            smoothed_by=math.hypot(self.smoothed_by, fwhm),
        )

    def _convolver(self, fwhm: float) -> Any:
        """f(values, power): values convolved with the power-th power of the Gaussian kernel, whose sum is 1."""
        sigma = fwhm / FWHM_PER_SIGMA / self.pixel
        if self.header is not None:
            taps = gaussian_taps(sigma)
            return lambda values, power: convolved(values, taps**power)

        def sphere(values: Floats, power: float) -> Floats:
            import healpy

            whole = np.zeros(healpy.nside2npix(self.nside))
            whole[self.pixels] = values
            if self.nest:
                whole = healpy.reorder(whole, n2r=True)
            whole = healpy.smoothing(whole, fwhm=fwhm / math.sqrt(power), iter=3)
            if self.nest:
                whole = healpy.reorder(whole, r2n=True)
            kept: Floats = whole[self.pixels] * (4 * math.pi * sigma**2) ** (1 - power)
            return kept

        return sphere

    @property
    def healpix_full(self) -> Floats:
        """The whole-sphere signal (12 nside^2,), healpy's UNSEEN where there is none (HEALPix maps)."""
        import healpy

        if self.pixels is None:
            raise InputError("not a HEALPix map", place="map", cure="set nside of the map maker")
        whole = np.full(healpy.nside2npix(self.nside), healpy.UNSEEN)
        known = self.hits > 0
        whole[self.pixels[known]] = self.signal[known]
        return whole

    def __repr__(self) -> str:
        size = (
            f"nside {self.nside}, {len(self.hits)} pixels"
            if self.header is None
            else f"{self.hits.shape[1]} x {self.hits.shape[0]}"
        )
        return f"<MapProduct {size}, {int(self.hits.sum())} samples of {len(self.scans)} scans, {self.unit}>"

    def _repr_html_(self) -> str:
        hit = self.hits > 0
        rows: list[tuple[Any, Any]] = [
            ("size", repr(self)),
            ("pixel", f"{math.degrees(self.pixel) * 3600:.3g} arcsec"),
            ("pixels hit", int(hit.sum())),
            ("smoothed by", f"{math.degrees(self.smoothed_by) * 3600:.3g} arcsec" if self.smoothed_by else "nothing"),
            ("resolution (FWHM)", f"{math.degrees(math.hypot(self.fwhm, self.smoothed_by)) * 3600:.3g} arcsec"),
            ("rms in the central arcmin", f"{self.rms():.3g} {self.unit}"),
        ]
        if self.half_difference is not None:
            rows.append(("half-difference rms there", f"{self.rms(of='half_difference'):.3g} {self.unit}"))
        return html_table("Map", rows)


def _rms(values: Floats, weights: Floats, where: NDArray[np.bool_]) -> float:
    use = where & np.isfinite(values)
    w = weights[use]
    return float(np.sqrt((w * values[use] ** 2).sum() / w.sum())) if use.any() and w.sum() > 0 else math.nan


def _around(places: NDArray[np.int64], reach: int) -> slice:
    """From ``reach`` before the first to ``reach`` behind the last."""
    return slice(max(0, int(places[0]) - reach), int(places[-1]) + reach + 1) if places.size else slice(0)


@lru_cache(maxsize=1)  # the maps of all signals share it
def _tangent_distance(world: TangentWcs | str, shape: tuple[int, int], centre: tuple[float, float]) -> Floats:
    """``world``: what the header says, or the header itself."""
    wcs: Any = world
    if isinstance(world, str):
        from astropy.wcs import WCS

        wcs = WCS(world)
    y, x = np.indices(shape)
    phi, theta = np.radians(np.array(wcs.wcs_pix2world(x.ravel(), y.ravel(), 0))).reshape(2, *shape)
    found = separation(phi, theta, centre)
    found.flags.writeable = False
    return found
