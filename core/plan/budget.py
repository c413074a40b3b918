"""The error that a user allows: a share of the noise, or limits in the products' units."""

from __future__ import annotations

from typing import Any

from pydantic import Field, model_validator

from ..configuration.parameters import Parameters
from ..configuration.units import Fraction, Kelvin
from ..errors import ZondaError

TRANSFER = 0.01
"""Error of the transfer function that is allowed where the user states none."""

SHARE = 0.1
"""Share of the noise that is allowed where the user states none."""


class Limits(Parameters):
    """Largest errors that the plan may add, in the products' own units."""

    map_rms: Kelvin | None = Field(None, ge=0)
    """rms per map pixel, e.g. 3 uK; where absent, a tenth of the noise."""
    peak: Kelvin | None = Field(None, ge=0)
    """Of the sky's brightness in the map; where absent, as `map_rms`."""
    transfer: Fraction | None = Field(None, ge=0, le=1)
    """Of the transfer function; where absent, 1 %."""
    tod: Kelvin | None = Field(None, ge=0)
    """rms of one sample of the calibrated time stream; where absent, a tenth of its white noise."""

    psd: Fraction | None = Field(None, ge=0, le=1)
    """Of the time stream's power spectrum, relative; where absent, 10 %."""

    @model_validator(mode="after")
    def _something(self) -> Limits:
        if not self.model_fields_set:
            raise ValueError(
                "state at least one of map_rms, peak, transfer, tod, psd; or a share of the noise,"
                " e.g. 10 %"
            )
        return self


def limits(budget: Any, map_noise: float, sample_noise: float) -> dict[str, float]:
    """Largest bound by metric. ``budget``: a share of the noise (a number), or `Limits`.

    Raises
    ------
    ZondaError
        For a share that is not a number from 0 to 1.
    """
    given = (
        {metric: v for metric, v in budget if v is not None} if isinstance(budget, Limits) else {}
    )
    share = SHARE if isinstance(budget, Limits) else float(budget)
    if not 0 <= share <= 1:
        raise ZondaError(
            f"the budget is a share of the noise from 0 to 1, got {share:g}",
            place="budget",
            cure="write e.g. 10 %",
        )
    in_map, transfer = given.get("map_rms", share * map_noise), TRANSFER * min(1.0, share / SHARE)
    return {
        "map_rms": in_map,
        "peak": in_map,
        "transfer": transfer,
        "tod": share * sample_noise,
        "psd": share,
        **given,
    }
