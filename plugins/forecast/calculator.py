"""The formula of the AtLAST sensitivity calculator, at the band's centre and averaged over the
band, with zonda's own atmosphere.

    dS = SEFD / (eta_s sqrt(n_pol dnu t)),
    SEFD(nu) = 2 k T_sys / (eta_A A_g)                                     (1)
    T_sys = [T_rx + eta_eff T_sky + (1 - eta_eff) J(T_amb)] / (eta_eff T),
    T_sky = (1 - T) T_atm + T J(T_cmb)     (2)
    T = exp(-tau_0 / sin(elevation)),   T_atm = T_zenith / (1 - exp(-tau_0)),
    T_rx = 5 h nu / k                  (3)
    eta_A = eta_ill eta_spill eta_pol eta_block exp(-(4 pi rms / lambda)^2)                      (4)

J(T) is the Rayleigh-Jeans brightness, A_g the area of the dish. The calculator evaluates (1) at the
centre of the band, and over the band where it is told to (its option ``finetune``) with

    SEFD = (dnu / int dnu / SEFD(nu)^2)^(1/2)                                                    (5)

Formula and constants are those of its documentation
(github.com/ukatc/AtLAST_sensitivity_calculator, generic receiver). Its atmosphere is am's for the
Chajnantor plateau; here it is the scene's, at the scene's PWV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.instrument import SPEED_OF_LIGHT, Band
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK, T_CMB, rayleigh_jeans
from zonda.core.types import Floats
from zonda.operators.atmosphere.weather.radiative_transfer import Layers, spectrum

if TYPE_CHECKING:
    from .survey import Survey

FORWARD, SYSTEM, POLARIZATIONS = 0.95, 0.99, 2
"""eta_eff, eta_s and n_pol."""
APERTURE = 0.8 * 0.95 * 0.995 * 0.94
"""eta_ill eta_spill eta_pol eta_block."""
SURFACE, AMBIENT, QUANTA = 25e-6, 270.0, 5.0
"""rms of the dish [m], T_amb [K], and T_rx in units of h nu / k."""
MARGIN = 1e9
"""Hz beyond the band that spectra are computed for."""


@dataclass(frozen=True)
class Calculated:
    """Point-source sensitivity by equation (1), one standard deviation, for an integration time on
    the source.

    Attributes
    ----------
    centre, band
        Jy, with the SEFD at the band's centre, and with (5).
    seconds
        The time.
    pwv, elevation, diameter
        m, rad, m.
    """

    centre: float
    band: float
    seconds: float
    pwv: float
    elevation: float
    diameter: float

    def after(self, seconds: float) -> Calculated:
        """For another time."""
        share = math.sqrt(self.seconds / seconds)
        return Calculated(
            self.centre * share,
            self.band * share,
            seconds,
            self.pwv,
            self.elevation,
            self.diameter,
        )


def calculate(
    layers: Layers,
    band: Band,
    diameter: float,
    elevation: float,
    seconds: float,
) -> Calculated:
    """Equations (1) to (5) for an atmosphere, a passband, a dish of ``diameter`` [m] at an
    elevation [rad], and a time [s].

    The band's transmission weighs its frequencies in (5), and dnu is its equivalent width. Raises
    InputError for a band outside the tables of the atmosphere.
    """
    frequency = band.frequency
    response = band.transmission
    seen = spectrum(
        layers,
        math.pi / 2,
        low=float(frequency[0]) - MARGIN,
        high=float(frequency[-1]) + MARGIN,
    )
    fine = np.linspace(frequency[0], frequency[-1], max(len(frequency), 2001))
    share = np.interp(fine, frequency, response)

    def sefd(nu: Floats) -> Floats:
        opacity, zenith = (
            np.interp(nu, seen.frequency, values) for values in (seen.opacity, seen.brightness)
        )
        return system_flux(nu, opacity, zenith, diameter, elevation)

    width = float(np.trapezoid(share, fine))
    whole = math.sqrt(width / float(np.trapezoid(share / sefd(fine) ** 2, fine)))
    root = SYSTEM * math.sqrt(POLARIZATIONS * width * seconds)
    centre = float(sefd(np.array([band.centre]))[0])
    return Calculated(
        centre / root * 1e26,
        whole / root * 1e26,
        seconds,
        layers.pwv,
        elevation,
        diameter,
    )


def system_flux(
    nu: Floats,
    opacity: Floats,
    zenith: Floats,
    diameter: float,
    elevation: float,
) -> Floats:
    """SEFD of (1) to (4), W m^-2 Hz^-1, at frequencies [Hz] with zenith opacity [neper] and zenith
    brightness [K_RJ].
    """
    passed = np.exp(-opacity / math.sin(elevation))
    air = zenith / -np.expm1(-opacity)
    sky = (1 - passed) * air + passed * rayleigh_jeans(nu, T_CMB)
    system = (
        QUANTA * PLANCK * nu / BOLTZMANN
        + FORWARD * sky
        + (1 - FORWARD) * rayleigh_jeans(nu, AMBIENT)
    )
    aperture = (
        APERTURE
        * np.exp(-((4 * math.pi * SURFACE * nu / SPEED_OF_LIGHT) ** 2))
        * math.pi
        * diameter**2
        / 4
    )
    return 2 * BOLTZMANN * system / (FORWARD * passed) / aperture


def of_survey(survey: Survey, seconds: float) -> Calculated | None:
    """`calculate` for the middle of the first scan, ``seconds`` on the source; None where the scene
    has no atmosphere.
    """
    step = survey.atmosphere
    first = survey.observations[survey.configured[0]]
    if step is None:
        return None
    model = step.model(first)
    instrument = survey.scene.instrument
    elevation = float(np.median(first.elevation))
    return calculate(
        model.profile.scaled(model.pwv).layers,
        instrument.band,
        instrument.telescope.diameter,
        elevation,
        seconds,
    )
