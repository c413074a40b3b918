"""The arrays of a map, where its pixels are on the sky, and HEALPix and CAR maps on a plane."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ..configuration.diagnostics import nearest
from ..errors import InputError
from ..numerics.sphere import separation, unit_vectors
from ..types import AnyFloats, Bools, Floats, Integers
from .grid import HealpixPixels, ImagePixels, image_grid
from .planes import IQU, KNOWN, Plane, Polarization, Rows

if TYPE_CHECKING:
    from astropy.io.fits import Header

    from ..instrument import Band
    from .planes import ScanHits


def on_plane(
    product: MapArrays,
    planes: Mapping[str, AnyFloats],
    size: int = 400,
) -> tuple[dict[str, AnyFloats], Any]:
    """``planes`` of a TAN map and its astropy WCS; of others on a grid of at most ``size`` x
    ``size`` points of a plane about its centre.

    The plane is the tangent plane, or for maps of more than 60 deg the equal-area one (ZEA); the
    grid reaches as far as the pixels with hits (of a HEALPix map, its pixels). Each point takes the
    value of the pixel it lies in; elsewhere counts (integers) are 0, other planes NaN.
    """
    if product.projection == "TAN":
        return dict(planes), product.wcs
    wcs, (nx, ny) = _plane(product, size)
    x, y = np.meshgrid(np.arange(nx), np.arange(ny))
    world = wcs.pixel_to_world_values(x, y)
    known = np.isfinite(world[0]) & np.isfinite(world[1])
    lon, lat = np.where(known, world, 0.0)
    place = product.grid.pixels_at(unit_vectors(np.radians(lon), np.radians(lat)))
    there = known & (place >= 0)
    found = {}
    for name, values in planes.items():
        flat = values.ravel() if values.size else np.zeros(1, values.dtype)
        found[name] = np.where(there, flat[place], 0 if flat.dtype.kind in "iu" else np.nan)
    return found, wcs


def _positions(product: MapArrays) -> Floats:
    """(2, n) longitudes and latitudes [deg] of the pixels of a list; of an image those with hits,
    all where none has.
    """
    if product.pixels is not None:
        import healpy as hp

        return np.array(hp.pix2ang(product.nside, product.pixels, nest=product.nest, lonlat=True))
    y, x = np.nonzero(product.hits if product.hits.any() else np.ones(product.hits.shape))
    return np.array(product.wcs.wcs_pix2world(x, y, 0))


def _plane(product: MapArrays, size: int) -> tuple[Any, tuple[int, int]]:
    """A WCS about the centre, and the numbers (nx, ny) of points that take in every pixel."""
    from astropy.wcs import WCS

    longitudes, latitudes = _positions(product)
    lon, lat = np.degrees(product.centre)
    apart = separation(np.radians(longitudes), np.radians(latitudes), product.centre)
    far = float(apart.max(initial=0.0)) > math.acos(0.86)
    wcs = WCS(naxis=2)
    axes = ("RA", "DEC") if product.frame == "icrs" else ("GLON", "GLAT")
    wcs.wcs.ctype = [f"{a}{'-' * (8 - len(a) - 3)}{'ZEA' if far else 'TAN'}" for a in axes]
    wcs.wcs.crval = [float(lon), float(lat)]
    wcs.wcs.crpix = [1.0, 1.0]
    wcs.wcs.cdelt = [-1.0, 1.0]
    x, y = wcs.wcs_world2pix(longitudes, latitudes, 0)
    spare = math.degrees(product.pixel)
    places = np.stack([x, y]) if x.size else np.zeros((2, 1))
    low = places.min(axis=1) - spare
    high = places.max(axis=1) + spare
    step = float((high - low).max()) / size
    numbers = np.maximum(1, np.ceil((high - low) / step - 1e-9)).astype(int)
    wcs.wcs.cdelt = [-step, step]
    wcs.wcs.crpix = (1 - (low + high) / 2 / step + (numbers - 1) / 2).tolist()
    return wcs, (int(numbers[0]), int(numbers[1]))


NOISE_MODELS = {"net": "simulated", "streams": "estimated", "table": "table"}
"""FITS values of NOISEMOD, the noise model of a maximum-likelihood map, by `noise_from`."""


@dataclass(init=False)
class MapArrays:
    """A map in the TAN or CAR projection, arrays (ny, nx), or in HEALPix, arrays (n_pixel,) for the
    pixels ``pixels``.

    Attributes
    ----------
    planes
        What each pixel holds, by name (`core.maps.planes`); each has rows of the shape of the map.
    signal
        Weighted mean of the samples, `unit`; NaN where there is no value (`known`). Of a polarized
        map I, as of the following.
    hits
        Number of samples, int64.
    weights
        Sum of the samples' weights: K^-2 (inverse variance), or a plain count (uniform). 0 where I,
        Q and U are wanted and not determined.
    noise
        Standard deviation of ``signal`` (after smoothing, where it is smoothed), `unit`; NaN where
        unknown.
    half_difference
        Noise map from the difference of two halves of the samples (``difference``: which, ``even -
        odd scans``), (m_1 - m_2) sqrt(w_1 w_2) / (w_1 + w_2): its variance is that of ``signal``
        where both have a value; NaN elsewhere. None: not made.
    crosslinking
        How one-sided the scan directions in each pixel are: 0 where they cross evenly, 1 where all
        are along one line; NaN where no detector moved. None: not kept (`BinMap: {crosslinking:
        true}`).
    directions
        (2, ...) mean cosine and sine of twice the angle, from east to north, in which detectors
        moved through each pixel; NaN where none did. None: not kept.
    header
        Keywords of the WCS (images), else None.
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
    noise_from
        Origin of the white noise: ``net``, or ``scatter`` of samples; of a maximum-likelihood map
        also ``streams`` or ``table``.
    contents
        ``hits``: nothing else was made, ``signal`` and ``noise`` are NaN.
    scan_hits
        Hits of each scan (`BinMap: {scan_hits: true}`); None: not kept.
    band
        Band of the run, with which `to` converts units; None: not known.
    origin
        `map_file.Provenance`, what files state of the run that made it; None: of no run.
    spectral_index
        That of the flux density with which the map was converted to its `unit`; None: it was not.
    square
        Pixels of an image are as wide as high.
    taken_off
        What a map maker took off I, since the data hardly determine it: ``mean``, ``plane``; empty:
        nothing.
    chi2
        Of samples minus map, per degree of freedom, in the noise model of a maximum-likelihood map,
        and its standard error where that is right; zeros: not known.
    beams
        FWHM [rad] of the narrowest and the widest beam in the map; zeros: not known.
    """

    planes: dict[str, Plane]
    header: Header | None = None
    centre: tuple[float, float] = (0.0, 0.0)
    pixel: float = 0.0
    frame: str = "icrs"
    unit: str = "K_RJ"
    weighting: Literal["uniform", "inverse_variance"] = "uniform"
    noise_from: Literal["net", "scatter", "streams", "table"] = "net"
    nside: int = 0
    nest: bool = False
    pixels: Integers | None = None
    fwhm: float = 0.0
    smoothed_by: float = 0.0
    scans: Sequence[str] = ()
    sample_rate: float = 0.0
    contents: Literal["all", "hits"] = "all"
    difference: str = "even - odd scans"
    scan_hits: ScanHits | None = None
    band: Band | None = None
    beams: tuple[float, float] = (0.0, 0.0)
    square: bool = True
    taken_off: str = ""
    chi2: tuple[float, float] = (0.0, 0.0)
    origin: Any = None
    spectral_index: float | None = None

    signal = Rows[Floats]("signal")
    hits = Rows[Integers]("hits")
    weights = Rows[Floats]("weights")
    noise = Rows[Floats]("noise")
    half_difference = Rows["Floats | None"]("half_difference")
    crosslinking = Rows["Floats | None"]("crosslinking")
    directions = Rows["Floats | None"]("directions", slice(None))

    def __init__(
        self,
        signal: Any = ...,
        hits: Any = ...,
        weights: Any = ...,
        noise: Any = ...,
        half_difference: Any = ...,
        header: Any = None,
        centre: tuple[float, float] = (0.0, 0.0),
        pixel: float = 0.0,
        frame: str = "icrs",
        **more: Any,
    ) -> None:
        """A map of planes; further attributes and planes by name.

        Planes are arrays of the shape of the map, or one such row for each of I, Q and U; None: the
        map has no such plane. They take the place of those among ``planes``.
        """
        self.planes = dict(more.pop("planes", {}))
        self.header = header
        self.centre = centre
        self.pixel = pixel
        self.frame = frame
        planes = {"hits": hits, "signal": signal, "weights": weights, "noise": noise}
        planes["half_difference"] = half_difference
        for name, value in more.items():
            if name in KNOWN:
                planes[name] = value
            elif name in self.__dataclass_fields__:
                setattr(self, name, value)
            else:
                raise TypeError(f"a map has no attribute {name!r}")
        for name, value in planes.items():
            if value is not ...:
                self.hold(name, value)
        self.planes = {n: self.planes[n] for n in (*KNOWN, *self.planes) if n in self.planes}

    def hold(self, name: str, values: Any) -> None:
        """Set a plane of `planes.KNOWN`: arrays as of the constructor; of a polarized map
        also those of I alone.
        """
        if values is None:
            self.planes.pop(name, None)
            return
        values = np.asarray(values)
        shape = values.shape if name == "hits" else self.hits.shape
        if values.shape == shape and len(before := self._rows(name)) > 1:
            values = np.concatenate([values[None], before[1:]])
        values = values if values.ndim > len(shape) else values[None]
        plane = replace(KNOWN[name], values=values)
        if name == "weights" and self.weighting == "inverse_variance":
            plane = replace(plane, scale=-2)
        if self.contents == "hits" and name != "hits":
            plane = replace(plane, names={})  # is in no file
        self.planes[name] = plane

    def with_planes(self, **planes: Any) -> Self:
        """The map with other planes, as `hold` takes them."""
        made = replace(self)
        for name, values in planes.items():
            made.hold(name, values)
        return made

    def _rows(self, name: str) -> Any:
        """(n, *shape) rows of a plane; none without it."""
        return self.planes[name].values if name in self.planes else ()

    def plane(self, name: str) -> Plane:
        """The plane ``name`` (of a polarized map that of I), or one of its rows by the name that
        files have. InputError for one that the map has not.
        """
        found = {
            row: replace(plane, values=values[None])
            for plane in self.planes.values()
            for row, _, values in plane.rows
        } | {key: plane.row(0) for key, plane in self.planes.items()}
        if name not in found:
            cure = nearest(name, found) or f"choose from: {', '.join(found)}"
            raise InputError(f"the map has no plane {name!r}", place="map", cure=cure)
        return found[name]

    @property
    def polarization(self) -> Polarization | None:
        """Q and U, and what belongs to them; None of a map of I alone."""
        return None if len(self._rows("signal")) == 1 else Polarization(self.planes)

    def stokes(self, which: str) -> Self:
        """I, Q or U of a polarized map as a map of its own, or P = sqrt(Q^2 + U^2) (which noise
        makes larger on the average).

        Its weights are 1 over the diagonal of A^-1. Raises InputError for a map without Q and U,
        and for other names.
        """
        found = self.polarization
        if found is None:
            raise InputError(
                "the map has no Q and U",
                place="map.stokes",
                cure="set stokes: IQU of the map maker",
            )
        if which not in (*IQU, "P"):
            raise InputError(
                f"{which!r} is none of I, Q, U and P",
                place="map.stokes",
                cure="write map.stokes('Q')",
            )
        k = max("IQU".find(which), 0)
        planes = {
            name: plane if plane.stokes is None else plane.row(k)
            for name, plane in self.planes.items()
            if not plane.joint
        }
        taken = self.taken_off if which == "I" else ""
        plain = replace(self, planes=planes, taken_off=taken)
        if which != "P":
            return plain
        p = np.hypot(found.q, found.u)
        qq, qu, uu = found.covariance[3:]
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = (found.q**2 * qq + 2 * found.q * found.u * qu + found.u**2 * uu) / p**2
        return plain.with_planes(
            signal=p,
            noise=np.sqrt(variance),
            weights=found.weights.mean(axis=0),
            half_difference=None,
        )

    def by_stokes(self) -> dict[str, Self]:
        """I, or I, Q and U as maps of their own."""
        if self.polarization is None:
            return {"I": self}
        return {which: self.stokes(which) for which in IQU}

    @property
    def wcs(self) -> Any:
        """The `astropy.wcs.WCS` of an image."""
        from astropy.wcs import WCS

        if self.header is None:
            raise InputError(
                "a HEALPix map has no WCS",
                place="map",
                cure="use nside, pixels and healpy",
            )
        return WCS(self.header)

    @property
    def known(self) -> Bools:
        """Pixels in which the map has a value: those with samples and, of a polarized map, enough
        of their angles.
        """
        hit = self.hits > 0
        return hit if self.contents == "hits" else hit & np.isfinite(self.signal)

    @property
    def known_hits(self) -> Integers:
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
    def projection(self) -> str:
        """Projection of the pixels: TAN, CAR, HEALPix; of files from elsewhere any of FITS."""
        return "HEALPix" if self.header is None else str(self.header["CTYPE1"])[-3:]

    @property
    def grid(self) -> ImagePixels | HealpixPixels:
        """Positions and sizes of the pixels on the sky."""
        if self.header is not None:
            side = self.pixel if self.square else None
            return image_grid(self.header, self.signal.shape, side)
        assert self.pixels is not None  # of HEALPix
        return HealpixPixels(self.nside, self.nest, self.pixels, self.frame)

    @property
    def sides(self) -> tuple[float, float]:
        """Steps (y, x) from pixel to pixel on the sky [rad], in the middle of the map."""
        plain = self.square and self.projection != "CAR"
        return (self.pixel, self.pixel) if plain else self.grid.sides

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
        """Integration time of all detectors per beam [s] for each sample in a pixel: times
        ``hits``, that time.

            1 / sample rate x beam area / pixel area,   beam area = pi FWHM^2 / (4 ln 2)

        The beam is the telescope's, not what smoothing made of it. One number where pixels are
        equal to 0.1 %, else an array, shape of ``signal``; None where the rate or the beam is not
        known.
        """
        if not (self.sample_rate > 0 and self.fwhm > 0):
            return None
        beam = math.pi / math.log(16) * self.fwhm**2 / self.sample_rate
        areas = np.asarray(self.areas())
        if areas.max() < 1.001 * areas.min():
            return beam / (float(areas.mean()) if self.projection == "CAR" else self.pixel**2)
        return np.broadcast_to(beam / areas, self.signal.shape)
