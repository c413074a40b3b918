"""Sites of telescopes."""

from __future__ import annotations

from pydantic import Field

from .configuration.parameters import Parameters, named_or_written, quantity
from .configuration.units import Angle, Metres
from .registry import sites


class Site(Parameters):
    """A place on the Earth (WGS84 geodetic) and the climatology of the atmosphere above it."""

    name: str
    """Registered name."""
    description: str = ""
    """What it is, in one line."""
    latitude: Angle = Field(ge=-1.5707963267948966, le=1.5707963267948966, examples=["38.43 deg"])
    """Geodetic latitude, north positive."""
    longitude: Angle = Field(ge=-6.283185307179586, le=6.283185307179586, examples=["-79.84 deg"])
    """Longitude, east positive."""
    altitude: Metres = quantity("0 m", ge=-500, le=9000, examples=["2600 m"])
    """Height above the ellipsoid."""
    climatology: str | None = None
    """Name of the embedded climatology, where there is one: those of the built-in sites that have
    one (docs/weather.md).
    """
    provenance: str = ""
    """Source of these numbers."""

    def _as_argument(self) -> str:
        return named_or_written(self, sites)
