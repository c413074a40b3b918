"""A merging galaxy cluster in the thermal Sunyaev-Zel'dovich effect: the input of the shipped
``mustang2_cluster`` pipeline.

    python benchmarks/sky_data/cluster.py OUT.fits [--unit y|K_RJ]

Model. Each halo has the universal pressure profile of Arnaud et al. 2010 (A&A 517, A92, eq. 11-13),
x = r / R500:

    P(r) = 1.65e-3 E(z)^(8/3) [M500 / 3e14 h70^-1 Msun]^(2/3 + 0.12) p(x) h70^2   keV cm^-3      (1)
    p(x) = P0 (c x)^-gamma [1 + (c x)^alpha]^-((beta - gamma) / alpha)                           (2)

The merging body drives a bow shock: behind a spherical cap about it the pressure is raised by the
Rankine-Hugoniot jump of an ideal gas (5/3) at Mach number M, which relaxes over the length w behind
the front and fades towards the flank,

    P -> P [1 + (J - 1) exp(-(R - r) / w) C(theta)],   r < R,
    J = (5 M^2 - 1) / 4                             (3)

with C(theta) a raised cosine that is zero beyond the cap's half angle. The Compton parameter is the
numerical line-of-sight integral y = sigma_T / (m_e c^2) int P dl, which
`core.numerics.radiation.thermal_sz` turns into K_RJ at one frequency.

Cosmology: astropy's Planck18. The figures of the shipped map are the defaults below; they describe
no real cluster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.numerics.radiation import thermal_sz
from zonda.core.storage.files import atomic_path
from zonda.core.types import Floats

P0, C500, GAMMA, ALPHA, BETA = 8.403, 1.177, 0.3081, 1.0510, 5.4905
"""Equation (2), Arnaud et al. 2010, eq. 12; P0 is in units of h70^-3/2."""

SIGMA_T = 6.6524587321e-29  # m2, CODATA 2018
ELECTRON_REST_ENERGY = 510.99895  # keV
KPC = 3.0856775814913673e19  # m

ARCSEC = math.pi / 648000.0


@dataclass(frozen=True)
class Halo:
    """A spherical halo: M500 [Msun] and its offset from the map centre, east and north [arcsec]."""

    mass: float
    east: float
    north: float


@dataclass(frozen=True)
class Shock:
    """Equation (3): a cap of radius `radius` about (`east`, `north`) that faces position angle
    `angle` in the sky plane.

    Offsets and lengths in arcsec, angles in degrees (`angle` from north through east).
    """

    east: float
    north: float
    radius: float
    angle: float
    half_angle: float
    width: float
    mach: float

    @property
    def jump(self) -> float:
        """Pressure behind the front over pressure before it (Rankine-Hugoniot, adiabatic index
        5/3).
        """
        return (5.0 * self.mach**2 - 1.0) / 4.0


REDSHIFT = 1.0
HALOS = (Halo(5.3e14, 14.0, -10.0), Halo(2.5e14, -42.0, 30.0), Halo(0.2e14, 95.0, 70.0))
"""Main body, merging body, faint subhalo: 8e14 Msun in all."""
SHOCK = Shock(
    east=-42.0, north=30.0, radius=40.0, angle=-54.5, half_angle=65.0, width=14.0, mach=2.0
)
RA, DEC = 75.0, 20.0  # deg, ICRS: 05h00m00s +20d00m00s
PIXELS = 600
PIXEL_SIZE = 1.0  # arcsec
FREQUENCY = 90e9  # Hz
OUTER = 5.0
"""Halos end at this multiple of R500 (the accretion shock)."""


def r500(mass: float, redshift: float) -> float:
    """Radius [kpc] within which the mean density is 500 times critical; ``mass`` in Msun."""
    from astropy.cosmology import Planck18

    density = float(Planck18.critical_density(redshift).to_value("Msun / kpc3"))
    return float((mass / (4.0 / 3.0 * math.pi * 500.0 * density)) ** (1.0 / 3.0))


def pressure(radius: Floats, mass: float, redshift: float) -> Floats:
    """Equations (1) and (2): electron pressure [keV cm^-3] at ``radius`` [kpc] > 0 of a halo of
    ``mass`` [Msun].
    """
    from astropy.cosmology import Planck18

    h70 = float(Planck18.H0.value) / 70.0
    scale = (
        1.65e-3
        * float(Planck18.efunc(redshift)) ** (8.0 / 3.0)
        * (mass * h70 / 3e14) ** (2.0 / 3.0 + 0.12)
        * h70**2
    )
    x = radius / r500(mass, redshift)
    cx = C500 * x
    shape: Floats = P0 * h70**-1.5 * cx**-GAMMA * (1.0 + cx**ALPHA) ** (-(BETA - GAMMA) / ALPHA)
    return np.where(x < OUTER, scale * shape, 0.0)


def projected(radius: Floats, mass: float, redshift: float) -> Floats:
    """Line-of-sight integral of `pressure` [keV cm^-3 kpc] at projected ``radius`` [kpc].

    With l = R sinh(s) the integrand is smooth for every R > 0 (Gauss-Legendre, 200 points): the
    error is below 1e-5.
    """
    from scipy.interpolate import CubicSpline

    edge = OUTER * r500(mass, redshift)
    nodes = np.geomspace(1e-3, edge, 600)
    reach = np.arccosh(np.maximum(edge / nodes, 1.0))
    abscissa, weights = np.polynomial.legendre.leggauss(200)
    r = nodes[:, None] * np.cosh(reach[:, None] * (abscissa + 1.0) / 2.0)
    values = reach * (
        (pressure(r, mass, redshift) * r) @ weights
    )  # both halves of the line of sight
    spline = CubicSpline(np.log(nodes), values)
    # Within a parsec of the centre the value is that of 1 pc: 1e-6 of r500, far inside any pixel.
    return np.asarray(np.where(radius < edge, spline(np.log(np.clip(radius, nodes[0], edge))), 0.0))


def compton_y(
    halos: tuple[Halo, ...] = HALOS,
    shock: Shock | None = SHOCK,
    redshift: float = REDSHIFT,
    pixels: int = PIXELS,
    pixel_size: float = PIXEL_SIZE,
) -> Floats:
    """The Compton parameter at the pixel centres, (pixels, pixels) float64; rows go north, columns
    go west.
    """
    from astropy.cosmology import Planck18

    kpc = float(Planck18.angular_diameter_distance(redshift).to_value("kpc")) * ARCSEC  # per arcsec
    offset = (np.arange(pixels) - (pixels - 1) / 2.0) * pixel_size
    east, north = -offset[None, :], offset[:, None]
    total = np.zeros((pixels, pixels))
    for halo in halos:
        total += projected(
            kpc * np.hypot(east - halo.east, north - halo.north), halo.mass, redshift
        )
    if shock is not None:
        near = np.hypot(east - shock.east, north - shock.north) < shock.radius
        rows, columns = np.nonzero(near)
        total[rows, columns] += _shock_excess(
            east[0, columns], north[rows, 0], kpc, halos, shock, redshift
        )
    return total * (SIGMA_T * 1e6 * KPC / ELECTRON_REST_ENERGY)  # 1e6: cm^-3 to m^-3


def _shock_excess(
    east: Floats, north: Floats, kpc: float, halos: tuple[Halo, ...], shock: Shock, redshift: float
) -> Floats:
    """Line-of-sight integral [keV cm^-3 kpc] of what equation (3) adds, at positions [arcsec] of
    shape (n,).

    The integration runs over the chord inside the cap's sphere (Gauss-Legendre, 64 points), where
    the integrand is smooth.
    """
    x, y = east - shock.east, north - shock.north
    chord = np.sqrt(shock.radius**2 - x * x - y * y)
    points, weights = np.polynomial.legendre.leggauss(64)
    depth = (
        chord[:, None] * points
    )  # (n, 64) arcsec, along the line of sight from the sky plane through the cluster
    r = np.sqrt((x * x + y * y)[:, None] + depth**2)
    ahead = (x * math.sin(math.radians(shock.angle)) + y * math.cos(math.radians(shock.angle)))[
        :, None
    ] / r
    theta = np.degrees(np.arccos(np.clip(ahead, -1.0, 1.0)))
    cap = np.where(theta < shock.half_angle, np.cos(np.pi / 2 * theta / shock.half_angle) ** 2, 0.0)
    gas = np.zeros_like(depth)
    for halo in halos:
        separation = np.sqrt(
            ((east - halo.east) ** 2 + (north - halo.north) ** 2)[:, None] + depth**2
        )
        gas += pressure(kpc * separation, halo.mass, redshift)
    excess = gas * (shock.jump - 1.0) * np.exp(-(shock.radius - r) / shock.width) * cap
    return kpc * chord * (excess @ weights)


def header(unit: str, redshift: float = REDSHIFT) -> Any:
    """The map's astropy Header: TAN grid, unit (``y`` or ``K_RJ``) and the parameters of the model.
    No date: same bytes.
    """
    from astropy.io.fits import Header

    cards: list[tuple[str, Any, str]] = [
        ("CTYPE1", "RA---TAN", ""),
        ("CTYPE2", "DEC--TAN", ""),
        ("CRVAL1", RA, "[deg]"),
        ("CRVAL2", DEC, "[deg]"),
        ("CRPIX1", (PIXELS + 1) / 2, ""),
        ("CRPIX2", (PIXELS + 1) / 2, ""),
        ("CDELT1", -PIXEL_SIZE / 3600, "[deg]"),
        ("CDELT2", PIXEL_SIZE / 3600, "[deg]"),
        ("CUNIT1", "deg", ""),
        ("CUNIT2", "deg", ""),
        ("RADESYS", "ICRS", ""),
        ("OBJECT", "SIMULATED MERGING CLUSTER", "not a real object"),
        ("ORIGIN", "benchmarks/sky_data/cluster.py", "the script that made it"),
    ]
    if unit == "y":
        cards += [("BUNIT", "y", "Compton parameter")]
    else:
        cards += [
            ("BUNIT", "K", "kelvin"),
            ("TEMPSCAL", "K_RJ", "temperature scale: Rayleigh-Jeans"),
            ("FREQ", FREQUENCY, "[Hz] frequency of the conversion from Compton y"),
            (
                "YTOKRJ",
                float(thermal_sz(FREQUENCY)),
                "[K] K_RJ per unit Compton y, non-relativistic",
            ),
        ]
    cards += [
        ("REDSHIFT", redshift, ""),
        ("M500", sum(h.mass for h in HALOS), "[Msun] of all halos"),
        ("NHALO", len(HALOS), ""),
    ]
    for k, halo in enumerate(HALOS, 1):
        cards += [
            (f"MASS{k}", halo.mass, "[Msun] M500"),
            (f"EAST{k}", halo.east, "[arcsec] offset of the halo"),
            (f"NORTH{k}", halo.north, "[arcsec] offset of the halo"),
        ]
    cards += [
        ("SHMACH", SHOCK.mach, "Mach number of the bow shock"),
        ("SHEAST", SHOCK.east, "[arcsec] centre of its cap"),
        ("SHNORTH", SHOCK.north, "[arcsec] centre of its cap"),
        ("SHRADIUS", SHOCK.radius, "[arcsec] radius of its cap"),
        ("SHANGLE", SHOCK.angle, "[deg] direction it faces, north through east"),
        ("SHHALF", SHOCK.half_angle, "[deg] half angle of its cap"),
        ("SHWIDTH", SHOCK.width, "[arcsec] relaxation behind the front"),
    ]
    made = Header(cards)
    made["COMMENT"] = (
        "Two generalized-NFW halos (Arnaud et al. 2010), a bow shock and a faint subhalo, Planck18."
    )
    made["COMMENT"] = f"Made by: python benchmarks/sky_data/cluster.py OUT.fits --unit {unit}"
    return made


def make(unit: str = "K_RJ") -> tuple[NDArray[np.float32], Any]:
    """The shipped map, (600, 600) float32, and its header; ``unit`` is ``y`` or ``K_RJ`` (at 90
    GHz).
    """
    if unit not in ("y", "K_RJ"):
        raise ValueError(f"unit must be y or K_RJ, got {unit!r}")
    factor = 1.0 if unit == "y" else float(thermal_sz(FREQUENCY))
    return (compton_y() * factor).astype(np.float32), header(unit)


def write(path: Path, unit: str = "K_RJ") -> None:
    """Write `make`'s map to ``path``; the same machine and versions give the same bytes."""
    from astropy.io import fits

    values, cards = make(unit)
    with atomic_path(path) as temporary:
        fits.PrimaryHDU(values, cards).writeto(temporary, overwrite=True)


def main(arguments: list[str] | None = None) -> None:
    """The command line of this module."""
    import argparse

    parser = argparse.ArgumentParser(
        prog="python benchmarks/sky_data/cluster.py", description="Write the merging-cluster map."
    )
    parser.add_argument("out", type=Path, help="FITS file to write")
    parser.add_argument(
        "--unit",
        choices=["y", "K_RJ"],
        default="K_RJ",
        help="Compton y, or K_RJ at 90 GHz (default)",
    )
    given = parser.parse_args(arguments)
    write(given.out, given.unit)


if __name__ == "__main__":
    main()
