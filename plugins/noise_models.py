"""Noise models: what sets the noise-equivalent temperature of each detector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Fraction, Kelvin
from zonda.core.data import Observation
from zonda.core.errors import InputError
from zonda.core.focalplane import Focalplane
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK, T_CMB, rayleigh_jeans
from zonda.core.types import Floats
from zonda.operators.noise.models import NoiseModel

CELLS = 32
"""Parts of each interval of a passband's table over which a flat load is integrated: h nu t(nu)
errs by 1 / 12 n^2 of the difference of nu over the interval."""


class BackgroundLimited(NoiseModel):
    """Photon noise and bunching of the power that a detector absorbs.

    With N = ``modes * polarizations`` and T(nu) the Rayleigh-Jeans temperature of the load,

        P_nu  = eta N t(nu) k T(nu)                                                              (1)
        NEP^2 = 2 int h nu P_nu dnu + (2 b / N) int P_nu^2 dnu                                   (2)
        NET   = NEP / (sqrt(2) dP/dT),
        dP/dT = eta N k int t(nu) dnu                                         (3)

    (Richards 1994, J. Appl. Phys. 76, 1; Zmuidzinas 2003, Appl. Opt. 42, 4989; W / sqrt(Hz) of
    one-sided spectrum, hence the root 2). The load is what comes through the illuminated aperture,
    epsilon times (the atmosphere's mean emission + the microwave background behind it), the
    telescope and the receiver. Atmosphere and background are resolved over the passband.

    A detector of polarization efficiency p shares each mode between two polarizations, (1 + p) / 2
    and (1 - p) / 2, whose waves bunch by themselves: b = (1 + p^2) / 2, 1 for a perfect polarizer.
    For what accepts both polarizations, b = 1.
    """

    reference: Literal["detector"] = "detector"
    """Equation (3) holds at the detector."""
    optical_efficiency: Fraction = quantity("0.3", gt=0, le=1)
    """eta: share of the power in each accepted polarization at the receiver's window that the
    detectors absorb.
    """
    polarizations: Literal[1, 2] | None = None
    """Polarizations that one detector accepts; where absent 1 for a polarized detector of the focal
    plane, 2 for another.
    """
    modes: int = Field(1, ge=1)
    """Spatial modes per polarization."""
    telescope_temperature: Kelvin = quantity("0 K", ge=0, examples=["270 K"])
    """Emission of mirrors and ground spill-over, as a Rayleigh-Jeans temperature at the receiver's
    window.
    """
    receiver_temperature: Kelvin = quantity("0 K", ge=0, examples=["40 K"])
    """Emission of windows and filters in the receiver, as a Rayleigh-Jeans temperature."""

    def check(self, focalplane: Focalplane) -> None:
        """Refuse two polarizations of a polarized detector."""
        if self.polarizations == 2 and focalplane.polarized:
            raise InputError(
                f"{self.name or 'background_limited'} counts two polarizations, but the focal plane"
                " has polarized detectors, each of which accepts one",
                cure=(
                    "leave polarizations out: it follows from the focal plane, detector by detector"
                ),
            )

    def net(self, observation: Observation) -> Floats:
        """See `NoiseModel.net`. Without an atmosphere in the pipeline the load has none."""
        plane = observation.focalplane
        smooth = observation.smooth
        n = observation.n_detectors
        epsilon = plane.illumination_efficiency
        polarized = plane.polarization_efficiency
        emission = smooth["atmosphere"].time_mean() if "atmosphere" in smooth else np.zeros(n)
        transmission = (
            smooth["transmission"].time_mean() if "transmission" in smooth else np.ones(n)
        )
        warm = np.full(n, self.telescope_temperature + self.receiver_temperature)
        if observation.load_spectra is None or "atmosphere" not in smooth:
            return self.net_of_load(
                observation.instrument.band,
                epsilon * emission + warm,
                epsilon * transmission,
                polarized,
            )
        spectra = observation.load_spectra()
        order = np.argsort(known := spectra.emission)
        sky = spectra.brightness + spectra.transmission * rayleigh_jeans(spectra.frequency, T_CMB)
        moments = _Moments.of(spectra.frequency, spectra.width, spectra.square, sky[order])
        inside = np.clip(emission, known.min(), known.max())
        of_detectors = moments.at(known[order], inside)
        # What another step adds to the atmosphere's emission is taken to be flat.
        return self._net(of_detectors, epsilon, warm + epsilon * (emission - inside), polarized)

    def net_of_load(
        self,
        band: Band,
        load: Floats,
        cmb_transmission: Floats,
        polarization_efficiency: Floats | float = 0.0,
    ) -> Floats:
        """Equations (1) to (3) for a load that is flat over the passband: (n_det,) K_RJ sqrt(s) at
        the detector.

        Parameters
        ----------
        band
            Its transmission is t(nu).
        load
            (n_det,) K_RJ, the same at all frequencies of the band.
        cmb_transmission
            (n_det,) factor on the background's Rayleigh-Jeans temperature.
        polarization_efficiency
            (n_det,) p; 0 of a detector that is not polarized.
        """
        cells = np.arange(len(band.frequency) - 1) + np.arange(CELLS)[:, None] / CELLS
        nu = np.interp(
            np.append(np.sort(cells.ravel()), len(cells.T)),
            np.arange(len(band.frequency)),
            band.frequency,
        )
        t = np.interp(nu, band.frequency, band.transmission)
        step = np.diff(nu)
        middle = (nu[1:] + nu[:-1]) / 2
        width = step * (t[1:] + t[:-1]) / 2
        square = step * (t[1:] ** 2 + t[1:] * t[:-1] + t[:-1] ** 2) / 3
        moments = _Moments.of(middle, width, square, rayleigh_jeans(middle, T_CMB)[None])
        return self._net(
            moments,
            cmb_transmission,
            load,
            np.broadcast_to(polarization_efficiency, load.shape),
        )

    def _net(
        self,
        sky: _Moments,
        epsilon: Floats,
        warm: Floats,
        polarization_efficiency: Floats,
    ) -> Floats:
        """Equations (2) and (3) of the load epsilon x sky + warm."""
        polarized = polarization_efficiency > 0
        n_modes = self.modes * (
            np.where(polarized, 1, 2) if self.polarizations is None else self.polarizations
        )
        bunching = np.where(polarized, (1 + polarization_efficiency**2) / 2, 1.0)
        shot = 2 * PLANCK * (epsilon * sky.photons + warm * sky.photons_of_one)
        waves = (
            2
            * BOLTZMANN
            * (
                epsilon**2 * sky.squares
                + 2 * epsilon * warm * sky.means
                + warm**2 * sky.squares_of_one
            )
        )
        # NEP^2 / (eta N k): the shot noise has one of these factors, bunching two, one of them over
        # N.
        squared = shot + waves * bunching * self.optical_efficiency
        return np.sqrt(squared / (2 * self.optical_efficiency * n_modes * BOLTZMANN)) / sky.width


@dataclass(frozen=True)
class _Moments:
    """Integrals of a load X(nu) over a passband t(nu), of one load or several (k,): int nu t X, int
    t^2 X, int t^2 X^2 dnu; the first and the last of X = 1; and int t dnu. Hz, K."""

    photons: Floats
    means: Floats
    squares: Floats
    photons_of_one: float
    squares_of_one: float
    width: float

    @classmethod
    def of(cls, frequency: Floats, width: Floats, square: Floats, load: Floats) -> _Moments:
        """Moments of loads (k, n) in cells (n,) with the integrals of t and t^2."""
        sums = load @ (frequency * width), load @ square, load**2 @ square
        return cls(*sums, float(frequency @ width), float(square.sum()), float(width.sum()))

    def at(self, known: Floats, wanted: Floats) -> _Moments:
        """Moments between the loads at the rising places ``known`` (k,), at ``wanted`` (m,)."""
        one, two, three = (
            np.interp(wanted, known, v) for v in (self.photons, self.means, self.squares)
        )
        return _Moments(one, two, three, self.photons_of_one, self.squares_of_one, self.width)
