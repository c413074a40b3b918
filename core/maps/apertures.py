"""Aperture photometry: the flux density of a map within a circle.

With the brightness m [W m^-2 Hz^-1 sr^-1] of a pixel, its solid angle W, the share s of it that
lies within the circle and the share a within an annulus, whose mean is taken off where one is
given,

    F = sum_p w_p m_p,   w = s W - a W sum(s W) / sum(a W)                                      (1)

Shares of pixels on an edge are the part of `PARTS` x `PARTS` points, evenly spaced in the pixel
(HEALPix: its equal parts), that lie within: the area of a circle of 2 pixels' radius and more is
right to 2e-3. The brightness of a pixel is taken as uniform, which within a Gaussian of FWHM b
errs by 2 % at most for pixels of b / 5, and by 3 % for pixels of b / 2 and radii of 2 b / 3. The
error of the flux is that of independent pixels, times what noise alone has in
apertures of this kind on the map (noise that is correlated between pixels counts in full):

    e^2 = f^2 sum_p w_p^2 n_p^2,   f^2 = mean_k F_k(noise)^2 / sum_p w_kp^2 n_p^2                (2)

with up to `MOST` circles k beside each other; where fewer than `FEW` lie in the map, f is that of
single pixels (`planes.noise_factor`), and 1 where nothing holds noise alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic_core import PydanticCustomError

from ..configuration.diagnostics import input_error
from ..configuration.target import Target
from ..errors import InputError
from ..numerics.sphere import angle_text, angles, local_axes, unit_vectors
from ..types import Floats
from .grid import HealpixPixels, ImagePixels
from .planes import WHITE, noise_factor
from .units import angle_of

PARTS = 16
MOST = 30
FEW = 5
COMPLETE = 0.95
"""Least share of a circle that has values."""
JANSKY = 1e6
"""Jy per MJy/sr and sr."""


@dataclass(frozen=True)
class ApertureFlux:
    """Flux density within a circle.

    Attributes
    ----------
    flux, error
        Jy; the error, equation (2), is NaN where no noise is known.
    radius
        rad.
    missing
        Share of the circle without values, which count as 0.
    noise
        What the error was measured in.
    """

    flux: float
    error: float
    radius: float
    missing: float
    noise: str

    def __str__(self) -> str:
        if math.isfinite(self.error) and self.error > 0:  # two digits of the error, and as far
            digits = max(1 - math.floor(math.log10(self.error)), 0)
            flux = f"{self.flux:.{digits}f} +- {self.error:.{digits}f}"
        else:
            flux = f"{self.flux:.5g}"
        return f"{flux} Jy within {angle_text(self.radius)}"


@dataclass(frozen=True)
class Aperture:
    """A circle of ``radius`` [rad] and, where its background is taken off, an annulus from
    ``inner`` to ``outer`` [rad].
    """

    radius: float
    inner: float = 0.0
    outer: float = 0.0

    def weights(self, grid: Any, centre: tuple[float, float], known: Any) -> tuple[Floats, float]:
        """Weights [sr] of equation (1) about ``centre`` (longitude, latitude) [rad] in the frame of
        a grid, 0 without values; and the share of the circle without.
        """
        areas = np.where(known & grid.once, grid.areas, 0.0)
        circle = areas * within(grid, centre, self.radius)
        size = float(circle.sum())
        missing = max(1 - size / (4 * math.pi * math.sin(self.radius / 2) ** 2), 0.0)
        if not self.outer:
            return circle, missing
        ring = areas * (within(grid, centre, self.outer) - within(grid, centre, self.inner))
        total = float(ring.sum())
        return circle - ring * (size / total if total else math.nan), missing


def within(grid: ImagePixels | HealpixPixels, centre: tuple[float, float], radius: float) -> Floats:
    """Shares of the pixels of a grid that are nearer than ``radius`` [rad] to ``centre``."""
    distance = grid.distance(centre)
    if isinstance(grid, ImagePixels):
        xx, xy, yy = grid.scattered_metric
        reach = math.sqrt(float(np.nanmax(xx + yy + 2 * abs(xy)))) / 2
    else:
        import healpy

        reach = float(healpy.max_pixrad(grid.nside))
    with np.errstate(invalid="ignore"):
        edge = abs(distance - radius) <= reach
        found = np.where(distance < radius, 1.0, 0.0)
    if isinstance(grid, ImagePixels):
        y, x = (n[:, None, None] for n in np.nonzero(edge))
        step = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        rays = grid.at(x + step, y + step[:, None])
    else:
        pixels = grid.pixels[edge]
        nested = pixels if grid.nest else healpy.ring2nest(grid.nside, pixels)
        parts = nested[:, None] * PARTS**2 + np.arange(PARTS**2)
        rays = np.stack(healpy.pix2vec(grid.nside * PARTS, parts, nest=True), axis=-1)[:, None]
    chord = ((rays - unit_vectors(*centre)) ** 2).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        found[edge] = (chord <= 4 * math.sin(radius / 2) ** 2).mean(axis=(1, 2))
    return found


def flux_within(
    product: Any,
    aperture: Aperture,
    centre: tuple[float, float] | None = None,
    alone: tuple[Floats, str] | None = None,
    spectral_index: float | None = None,
) -> ApertureFlux:
    """Equations (1) and (2) of a map of I.

    ``centre``: (longitude, latitude) [rad] in the frame of the map; default: its own. ``alone``: a
    map of noise alone in the unit of the map, and its name. Raises InputError where the map cannot
    be converted to Jy, or less than `COMPLETE` of the circle has values.
    """
    grid = product.grid
    known = product.known & np.isfinite(product.signal)
    shown = product.to("MJy/sr", spectral_index=spectral_index)
    weights, missing = aperture.weights(grid, centre or product.centre, known)
    if missing > 1 - COMPLETE or not np.isfinite(weights).all():
        raise InputError(
            f"{100 * missing:.2g} % of the circle of {angle_text(aperture.radius)} has no value, or"
            " its annulus none",
            place="aperture",
            cure="choose a smaller radius or another centre, or make a map with larger pixels",
        )
    noise = shown.noise
    used = weights != 0
    if product.weighting == "inverse_variance":
        with np.errstate(divide="ignore"):
            noise = np.where(np.isfinite(noise), noise, shown.weights**-0.5)
    flux = JANSKY * float((weights[used] * shown.signal[used]).sum())
    error = JANSKY * math.sqrt(float(((weights[used] * noise[used]) ** 2).sum()))
    factor = 1.0
    words = WHITE
    if alone is not None:
        both = product.with_planes(half_difference=alone[0])
        empty: Any = both.to("MJy/sr", spectral_index=spectral_index).half_difference
        ratios = _ratios(product, aperture, noise, np.where(known, empty, np.nan))
        many = len(ratios) >= FEW
        found = math.sqrt(np.mean(ratios**2)) if many else noise_factor(product.noise, alone[0])
        if found:
            where = f"{len(ratios)} apertures" if many else "single pixels"
            factor = found
            words = f"{where} on {alone[1]}"
    if not math.isfinite(error) or (product.smoothed_by and "apertures" not in words):
        factor, words = math.nan, "not known"  # pixels of smoothed maps are not independent
    return ApertureFlux(flux, factor * error, aperture.radius, missing, words)


def _ratios(product: Any, aperture: Aperture, noise: Floats, alone: Floats) -> Floats:
    """Fluxes of noise ``alone`` over their errors by ``noise``, in circles beside each other, from
    the centre of the map outwards.
    """
    grid = product.grid
    known = np.isfinite(alone) & np.isfinite(noise)
    across = math.ceil(math.sqrt(MOST)) + 3
    x, y = (2 * aperture.radius * k for k in np.mgrid[-across : across + 1, -across : across + 1])
    order = np.argsort(np.hypot(x, y), axis=None, kind="stable")
    middle, east, north = local_axes(*product.centre)
    rays = middle + np.outer(x.ravel()[order], east) + np.outer(y.ravel()[order], north)
    places = grid.pixels_at(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    found: list[float] = []
    for ray, place in zip(rays, places, strict=True):
        if place < 0 or not known.flat[place]:
            continue
        lon, lat = angles(ray / np.linalg.norm(ray))
        weights, missing = aperture.weights(grid, (float(lon), float(lat)), known)
        used = weights != 0
        if missing > 1 - COMPLETE or not np.isfinite(weights).all():
            continue
        size = math.sqrt(float(((weights[used] * noise[used]) ** 2).sum()))
        found.append(float((weights[used] * alone[used]).sum()) / size if size else math.nan)
        if len(found) == MOST:
            break
    return np.array([ratio for ratio in found if math.isfinite(ratio)])


def in_frame(product: Any, target: Target) -> tuple[float, float]:
    """(longitude, latitude) [rad] of a target in the frame of a map."""
    lon, lat = angles(unit_vectors(*target.icrs()) @ product.grid.turn.T)
    return float(lon), float(lat)


def aperture_flux(
    product: Any,
    radius: Any,
    centre: Any = None,
    annulus: Any = None,
    spectral_index: float | None = None,
) -> ApertureFlux:
    """`MapProduct.aperture_flux`."""
    if product.polarization is not None:
        return aperture_flux(product.stokes("I"), radius, centre, annulus, spectral_index)
    call = "map.aperture_flux('1 arcmin', annulus=('2 arcmin', '3 arcmin'))"
    ring = () if annulus is None else annulus
    pair = annulus is None or (
        hasattr(ring, "__len__") and not isinstance(ring, str) and len(ring) == 2
    )
    sizes = [angle_of(each, call) for each in (radius, *(ring if pair else ()))]
    if not pair or sizes != sorted(sizes) or len(set(sizes[1:])) == 1:
        wrong = "annulus has an inner and an outer radius: radius <= inner < outer"
        raise InputError(wrong, place="map.aperture_flux", cure=f"write {call}")
    try:
        where = None if centre is None else in_frame(product, Target.parse(centre))
    except PydanticCustomError as err:
        raise input_error(err, "map.aperture_flux, centre") from None
    half = product.half_difference
    alone = None if half is None else (half, f"half the difference, {product.difference}")
    return flux_within(product, Aperture(*sizes), where, alone, spectral_index)
