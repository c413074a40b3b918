"""A map: what was measured in each pixel, how often, and how well."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..numerics.sphere import FWHM_PER_SIGMA, angle_text, sides_text
from ..tables import html_table
from ..types import Bools, Floats, Integers
from .map_arrays import MapArrays
from .planes import Plane, central_diameter
from .smoothing import CUT, error_of_mean, smoother, weighted_mean

if TYPE_CHECKING:
    from pathlib import Path

    from .apertures import ApertureFlux


@dataclass(init=False, repr=False)
class MapProduct(MapArrays):
    """`MapArrays`, and what is done with them."""

    def to(self, unit: str, *, spectral_index: float | None = None) -> MapProduct:
        """The map in another unit: K_RJ, K_CMB, Jy/beam, Jy/pixel, MJy/sr or y, with a prefix
        (``uK_CMB``, ``mJy/beam``).

        ``uK`` alone is on the map's own temperature scale. Equation (1) of
        `core.numerics.radiation` averages over the band of the run; ``spectral_index`` is that of
        the flux density within the band (None: that of the map's own unit, else 0), and values are
        those at the band's centre. A beam is a Gaussian of `resolution`. Weights that are an
        inverse variance are divided by the square of the factor. Raises InputError for a unit that
        is not known, and where the map has no band or beam.
        """
        from .units import converted

        return converted(self, unit, spectral_index)

    def smooth(self, fwhm: Any = None) -> MapProduct:
        """`smoothed` with a Gaussian of ``fwhm``: ``"9 arcsec"``, an astropy quantity; None: the
        telescope's beam.
        """
        from .units import smoothing_width

        return self.smoothed(smoothing_width(fwhm, self.fwhm))

    def plot(
        self,
        ax: Any = None,
        *,
        plane: str = "signal",
        title: str = "",
        limit: float | None = None,
        colours: str | None = None,
        limits: tuple[float, float] | None = None,
        stretch: str = "linear",
        scale_bar: Any = None,
    ) -> Any:
        """Draw a plane; the matplotlib Axes.

        Planes are those of the map (``signal``, ``hits``, ``noise`` ...), their rows as files
        name them, and of a polarized map ``Q``, ``U``, ``P``. Raises InputError for a plane that
        the map has not.

        Parameters
        ----------
        ax
            Axes to draw into; default: a new figure. Plain ones are replaced by axes with sky
            coordinates, which are returned.
        limit
            Where the colours end, in the map's unit; default: what 99.95 % of the pixels stay
            below.
        colours, limits, stretch
            matplotlib's colour map; the lower and the upper end of the colours, in the map's unit;
            ``linear``, ``sqrt``, ``asinh`` or ``log``. Default: sequential colours for a source,
            diverging ones for both signs.
        scale_bar
            Length of a bar on the sky: ``"1 arcmin"``, an astropy quantity.
        """
        from .map_plots import Look, draw_map
        from .units import angle_of

        call = "map.plot(scale_bar='1 arcmin')"
        bar = 0.0 if scale_bar is None else angle_of(scale_bar, call)
        return draw_map(self, ax, plane, title, limit, Look(colours, limits, stretch, bar))

    def write(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write it as `SaveMap` does (FITS image, or HEALPix table), without the tables of the
        run's YAML, plan and log; the path. NOISEFAC is measured in the half-difference.

        Raises `OutputError` where the file is there already (unless ``overwrite``), or cannot be
        written.
        """
        from .map_file import write_map

        return write_map(self, path, overwrite)

    def aperture_flux(
        self,
        radius: Any,
        *,
        centre: Any = None,
        annulus: Any = None,
        spectral_index: float | None = None,
    ) -> ApertureFlux:
        """Flux density [Jy] within ``radius`` of ``centre`` (default: the map's), of I: `flux`, and
        `error` from the noise and the half-difference of the map (`core.maps.apertures`).

        ``annulus``: (inner, outer) radii of the ring whose mean is taken off. Angles are texts
        with units or quantities, ``spectral_index`` is as of `to`. What filters and the beam have
        taken is not in it. Raises InputError where the map has no value there, or no Jy.
        """
        from .apertures import aperture_flux

        return aperture_flux(self, radius, centre, annulus, spectral_index)

    @property
    def central_radius(self) -> float:
        """Radius of the circle in which `rms` is taken, rad: `central_diameter`."""
        return central_diameter(self.fwhm, self.pixel) / 2

    def rms(self, radius: float | None = None, of: str = "signal") -> float:
        """Weighted root mean square, sqrt(sum w m^2 / sum w), of the plane ``of`` within ``radius``
        [rad] of the centre (`central_radius`).

        NaN where no pixel there has a value.
        """
        if of == "half_difference" and self.half_difference is None:
            raise InputError(
                "the map has no half-difference",
                place="map",
                cure="set half_difference and make two scans",
            )
        return _rms(
            self.plane(of).values[0],
            self.weights,
            self.distance() <= (self.central_radius if radius is None else radius),
        )

    def smoothed_rms(
        self,
        fwhm: float,
        radius: float | None = None,
        of: str = "signal",
    ) -> float:
        """``smoothed(fwhm).rms(radius, of)``; of an image, only what the circle sees is
        smoothed.
        """
        radius = self.central_radius if radius is None else radius
        if self.polarization is not None:
            return self.stokes("I").smoothed_rms(fwhm, radius, of)
        if self.header is None or getattr(self, of) is None:
            return self.smoothed(fwhm).rms(radius, of)
        near = self.distance() <= radius
        reach = self.grid.reach(CUT * fwhm / FWHM_PER_SIGMA)  # type: ignore[union-attr]
        window = tuple(
            _around(np.flatnonzero(near.any(axis=axis)), more)
            for axis, more in zip((1, 0), reach, strict=True)
        )
        planes = {
            name: replace(plane, values=plane.values[:, *window])
            for name, plane in self.planes.items()
        }
        header = _cut(self.header, window[0].start or 0, window[1].start or 0)
        cut = replace(self, header=header, planes=planes)
        return _rms(getattr(cut.smoothed(fwhm), of), cut.weights, near[window])

    def smoothed(self, fwhm: float) -> MapProduct:
        """The map convolved with a Gaussian of ``fwhm`` [rad], weighted: sum_q K w m / sum_q K w
        over pixels with a value.

        Empty pixels neither contribute nor are filled. Noise: pixels are independent before, so its
        variance becomes sum K^2 w^2 n^2 / (sum K w)^2. Hits and weights stay those of the pixel
        itself. I, Q and U are smoothed one by one. Raises InputError for a map in Jy/beam, whose
        beam it would change.
        """
        if self.unit.endswith("/beam"):
            message = (
                f"a map in {self.unit} is per beam of {math.degrees(self.resolution) * 3600:.3g}"
                " arcsec, which smoothing widens"
            )
            raise InputError(
                message,
                place="map",
                cure="smooth it before: map.smooth(...).to('Jy/beam')",
            )
        if self.polarization is not None:
            return self._with_parts([one.smoothed(fwhm) for one in self.by_stokes().values()])
        convolve = smoother(self.grid, fwhm)
        known = self.known
        planes = self._smoothable
        total: Any = None
        weights = np.where(known, self.weights, 0.0)
        for name, plane in planes.items():  # the signal is the first
            values = plane.values[0]
            if plane.smoothing == "mean":
                values, own = weighted_mean(convolve, values, weights)
                total = own if total is None else total
            elif plane.smoothing == "error":
                values = error_of_mean(convolve, values, weights, known, total)
            else:
                continue
            planes[name] = replace(plane, values=values[None])
        return replace(self, planes=planes, smoothed_by=math.hypot(self.smoothed_by, fwhm))

    def _with_parts(self, parts: list[MapProduct]) -> MapProduct:
        """A polarized map whose I, Q and U were changed one by one: of the covariance the variances
        are known.
        """
        covariance = np.full((6, *self.hits.shape), np.nan)
        for row, part in zip((0, 3, 5), parts, strict=True):
            covariance[row] = part.noise**2
        planes = {
            name: plane
            if plane.stokes is None
            else replace(plane, values=np.stack([part.planes[name].values[0] for part in parts]))
            for name, plane in self._smoothable.items()
        }
        made = replace(self, planes=planes, smoothed_by=parts[0].smoothed_by)
        return made.with_planes(covariance=covariance)

    @property
    def _smoothable(self) -> dict[str, Plane]:
        return {name: plane for name, plane in self.planes.items() if plane.smoothing != "lost"}

    @property
    def healpix_full(self) -> Floats:
        """The whole-sphere signal (12 nside^2,), healpy's UNSEEN where there is none (HEALPix
        maps).
        """
        import healpy

        if self.pixels is None:
            raise InputError("not a HEALPix map", place="map", cure="set nside of the map maker")
        whole = np.full(healpy.nside2npix(self.nside), healpy.UNSEEN)
        known = self.known
        whole[self.pixels[known]] = self.signal[known]
        return whole

    def __repr__(self) -> str:
        size = (
            f"nside {self.nside}, {len(self.hits)} pixels"
            if self.header is None
            else f"{self.hits.shape[1]} x {self.hits.shape[0]}"
        )
        return (
            f"<MapProduct {size}, {int(self.hits.sum())} samples"
            f"{f' of {len(self.scans)} scans' if len(self.scans) else ''}, {self.unit}>"
        )

    def _repr_html_(self) -> str:
        hit = self.hits > 0
        rows: list[tuple[Any, Any]] = [
            ("size", repr(self)),
            ("pixel", sides_text(*self.sides)),
            ("pixels hit", int(hit.sum())),
            (
                "smoothed by",
                (
                    f"{math.degrees(self.smoothed_by) * 3600:.3g} arcsec"
                    if self.smoothed_by
                    else "nothing"
                ),
            ),
            ("resolution (FWHM)", f"{math.degrees(self.resolution) * 3600:.3g} arcsec"),
            (
                f"rms within {angle_text(self.central_radius)} of the centre",
                f"{self.rms():.3g} {self.unit}",
            ),
        ]
        if self.half_difference is not None:
            rows.append(
                ("half-difference rms there", f"{self.rms(of='half_difference'):.3g} {self.unit}")
            )
        return html_table("Map", rows)


def _rms(values: Floats, weights: Floats, where: Bools) -> float:
    use = where & np.isfinite(values)
    w = weights[use]
    return (
        float(np.sqrt((w * values[use] ** 2).sum() / w.sum()))
        if use.any() and w.sum() > 0
        else math.nan
    )


def _cut(header: Any, rows: int, columns: int) -> Any:
    """The header of an image without its first rows and columns."""
    found = header.copy()
    found["CRPIX1"], found["CRPIX2"] = (
        float(header["CRPIX1"]) - columns,
        float(header["CRPIX2"]) - rows,
    )
    return found


def _around(places: Integers, reach: int) -> slice:
    """From ``reach`` before the first to ``reach`` behind the last."""
    return (
        slice(max(0, int(places[0]) - reach), int(places[-1]) + reach + 1)
        if places.size
        else slice(0)
    )
