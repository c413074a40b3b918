"""Radiative transfer through a clear atmosphere of layers, in numpy.

Rays are straight and the layers are spherical shells, so a layer at height h is crossed at the
airmass

    m(h) = [1 - (cos(elevation) R / (R + h))^2]^(-1/2)                                           (1)

which is 1/sin(elevation) high in the sky and 2-7 % less at 5 deg. Refraction, clouds and scattering
are left out: the results are as good as am's (see data/README.md), for clear sky.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from zonda.core.errors import InputError
from zonda.core.numerics.radiation import BOLTZMANN, T_CMB, rayleigh_jeans
from zonda.core.types import Floats, Indices

from .absorption import OZONE_PARTS, AbsorptionTable, CrossSections, absorption_table

AVOGADRO = 6.02214076e23
"""1 / mol (SI, exact)."""
GRAVITY = 9.80665
"""m / s2, standard gravity."""
MOLAR_MASS_DRY_AIR = 28.964e-3
"""kg / mol."""
MOLAR_MASS_WATER = 18.015e-3
"""kg / mol."""
WATER_DENSITY = 1000.0
"""kg / m3, of the liquid that precipitable water is measured in."""
VAPOUR_GAS_CONSTANT = BOLTZMANN * AVOGADRO / MOLAR_MASS_WATER
"""J / (kg K), of water vapour."""
PWV_OF_MOLECULE = MOLAR_MASS_WATER / AVOGADRO / WATER_DENSITY
"""m of PWV per molecule of water per m2."""
EARTH_RADIUS = 6.371e6
"""m, mean."""
OZONE_SPREAD = 4e-4
"""Neper at zenith: where ozone's opacity scatters by more within a cell, the cell is taken in
parts. At 4.5 deg such a cell absorbs 1e-5 less than its mean opacity says."""
ELEVATION_MIN, ELEVATION_MAX = math.radians(4.5), math.radians(90.0)
"""rad: limits of equation (1) without refraction; a telescope at 5 deg has detectors a little
lower.
"""


def check_elevations(low: float, high: float) -> None:
    """Refuse elevations [rad] outside of 4.5 to 90 deg (`InputError`)."""
    if not ELEVATION_MIN * (1 - 1e-9) <= low <= high <= ELEVATION_MAX * (1 + 1e-9):
        raise InputError(
            f"elevations of {math.degrees(low):.2f} to {math.degrees(high):.2f} deg leave the"
            " limits of the radiative transfer, 4.5 to 90 deg",
            cure="choose a target or a time with a higher elevation",
        )


@dataclass(frozen=True)
class Layers:
    """Layers of the atmosphere, ground first.

    Attributes
    ----------
    pressure, temperature
        (n + 1,) Pa and K at the layers' boundaries. The topmost pressure may be 0.
    h2o, o3
        (n,) mean volume mixing ratio of each layer.
    height
        (n + 1,) m above sea level of the boundaries.
    """

    pressure: Floats
    temperature: Floats
    h2o: Floats
    o3: Floats
    height: Floats
    spectra: AbsorptionTable | None = None
    """Cross-sections; where absent, `absorption_table`."""

    @property
    def table(self) -> AbsorptionTable:
        """The cross-sections of these layers."""
        return self.spectra or absorption_table()

    @property
    def molecules(self) -> Floats:
        """(n,) molecules per m2 in hydrostatic balance."""
        return -np.diff(self.pressure) / GRAVITY / self._mass * AVOGADRO

    @property
    def _mass(self) -> Floats:
        """(n,) kg / mol of the air."""
        return MOLAR_MASS_DRY_AIR * (1 - self.h2o) + MOLAR_MASS_WATER * self.h2o

    @property
    def pwv(self) -> float:
        """Precipitable water vapour, m."""
        return (
            float(np.sum(self.molecules * self.h2o)) * MOLAR_MASS_WATER / AVOGADRO / WATER_DENSITY
        )

    def scaled(self, pwv: float) -> Layers:
        """The same layers with all vapour multiplied so that the PWV is ``pwv`` [m]. The pressure
        stays as it is.
        """
        if pwv == 0:
            return replace(self, h2o=np.zeros_like(self.h2o))
        air = -np.diff(self.pressure) / GRAVITY
        h2o = self.h2o
        for _ in range(
            8
        ):  # the number of molecules depends on the water by a few per mille: converges as 0.005^n
            mass = MOLAR_MASS_DRY_AIR + (MOLAR_MASS_WATER - MOLAR_MASS_DRY_AIR) * h2o
            h2o = h2o * (pwv * WATER_DENSITY / (MOLAR_MASS_WATER * np.sum(air * h2o / mass)))
        return replace(self, h2o=h2o)

    def cross_sections(self, cells: slice = slice(None)) -> CrossSections:
        """Cross-sections of each layer at its mean pressure and temperature (independent of the
        water vapour).
        """
        pressure, temperature = ((x[1:] + x[:-1]) / 2 for x in (self.pressure, self.temperature))
        return self.table.cross_sections(pressure, temperature, cells)

    def opacity(self, cross_sections: CrossSections) -> Floats:
        """(n, n_frequency) vertical opacity of each layer, neper."""
        return self.molecules[:, None] * self._each(cross_sections)

    def _each(self, k: CrossSections) -> Floats:
        """(n, n_frequency) cross-section of a molecule of the air."""
        water = self.h2o[:, None]
        ozone = self.o3[:, None]
        # Linear in the mixing ratio, falling to 0.8 of its dry value at 0.05 at most: it is
        # positive up to 0.25, which no air holds (a source of more than 0.1 is refused), so nothing
        # is cut.
        water_section = np.maximum(k.water + water * k.water_self, 0.0)
        return (1 - water) * k.dry_air + water * water_section + ozone * k.ozone

    def opacity_of_water(self, cross_sections: CrossSections) -> Floats:
        """(n, n_frequency) vertical opacity that each layer gains per metre of water [neper / m of
        PWV] that is added to it.

        The pressure stays: vapour takes the place of dry air, which is lighter by its mass.
        """
        k = cross_sections
        water = self.h2o[:, None]
        heavier = (MOLAR_MASS_WATER - MOLAR_MASS_DRY_AIR) / self._mass
        of_mixing = (
            k.water + 2 * water * k.water_self - k.dry_air - heavier[:, None] * self._each(k)
        )  # per molecule of air
        columns = (1 - self.h2o * heavier) * PWV_OF_MOLECULE  # d PWV / d mixing ratio, likewise
        return of_mixing / columns[:, None]

    @property
    def water(self) -> Floats:
        """(n,) PWV that each layer holds, m."""
        return self.molecules * self.h2o * PWV_OF_MOLECULE

    @property
    def middle(self) -> Floats:
        """(n,) m above the site of the middles of the layers."""
        return np.asarray((self.height[1:] + self.height[:-1]) / 2 - self.height[0])

    def in_parts(self, sections: CrossSections) -> tuple[CrossSections, Indices, Floats]:
        """Cross-sections with each cell that has narrow ozone lines in parts, (n, n_part); the cell
        of each part; its share.
        """
        column = (self.molecules * self.o3)[:, None] * sections.ozone
        opacity = np.einsum("lf,glf->gf", column, sections.ozone_ratio)
        scatter = np.sqrt(OZONE_PARTS @ (opacity - column.sum(axis=0)) ** 2)
        lines = np.flatnonzero(scatter > OZONE_SPREAD)
        smooth = np.flatnonzero(scatter <= OZONE_SPREAD)
        cell = np.concatenate([smooth, np.repeat(lines, len(OZONE_PARTS))])
        share = np.concatenate([np.ones(len(smooth)), np.tile(OZONE_PARTS, len(lines))])
        ratio = sections.ozone_ratio[:, :, lines].transpose(1, 2, 0).reshape(len(self.o3), -1)
        ozone = sections.ozone[:, cell]
        ozone[:, len(smooth) :] *= ratio
        names = ("dry_air", "water", "water_self")
        others = {name: getattr(sections, name)[:, cell] for name in names}
        return replace(sections, ozone=ozone, **others), cell, share

    def airmass(self, elevation: float) -> Floats:
        """(n,) slant over vertical path of each layer, equation (1).

        Raises
        ------
        InputError
            Elevation outside 4.5 to 90 deg.
        """
        check_elevations(elevation, elevation)
        ratio = (
            math.cos(elevation)
            * (EARTH_RADIUS + self.height[0])
            / (EARTH_RADIUS + self.height[0] + self.middle)
        )
        return np.asarray(1 / np.sqrt(1 - ratio**2))


@dataclass(frozen=True)
class Spectrum:
    """Opacity and brightness along a ray, per frequency (n,).

    Attributes
    ----------
    frequency
        Hz, centres of cells of 0.5 GHz.
    opacity
        Zenith opacity, neper.
    slant_opacity
        Opacity along the ray, neper.
    brightness
        Rayleigh-Jeans brightness of the atmosphere alone along the ray (background 0 K), K.
    """

    frequency: Floats
    opacity: Floats
    slant_opacity: Floats
    brightness: Floats

    @property
    def cmb(self) -> Floats:
        """Rayleigh-Jeans brightness of the cosmic microwave background behind the atmosphere,
        J(2.725 K) e^-tau, K.
        """
        return rayleigh_jeans(self.frequency, T_CMB) * np.exp(-self.slant_opacity)


def emission(slant_opacity: Floats, source: Floats) -> Floats:
    """Brightness at the ground of layers whose source function is linear in the opacity from
    boundary to boundary.

        T = sum_i e^-tau_below,i [J_i (1 - e^-t_i) + (J_i+1 - J_i) ((1 - e^-t_i)/t_i - e^-t_i)]  (2)

    Parameters
    ----------
    slant_opacity
        (n, ...) t_i, opacity of each layer along the ray, ground first.
    source
        (n + 1, ...) J at the boundaries, K.
    """
    opacity = np.maximum(
        slant_opacity,
        np.finfo(np.float64).tiny,
    )  # so that (1 - e^-t) / t is 1 where t is 0
    absorbed = np.expm1(-opacity)
    np.negative(absorbed, out=absorbed)
    mean = np.divide(absorbed, opacity, out=opacity)
    below = np.ones_like(absorbed)
    np.cumprod(1 - absorbed[:-1], axis=0, out=below[1:])
    absorbed *= slant_opacity > 0
    mean -= 1
    mean += absorbed
    mean *= source[1:] - source[:-1]
    absorbed *= source[:-1]
    mean += absorbed
    return np.asarray(np.einsum("i...,i...->...", below, mean))


def emission_slopes(slant_opacity: Floats, source: Floats) -> Floats:
    """(n, ...) derivatives of `emission` with respect to the opacity t_i of each layer, K: what the
    layer itself emits more, less what it takes from those above it,

        dT/dt_i = e^-tau_below,i [J_i e^-t + (J_i+1 - J_i) (e^-t / t - (1 - e^-t) / t^2 + e^-t)]
                   - sum_k>i T_k                                                   (3)
    """
    t = np.maximum(slant_opacity, 0.0)
    passed = np.exp(-t)
    absorbed = -np.expm1(-t)
    thin = t < 1e-3  # there 1 / t^2 loses digits
    safe = np.where(thin, 1.0, t)
    mean = np.where(thin, 1 - t / 2, absorbed / safe)
    rise = np.where(thin, -0.5 + t / 3 - t**2 / 8, (passed - absorbed / safe) / safe)
    below = np.ones_like(passed)
    np.cumprod(passed[:-1], axis=0, out=below[1:])
    step = source[1:] - source[:-1]
    seen = below * (source[:-1] * absorbed + step * (mean - passed))
    above = np.cumsum(seen[::-1], axis=0)[::-1] - seen
    return np.asarray(below * (source[:-1] * passed + step * (rise + passed)) - above, np.float64)


def spectrum(
    layers: Layers,
    elevation: float,
    *,
    low: float | None = None,
    high: float | None = None,
) -> Spectrum:
    """Opacity and brightness between two frequencies [Hz] (default: the whole table) at an
    elevation [rad].

    Raises
    ------
    InputError
        Elevation, frequency, pressure or temperature outside the limits, which the message names.
    """
    table = layers.table
    edges = table.edges
    cells = table.cells(edges[0] if low is None else low, edges[-1] if high is None else high)
    frequency = table.frequency[cells]
    airmass = layers.airmass(elevation)[:, None]
    sections = layers.cross_sections(cells)
    vertical = layers.opacity(sections)
    parts, cell, share = layers.in_parts(sections)
    seen = emission(
        layers.opacity(parts) * airmass,
        rayleigh_jeans(frequency, layers.temperature[:, None])[:, cell],
    )
    brightness = np.bincount(cell, share * seen, len(frequency)).astype(np.float64)
    return Spectrum(frequency, vertical.sum(axis=0), (vertical * airmass).sum(axis=0), brightness)
