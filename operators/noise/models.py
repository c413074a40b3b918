"""Noise models: what sets the noise-equivalent temperature of each detector.

A third party subclasses `NoiseModel` and names it in the entry-point group ``zonda.noise_models``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from zonda.core.configuration.diagnostics import refusal
from zonda.core.configuration.parameters import Parameters, quantity
from zonda.core.configuration.units import Fraction, Kelvin, KelvinRootSecond
from zonda.core.errors import ZondaError
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK, T_CMB, rayleigh_jeans
from zonda.core.registry import noise_models

if TYPE_CHECKING:
    from zonda.core.data import Observation
    from zonda.core.instrument import Band
    from zonda.core.numerics.smooth import SmoothField

Array = NDArray[np.float64]

INSTRUMENTS = "NET of the instrument"
"""Where `Observation.resolved` has it, if a step has stated another to map makers."""


class NoiseModel(Parameters):
    """Base class of noise models."""

    name: str = ""
    """Name under which the model is registered (filled in by the pipeline)."""
    reference: Literal["sky", "detector"] = "sky"
    """Where the temperature applies: on the sky, after division by zeta e^-tau, or at the detector."""

    def net(self, observation: Observation) -> Array:
        """Noise-equivalent temperature (n_det,) K_RJ sqrt(s), referred to `reference`.

        Called when every operator is prepared: ``observation.smooth`` is complete.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define net(observation)")


class FixedNet(NoiseModel):
    """The same NET whatever the loading."""

    level: KelvinRootSecond | None = Field(None, ge=0)
    """Noise-equivalent temperature; None: each detector's own, from the instrument (quoted on the sky)."""

    @model_validator(mode="after")
    def _reference_of_level(self) -> FixedNet:
        if self.level is None and self.reference == "detector":
            raise ValueError("reference: detector needs level; the instrument's NET is quoted on the sky")
        return self

    @classmethod
    def of(cls, level: float | None, reference: Literal["sky", "detector"]) -> FixedNet:
        """From a checked level in K_RJ sqrt(s)."""
        return cls.model_construct(level=level, reference=reference)

    def net(self, observation: Observation) -> Array:
        """See `NoiseModel.net`."""
        if self.level is None:
            return np.array(observation.resolved.get(INSTRUMENTS, observation.focalplane.net), np.float64)
        return np.full(observation.n_detectors, self.level)


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

    def net(self, observation: Observation) -> Array:
        """See `NoiseModel.net`. Without an atmosphere in the pipeline the load has none."""
        smooth, n = observation.smooth, observation.n_detectors
        epsilon = observation.focalplane.illumination_efficiency
        emission = time_mean(smooth.get("atmosphere"), n, 0.0)
        transmission = time_mean(smooth.get("transmission"), n, 1.0)
        load = epsilon * emission + self.telescope_temperature + self.receiver_temperature
        return self.net_of_load(observation.instrument.band, load, epsilon * transmission)

    def net_of_load(self, band: Band, load: Array, cmb_transmission: Array) -> Array:
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


def time_mean(field: SmoothField | None, n_detectors: int, absent: float) -> Array:
    """Mean over the scan per detector; (n_det,)."""
    if field is None:
        return np.full(n_detectors, absent)
    return np.asarray(field.weights @ field.coefficients.mean(1), np.float64)


def noise_model(value: Any) -> Any:
    """A `NoiseModel` from its registered name, from a mapping with ``name`` and its parameters, or as it is.

    Raises ValueError (shown at the place in the file) for what is not a noise model.
    """
    if isinstance(value, NoiseModel):
        return value
    name = value.get("name") if isinstance(value, dict) else value
    if not isinstance(name, str) or not name:
        raise ValueError("name a noise model, e.g. background_limited, or give a mapping with name and parameters")
    try:
        found = noise_models.get(name)
        if isinstance(value, dict) or isinstance(found, type):
            found = found(**(value if isinstance(value, dict) else {"name": name}))
        elif callable(found):
            found = noise_models.create(name)
    except ZondaError as err:
        raise refusal(err) from None
    if not isinstance(found, NoiseModel):
        raise ValueError(f"noise model {name!r} is no NoiseModel: {found!r:.60}")
    return found
