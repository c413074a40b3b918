"""Base class of noise models, and the fixed NET. Others are plugins: the entry-point group
``zonda.noise_models`` names them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from zonda.core.configuration.diagnostics import refusal
from zonda.core.configuration.parameters import Parameters
from zonda.core.configuration.units import KelvinRootSecond
from zonda.core.errors import ZondaError
from zonda.core.registry import noise_models
from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.focalplane import Focalplane
    from zonda.core.observation import Observation


class NoiseModel(Parameters):
    """Base class of noise models."""

    name: str = ""
    """Name under which the model is registered (filled in by the pipeline)."""
    reference: Literal["sky", "detector"] = "sky"
    """Where the temperature applies: on the sky, after division by zeta e^-tau, or at the detector.
    """

    def check(self, focalplane: Focalplane) -> None:
        """Refuse parameters that contradict the detectors (`InputError`)."""

    def net(self, observation: Observation) -> Floats:
        """Noise-equivalent temperature (n_det,) K_RJ sqrt(s), referred to `reference`.

        Called when every operator is prepared: ``observation.smooth`` is complete.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define net(observation)")


class FixedNet(NoiseModel):
    """The same NET for any load."""

    level: KelvinRootSecond | None = Field(None, ge=0)
    """Noise-equivalent temperature; None: each detector's own, from the instrument (quoted on the
    sky).
    """

    @model_validator(mode="after")
    def _reference_of_level(self) -> FixedNet:
        if self.level is None and self.reference == "detector":
            raise ValueError(
                "reference: detector needs level; the instrument's NET is quoted on the sky"
            )
        return self

    @classmethod
    def of(cls, level: float | None, reference: Literal["sky", "detector"]) -> FixedNet:
        """The noise model of a checked level in K_RJ sqrt(s)."""
        return cls.model_construct(level=level, reference=reference)

    def net(self, observation: Observation) -> Floats:
        """See `NoiseModel.net`."""
        if self.level is None:
            quoted = observation.quoted_net
            return np.array(observation.focalplane.net if quoted is None else quoted, np.float64)
        return np.full(observation.n_detectors, self.level)


def noise_model(value: Any) -> Any:
    """A `NoiseModel` from its registered name, from a mapping with ``name`` and its parameters, or
    as it is.

    Raises ValueError (shown at the place in the file) for what is not a noise model.
    """
    if isinstance(value, NoiseModel):
        return value
    name = value.get("name") if isinstance(value, dict) else value
    if not isinstance(name, str) or not name:
        raise ValueError(
            "name a noise model, e.g. background_limited, or give a mapping with name and"
            " parameters"
        )
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
