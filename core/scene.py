"""The scene: site, instrument, time, target, weather and seed."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from pydantic import BeforeValidator, Field, SerializeAsAny, field_validator

from .configuration.diagnostics import mistake
from .configuration.parameters import Parameters, named
from .configuration.target import Target
from .configuration.time import Instant
from .errors import ZondaError
from .instrument import Instrument
from .registry import instruments, sites, weather_sources
from .site import Site
from .weather import GroundWeather, WeatherSource, weather_source

EARTH = 6371e3
"""Mean radius, m."""
NEAR = 1e3
"""m: what stands nearer than this stands at the same site."""
HIGHER = 200.0
"""Largest difference of height to a site whose climatology is used, m."""


class Scene(Parameters):
    """Site, instrument, time, target, weather and seed of the observations. `site` and `instrument`
    take a registered name or an object.
    """

    site: Site
    """Where the telescope stands: a registered name (`zonda plugins`) or a Site."""
    instrument: Instrument
    """Telescope and camera: a registered name (`zonda plugins`), an Instrument, or a variant of
    one, e.g. {like: mustang2, detectors: 170}."""
    time: Instant
    """Start of the first scan, UTC unless it carries an offset, e.g. 2024-11-25T07:00 or
    2024-11-25T02:00-05:00.
    """
    target: Target | None = None
    """Default centre of the scans, e.g. 05h00m00s +20d00m00s (ICRS), 'galactic 120 deg -30 deg' or
    {az: 180 deg, el: 60 deg}; in a pipeline file also map, the centre of the input map."""
    weather: Annotated[SerializeAsAny[WeatherSource], BeforeValidator(weather_source)] | None = None
    """The atmosphere: {pwv: 1.2 mm}, {pwv: 25 %}, {pwv: random}, {file: era5.nc}, {table: air.csv};
    None: the climatology's median."""
    seed: int = Field(0, ge=0, lt=2**63)
    """Root of every random stream; the same seed gives the same bits."""

    @field_validator("site", mode="before")
    @classmethod
    def _site_by_name(cls, value: Any) -> Any:
        return site_at(value) if hasattr(value, "to_geodetic") else named(sites, value)

    @field_validator("instrument", mode="before")
    @classmethod
    def _instrument_by_name(cls, value: Any) -> Any:
        return named(instruments, value)

    def replace(self, **changes: Any) -> Scene:
        """The scene with other values, checked: ``scene.replace(seed=8)``. Raises
        `ParameterError`.
        """
        return type(self)(
            **({name: getattr(self, name) for name in self.model_fields_set} | changes)
        )

    def ground_weather(self) -> GroundWeather:
        """Weather at the telescope at the start of the scene.

        The class of the climatology, which is always installed, makes it from the column of any
        source. Raises InputError where the source does not cover the place or the time.
        """
        found: GroundWeather = weather_sources.get("climatology").ground_weather(self)
        return found


@runtime_checkable
class WithScene(Protocol):
    """A step with recorded data, whose instrument, site and time a pipeline file need not give."""

    def own_scene(self, given: Instrument | None) -> Mapping[str, Any]:
        """``site``, ``instrument`` and ``time`` of the data; what they do not state of the
        instrument is that of ``given``.

        Raises InputError where the data cannot be read, or do not state what a scene needs.
        """
        ...


def site_at(location: Any) -> Site:
    """The site at an astropy `EarthLocation`, with the climatology of a registered site that is
    nearer than `NEAR`.

    Raises PydanticCustomError for more than one place.
    """
    if not getattr(location, "isscalar", True):
        raise mistake(f"expected one place, got {location.size}")
    place = location.to_geodetic("WGS84")
    latitude = float(place.lat.rad)
    longitude = float(place.lon.rad)
    altitude = float(place.height.to_value("m"))
    name = str(
        getattr(getattr(location, "info", None), "name", None)
        or f"{place.lat.deg:.4f} deg {place.lon.deg:.4f} deg"
    )
    given: dict[str, Any] = {
        "name": name,
        "latitude": f"{latitude!r} rad",
        "longitude": f"{longitude!r} rad",
        "altitude": f"{altitude!r} m",
        "provenance": "astropy EarthLocation",
    }
    for known in sites:
        with suppress(ZondaError):
            other = sites.create(known)
            if (
                distance((latitude, longitude), other) < NEAR
                and abs(other.altitude - altitude) < HIGHER
            ):
                return Site(
                    **given, climatology=other.climatology, description=f"near {other.name}"
                )
    return Site(**given)


def distance(here: tuple[float, float], site: Site) -> float:
    """m along the ground between (latitude, longitude) [rad] and a site: Haversine formula on a
    sphere.
    """
    a = np.array(here)
    b = np.array([site.latitude, site.longitude])
    half = np.sin((a - b) / 2) ** 2
    return (
        2
        * EARTH
        * float(np.arcsin(np.sqrt(min(1.0, half[0] + np.cos(a[0]) * np.cos(b[0]) * half[1]))))
    )


def elsewhere(scene: Scene) -> str:
    """Warning about a telescope on another site than its own, or empty."""
    telescope = scene.instrument.telescope
    try:
        home = sites.create(telescope.site) if telescope.site else None
    except ZondaError:  # the site of a plugin that is not installed here
        home = None
    if home is None:
        return ""
    away = distance((home.latitude, home.longitude), scene.site)
    if away < NEAR:
        return ""
    return (
        f"{telescope.name} stands at {home.name}, {away / 1e3:.0f} km away: here it looks through"
        f" the atmosphere of {scene.site.name}; write 'site: {telescope.site}' for its own"
    )
