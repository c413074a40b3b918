"""Noise models: what sets the noise-equivalent temperature of each detector."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Fraction, Kelvin
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK, T_CMB, rayleigh_jeans
from zonda.core.types import Floats
from zonda.operators.noise.models import NoiseModel

if TYPE_CHECKING:
    from zonda.core.data import Observation
    from zonda.core.instrument import Band


class BackgroundLimited(NoiseModel):
    """Photon noise and bunching of the power that a detector absorbs.

    With N = ``modes * polarizations`` and T(nu) the Rayleigh-Jeans temperature of the load,

        P_nu  = eta N t(nu) k T(nu)                                                                           (1)
        NEP^2 = 2 int h nu P_nu dnu + (2 / N) int P_nu^2 dnu                                                   (2)
        NET   = NEP / (sqrt(2) dP/dT),   dP/dT = eta N k int t(nu) dnu                                         (3)

    (Zmuidzinas 2003, Appl. Opt. 42, 4989; W / sqrt(Hz) of one-sided spectrum, hence the root 2). The load is what comes
    through the illuminated aperture, epsilon times (the atmosphere's mean emission + the microwave background behind it), the
    telescope and the receiver.
    """

    reference: Literal["detector"] = "detector"
    """Equation (3) holds at the detector."""
    optical_efficiency: Fraction = quantity("0.3", gt=0, le=1)
    """eta: share of the power at the receiver's window that the detectors absorb."""
    polarizations: Literal[1, 2] = 2
    """Polarizations that one detector absorbs."""
    modes: int = Field(1, ge=1)
    """Spatial modes per polarization."""
    telescope_temperature: Kelvin = quantity("0 K", ge=0)
    """Emission of mirrors and ground spill-over, as a Rayleigh-Jeans temperature at the receiver's window."""
    receiver_temperature: Kelvin = quantity("0 K", ge=0)
    """Emission of windows and filters in the receiver, as a Rayleigh-Jeans temperature."""

    def net(self, observation: Observation) -> Floats:
        """See `NoiseModel.net`. Without an atmosphere in the pipeline the load has none."""
        smooth, n = observation.smooth, observation.n_detectors
        epsilon = observation.focalplane.illumination_efficiency
        emission = smooth["atmosphere"].time_mean() if "atmosphere" in smooth else np.zeros(n)
        transmission = smooth["transmission"].time_mean() if "transmission" in smooth else np.ones(n)
        load = epsilon * emission + self.telescope_temperature + self.receiver_temperature
        return self.net_of_load(observation.instrument.band, load, epsilon * transmission)

    def net_of_load(self, band: Band, load: Floats, cmb_transmission: Floats) -> Floats:
        """Equations (1) to (3): (n_det,) K_RJ sqrt(s) at the detector.

        Parameters
        ----------
        band
            Its transmission is t(nu).
        load
            (n_det,) K_RJ, the same at all frequencies of the band.
        cmb_transmission
            (n_det,) factor on the background's Rayleigh-Jeans temperature.
        """
        nu, t = band.frequency, band.transmission
        temperature = load[:, None] + cmb_transmission[:, None] * rayleigh_jeans(nu, T_CMB)
        n_modes = self.modes * self.polarizations
        power = self.optical_efficiency * n_modes * BOLTZMANN * t * temperature
        squared = 2 * np.trapezoid(PLANCK * nu * power, nu, axis=1) + 2 / n_modes * np.trapezoid(power**2, nu, axis=1)
        responsivity = self.optical_efficiency * n_modes * BOLTZMANN * band.width
        return np.asarray(np.sqrt(squared / 2) / responsivity)
