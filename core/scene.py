"""What exists: the site, the instrument, the time, the target and the seed."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, SerializeAsAny, field_validator

from .configuration.parameters import Parameters, named
from .configuration.target import Target
from .configuration.time import Instant
from .errors import ZondaError
from .instrument import Instrument
from .registry import instruments, sites
from .site import Site
from .weather import WeatherSource, weather_source

EARTH = 6371e3
"""Mean radius, m."""
NEAR = 1e3
"""m: what stands nearer than this stands at the same site."""


class Scene(Parameters):
    """What exists while the pipeline observes. `site` and `instrument` take a registered name or an object."""

    site: Site
    """Where the telescope stands: a registered name (`zonda plugins`) or a Site."""
    instrument: Instrument
    """Telescope and camera: a registered name (`zonda plugins`) or an Instrument."""
    time: Instant
    """Start of the first scan, UTC unless it carries an offset, e.g. 2024-11-25T07:00 or 2024-11-25T02:00-05:00."""
    target: Target | None = None
    """Default centre of the scans, e.g. 05h00m00s +20d00m00s (ICRS), 'galactic 120 deg -30 deg' or {az: 180 deg, el: 60 deg};
    in a pipeline file also map, the centre of the input map."""
    weather: Annotated[SerializeAsAny[WeatherSource], BeforeValidator(weather_source)] | None = None
    """The atmosphere: {pwv: 1.2 mm}, {pwv: 25 %}, {pwv: random}, {file: era5.nc}, {table: air.csv}; None: the
    climatology's median."""
    seed: int = Field(0, ge=0, lt=2**63)
    """Root of every random stream; the same seed gives the same bits."""

    @field_validator("site", mode="before")
    @classmethod
    def _site_by_name(cls, value: Any) -> Any:
        return named(sites, value)

    @field_validator("instrument", mode="before")
    @classmethod
    def _instrument_by_name(cls, value: Any) -> Any:
        return named(instruments, value)


def elsewhere(scene: Scene) -> str:
    """What to say of a telescope that the scene puts on another site than its own; empty where it does not."""
    telescope = scene.instrument.telescope
    try:
        home = sites.create(telescope.site) if telescope.site else None
    except ZondaError:  # the site of a plugin that is not installed here
        home = None
    if home is None:
        return ""
    a, b = (np.array([s.latitude, s.longitude]) for s in (home, scene.site))
    half = np.sin((a - b) / 2) ** 2
    distance = 2 * EARTH * float(np.arcsin(np.sqrt(min(1.0, half[0] + np.cos(a[0]) * np.cos(b[0]) * half[1]))))
    if distance < NEAR:
        return ""
    return (
        f"{telescope.name} stands at {home.name}, {distance / 1e3:.0f} km away: here it looks through the atmosphere of "
        f"{scene.site.name}; write 'site: {telescope.site}' for its own"
    )
