"""A passband's view of the atmosphere: emission and transmission against water vapour and
elevation, fast and smooth.

The radiative transfer is run on Chebyshev nodes in u = ln(1 + pwv / p) and v = ln(1 /
sin(elevation)); two functions,

    emission               T = integral t(nu) T_RJ(nu) dnu / integral t(nu) dnu                  (1)
    log transmission   ln <e^-tau> = ln [integral t(nu) e^-tau(nu) dnu / integral t(nu) dnu]  (2)

are then polynomials in u and v. The transmission is averaged over the band, never the opacity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import ArrayLike

from zonda.core.errors import InputError
from zonda.core.instrument import Band
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.radiation import rayleigh_jeans
from zonda.core.observation import LoadSpectra
from zonda.core.types import AnyFloats, Floats

from .absorption import AbsorptionTable, CrossSections
from .profiles import PWV_MAX, check_pwv
from .radiative_transfer import ELEVATION_MIN, Layers, check_elevations, emission, emission_slopes

if TYPE_CHECKING:
    from .profiles import Profile


TOLERANCE = 1e-5
"""Aim of the interpolation: largest error of T relative to T, and of the logarithms relative to 1 +
|logarithm|.
"""
ERROR_MAX = 1e-4
"""A band that cannot be interpolated to this error is refused."""
GRIDS = ((10, 10, 3e1), (14, 10, 1e2), (20, 12, 1e2), (32, 16, 1e4), (48, 24, 1e4))
"""Numbers of nodes in u and v, and pwv_max / p; tried in this order until `TOLERANCE` is met. Clear
windows need no more than the first, others the second; only saturated lines (183, 557 GHz) need
more."""


class BandAtmosphere:
    """Emission and transmission of a band; all methods take floats or arrays that broadcast, and
    return float64.

    Parameters
    ----------
    band
        The passband.
    profile
        The profile; its vapour is scaled to the PWV wanted.
    pwv_max
        Largest PWV of the table, m; three times the profile's own, up to 60 mm, where absent.

    Attributes
    ----------
    transfer
        The radiative transfer that is interpolated.
    error
        Largest interpolation error found against the radiative transfer, counted as `TOLERANCE` is.

    Raises
    ------
    InputError
        A band outside the absorption table, or too opaque to interpolate; later, a PWV or elevation
        outside the limits, which the message names.
    """

    def __init__(
        self,
        band: Band,
        profile: Profile,
        pwv_max: float | None = None,
        spectra: AbsorptionTable | None = None,
    ) -> None:
        self.band = band
        self.pwv_max = min(3 * profile.pwv, PWV_MAX) if pwv_max is None else pwv_max
        check_pwv(self.pwv_max)
        if self.pwv_max == 0:
            raise InputError(
                "the profile is dry, so there is no vapour to vary",
                cure="give a PWV above 0 mm",
            )
        self.transfer = BandTransfer(band, replace(profile.layers, spectra=spectra))
        self._v_max = -math.log(math.sin(ELEVATION_MIN))
        for n_u, n_v, ratio in GRIDS:
            self._scale = self.pwv_max / ratio
            self._u_max = math.log1p(ratio)
            self._coefficients = self._tabulate(n_u, n_v)
            self.error = self._check()
            if self.error < TOLERANCE:
                break
        if not self.error <= ERROR_MAX:
            raise InputError(
                f"its atmosphere cannot be interpolated to better than {self.error:.0e}, the limit"
                f" is {ERROR_MAX:.0e}",
                place=f"band '{band.name}'",
                cure="choose a narrower band, or one off the saturated water lines",
            )

    def emission(self, pwv: ArrayLike, elevation: ArrayLike) -> Floats:
        """Equation (1): the atmosphere alone, background 0 K. PWV in m, elevation in rad ->
        K_RJ.
        """
        return self._evaluate(0, pwv, elevation)

    def log_transmission(self, pwv: ArrayLike, elevation: ArrayLike) -> Floats:
        """Equation (2), <= 0."""
        return self._evaluate(1, pwv, elevation)

    def transmission(self, pwv: ArrayLike, elevation: ArrayLike) -> Floats:
        """<e^-tau>."""
        return np.exp(self.log_transmission(pwv, elevation))

    def opacity(self, pwv: ArrayLike, elevation: ArrayLike) -> Floats:
        """-ln <e^-tau> along the line of sight, neper."""
        return -self.log_transmission(pwv, elevation)

    def emission_difference(self, pwv: ArrayLike, dpwv: ArrayLike, elevation: ArrayLike) -> Floats:
        """emission(pwv + dpwv) - emission(pwv), K_RJ, to float64 precision of the difference
        however small it is.
        """
        return self._difference(0, pwv, dpwv, elevation)

    def log_transmission_difference(
        self,
        pwv: ArrayLike,
        dpwv: ArrayLike,
        elevation: ArrayLike,
    ) -> Floats:
        """log_transmission(pwv + dpwv) - log_transmission(pwv), to float64 precision of the
        difference.
        """
        return self._difference(1, pwv, dpwv, elevation)

    def __repr__(self) -> str:
        return (
            f"BandAtmosphere({self.band.name}, PWV 0 to {self.pwv_max * 1e3:.3g} mm, error"
            f" {self.error:.0e})"
        )

    def _tabulate(self, n_u: int, n_v: int) -> Floats:
        """Chebyshev coefficients (2, n_u, n_v) from values at the Chebyshev points."""
        x_u = chebyshev_points(n_u)
        x_v = chebyshev_points(n_v)
        values = np.array(
            [self.transfer(self._pwv(x), [self._elevation(y) for y in x_v]) for x in x_u]
        )  # (n_u, n_v, 2)
        to_u = _transform(n_u)
        to_v = _transform(n_v)
        return np.asarray(np.einsum("iu,uvf,jv->fij", to_u, values, to_v))

    def _check(self) -> float:
        """Largest error at 45 points: between the nodes, and the ends."""
        points_u = np.array([-1.0, *chebyshev_points(7), 1.0])
        points_v = [-1.0, -0.61, 0.13, 0.87, 1.0]
        pwv = [self._pwv(x) for x in points_u]
        elevations = [self._elevation(y) for y in points_v]
        direct = np.moveaxis(np.array([self.transfer(each, elevations) for each in pwv]), 2, 0)
        found = np.array([self._evaluate(k, np.array(pwv)[:, None], elevations) for k in range(2)])
        scale = np.concatenate([direct[:1], 1 + np.abs(direct[1:])])
        return float(np.max(np.abs(found - direct) / scale))  # NaN where one is

    def _pwv(self, x: float) -> float:
        """PWV at x = -1 .. 1."""
        return min(self._scale * math.expm1(self._u_max * (x + 1) / 2), self.pwv_max)

    def _elevation(self, y: float) -> float:
        """Elevation at y = -1 (zenith) .. 1 (4.5 deg)."""
        return max(math.asin(math.exp(-self._v_max * (y + 1) / 2)), ELEVATION_MIN)

    def _x(self, pwv: Floats) -> Floats:
        if pwv.size and not (pwv.min() >= 0 and pwv.max() <= self.pwv_max * (1 + 1e-12)):
            at = int(np.argmax((pwv < 0) | ~(pwv <= self.pwv_max)))
            raise InputError(
                f"PWV of {pwv.ravel()[at] * 1e3:.6g} mm (value {at} of {pwv.size}) is outside the"
                f" table of band '{self.band.name}', 0 to {self.pwv_max * 1e3:.6g} mm",
                cure="lower the PWV or its rms, or ask for a larger pwv_max",
            )
        return 2 * np.log1p(pwv / self._scale) / self._u_max - 1

    def _y(self, elevation: Floats) -> Floats:
        if elevation.size:
            check_elevations(float(elevation.min()), float(elevation.max()))
        return -2 * np.log(np.sin(elevation)) / self._v_max - 1

    def _evaluate(self, which: int, pwv: ArrayLike, elevation: ArrayLike) -> Floats:
        pwv = np.asarray(pwv, np.float64)
        elevation = np.asarray(elevation, np.float64)
        if pwv.ndim:
            pwv, elevation = np.broadcast_arrays(pwv, elevation)
        basis = chebvander(self._x(pwv).ravel(), self._coefficients.shape[1] - 1).T
        return self._contract(which, basis, elevation)

    def _difference(
        self,
        which: int,
        pwv: ArrayLike,
        dpwv: ArrayLike,
        elevation: ArrayLike,
    ) -> Floats:
        pwv, dpwv, elevation = np.broadcast_arrays(
            *(np.asarray(a, np.float64) for a in (pwv, dpwv, elevation))
        )
        start = self._x(pwv).ravel()
        stop = self._x(pwv + dpwv).ravel()
        step = (2 * np.log1p(dpwv / (self._scale + pwv)) / self._u_max).ravel()
        basis = _differences(start, stop, step, self._coefficients.shape[1])
        return self._contract(which, basis, elevation)

    def _contract(self, which: int, basis: AnyFloats, elevation: Floats) -> Floats:
        """sum_ij basis_i C_ij T_j(y) of one PWV or many, without BLAS: its sums may depend on the
        number of threads.
        """
        y = self._y(elevation).ravel()
        found = np.empty(elevation.size)
        along = self._coefficients[which]
        for chunk in chunks(len(y)):
            one = basis[:, chunk] if basis.shape[1] > 1 else basis
            other = chebvander(y[chunk], along.shape[1] - 1).T
            found[chunk] = np.sum(np.einsum("ij,in->jn", along, one) * other, axis=0)
        return found.reshape(elevation.shape)


@dataclass(frozen=True)
class WaterResponse:
    """Response to water that is added at a height, per metre of PWV, along lines of sight at k
    elevations.

    Attributes
    ----------
    height
        (n,) m above the site of the layers' middles.
    water
        (n,) m of PWV that each holds.
    emission, opacity
        (k, n) dT/dw [K_RJ / m] and d(-ln <e^-tau>)/dw [neper / m] of the band.
    """

    height: Floats
    water: Floats
    emission: Floats
    opacity: Floats

    def of_column(self, name: str) -> Floats:
        """(k,) the same of water that is added everywhere in proportion to what is there."""
        return np.asarray(getattr(self, name) @ self.water / self.water.sum())

    def at(self, name: str, height: Floats) -> Floats:
        """(k, m) ``emission`` or ``opacity`` at heights (m,) above the site [m]; below the lowest
        middle as there.
        """
        return np.array([np.interp(height, self.height, row) for row in getattr(self, name)])


class BandTransfer:
    """Radiative transfer averaged over a band: pwv [m], elevations [rad] -> equations (1) and (2),
    K_RJ and neper, each.
    """

    def __init__(self, band: Band, layers: Layers) -> None:
        weight, square, frequency, cells = _cells(band, layers.table)
        self._layers = layers
        sections = _at_frequencies(layers, frequency, cells)
        self._cross_sections, cell, share = layers.in_parts(sections)
        self._frequency = frequency[cell]
        self._width = weight[cell] * share
        self._weight = self._width / weight.sum()
        self._square = square[cell] * share
        self._source = rayleigh_jeans(self._frequency, layers.temperature[:, None])

    def __call__(self, pwv: float, elevations: list[float]) -> list[tuple[float, float]]:
        layers = self._layers.scaled(pwv)
        vertical = layers.opacity(self._cross_sections)
        return [self._at(vertical * layers.airmass(elevation)[:, None]) for elevation in elevations]

    def spectra(self, pwv: float, elevations: Sequence[float]) -> LoadSpectra:
        """Brightness and transmission in each of the cells."""
        layers = self._layers.scaled(pwv)
        vertical = layers.opacity(self._cross_sections)
        slant = [vertical * layers.airmass(elevation)[:, None] for elevation in elevations]
        brightness = np.array([emission(one, self._source) for one in slant])
        transmission = np.exp(-np.array([one.sum(axis=0) for one in slant]))
        return LoadSpectra(self._frequency, self._width, self._square, brightness, transmission)

    def of_water(self, pwv: float, elevations: Sequence[float]) -> WaterResponse:
        """Response to water at each height, if the column holds ``pwv`` [m]."""
        layers = self._layers.scaled(pwv)
        vertical = layers.opacity(self._cross_sections)
        per_water = layers.opacity_of_water(self._cross_sections)
        emitted = []
        absorbed = []
        for elevation in elevations:
            airmass = layers.airmass(elevation)[:, None]
            slant = vertical * airmass
            gained = per_water * airmass
            emitted.append(
                np.einsum("lf,lf,f->l", emission_slopes(slant, self._source), gained, self._weight)
            )
            opacity = slant.sum(axis=0)
            passed = self._weight * np.exp(opacity.min() - opacity)
            absorbed.append(gained @ (passed / passed.sum()))
        return WaterResponse(layers.middle, layers.water, np.array(emitted), np.array(absorbed))

    def _at(self, slant: Floats) -> tuple[float, float]:
        emitted = float(np.sum(self._weight * emission(slant, self._source)))
        opacity = slant.sum(axis=0)
        least = float(opacity.min())  # factored out, so that opaque bands do not underflow
        passed = self._weight * np.exp(least - opacity)
        return emitted, math.log(passed.sum()) - least


def _cells(band: Band, table: AbsorptionTable) -> tuple[Floats, Floats, Floats, slice]:
    """Integrals of the (piecewise linear) transmission and of its square over each cell of the
    absorption table that it touches, and the mean frequency of the first: not the cell's centre
    where the band ends inside the cell.
    """
    open_ = np.flatnonzero(band.transmission)  # a table of a passband may have zeros far outside it
    support = slice(max(int(open_[0]) - 1, 0), int(open_[-1]) + 2)
    nu = band.frequency[support]
    transmission = band.transmission[support]
    cells = table.cells(float(nu[0]), float(nu[-1]), place=f"band '{band.name}'")
    edges = table.edges[cells.start : cells.stop + 1]
    centre = table.frequency[cells]
    points = np.union1d(np.clip(edges, nu[0], nu[-1]), nu)
    cell = np.clip(np.searchsorted(edges, (points[1:] + points[:-1]) / 2) - 1, 0, len(centre) - 1)
    values = np.interp(points, nu, transmission)
    step = np.diff(points)
    low = values[:-1]
    high = values[1:]
    # from the centre of the cell that begins there
    offset = (points - centre[np.append(cell, cell[-1])])[:-1]
    first = step * (offset * (2 * low + high) + (offset + step) * (low + 2 * high)) / 6
    integral, square, moment = (
        np.bincount(cell, each, len(centre)).astype(np.float64)
        for each in (step * (high + low) / 2, step * (low**2 + low * high + high**2) / 3, first)
    )
    shift = np.divide(moment, integral, out=np.zeros_like(moment), where=integral > 0)
    return integral, square, centre + shift, cells


def _at_frequencies(layers: Layers, frequency: Floats, cells: slice) -> CrossSections:
    """Cross-sections at one frequency in each cell, linear between the cells' centres."""
    centres = layers.table.frequency
    wide = slice(max(cells.start - 1, 0), min(cells.stop + 1, len(centres)))
    known = layers.cross_sections(wide)
    centre = centres[wide]
    low = np.clip(np.searchsorted(centre, frequency, "right") - 1, 0, len(centre) - 2)
    upper = (frequency - centre[low]) / (centre[low + 1] - centre[low])
    upper = np.clip(upper, 0.0, 1.0)  # of the first and the last cell of the table
    nearest = low + (upper > 0.5)

    def linear(sections: Floats) -> Floats:
        return sections[..., low] * (1 - upper) + sections[..., low + 1] * upper

    names = ("dry_air", "water", "water_self", "ozone")
    mixed = {name: linear(getattr(known, name)) for name in names}
    return CrossSections(**mixed, ozone_ratio=known.ozone_ratio[..., nearest])


def chebyshev_points(n: int) -> Floats:
    """Chebyshev's points."""
    return np.cos(np.pi * (np.arange(n) + 0.5) / n)


def _transform(n: int) -> Floats:
    """(n, n) matrix from values at `chebyshev_points` to coefficients."""
    transform = np.cos(np.pi * np.outer(np.arange(n), np.arange(n) + 0.5) / n) * 2 / n
    transform[0] /= 2
    return transform


def _differences(x: Floats, y: Floats, step: Floats, n: int) -> Floats:
    """(n, len(x)) T_k(y) - T_k(x) for y - x = step, by the recurrence of the differences, so
    nothing cancels:

    D_k+1 = 2 y D_k + 2 step T_k(x) - D_k-1.
    """
    start = chebvander(x, n - 1).T
    out = np.zeros((n, x.size))
    out[1] = step
    for k in range(2, n):
        out[k] = 2 * y * out[k - 1] + 2 * step * start[k - 1] - out[k - 2]
    return out
