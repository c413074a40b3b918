"""The built-in weather sources, one of them a table of the user's, and the profile of a scene, from
its source, site, time, PWV and seed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.numerics.random import normals, stream_key, uniforms
from zonda.core.scene import Scene
from zonda.core.site import Site
from zonda.core.storage import table_files
from zonda.core.types import AnyFloats, Floats
from zonda.core.weather import Column, GroundWeather, Pwv, WeatherSource

from .air import (
    DRY_AIR_GAS_CONSTANT,
    from_density,
    from_relative,
    from_specific,
    impossible,
    saturation_pressure,
    standard_column,
    wind_speed,
)
from .climatology import climatology_column
from .profiles import Profile, check_pwv, on_heights
from .radiative_transfer import VAPOUR_GAS_CONSTANT

HIGHEST = 8e3
"""m above sea level that a table must reach: nearly all water lies below."""
REQUIRED = {"height": "m", "pressure": "Pa", "temperature": "K"}
HUMIDITIES = {
    "relative humidity": "",
    "vapour density": "kg / m3",
    "specific humidity": "",
    "mixing ratio": "",
}
"""One of these: relative (mixed phase), density, specific, or mixing ratio (volume)."""
UNITS = REQUIRED | HUMIDITIES | {"wind east": "m / s", "wind north": "m / s", "ozone": ""}
"""Columns, and the units that they are converted to."""
CELSIUS = ("degC", "deg_C", "Celsius")
DRY_AIR = 0.011
"""Relative humidity that some level of any air has: less is a share that was called a percentage.
"""
PRESSURE_MIN = 1e-3
"""Pa: that of 95 km. Below, the share of water that a humidity gives is not a number one can work
with.
"""
CURE = "check the unit of the column"
SORT = "sort the rows from the ground up"


class Table(WeatherSource):
    """The user's own profile in a text table, one row per height; the same at any time."""

    source: Literal["table"] = "table"
    """Registered name."""
    table: InputPath
    """CSV with a header, e.g. `height [m], pressure [hPa], temperature [K], relative humidity [%]`;
    see docs/weather.md.
    """

    def column(self, site: Site, time: Instant) -> Column:
        """The column of a CSV table; ``#`` begins a comment.

        Heights are above sea level. Without winds there is a west wind of `air.wind_speed`.

        Raises
        ------
        InputError
            With the lines of all mistakes: an unknown, missing or doubled column, text that is no
            number, NaN, heights that do not increase, pressures that do not fall, what no air is, a
            table that ends below 8 km.
        """
        place = f"table {self.table}"
        table = table_files.read_table(self.table, place, names=())
        table.columns = {
            " ".join(name.lower().replace("_", " ").split()): column
            for name, column in table.columns.items()
        }
        for name in table.columns.keys() - UNITS.keys():
            table.note(-1, f"the column {name!r} is not known", f"columns: {', '.join(UNITS)}")
        kinds = [name for name in HUMIDITIES if name in table.columns]
        if len(kinds) != 1:
            table.note(-1, f"has {len(kinds)} humidities", f"give one: {', '.join(HUMIDITIES)}")
        winds = {"wind east", "wind north"} & table.columns.keys()
        if len(winds) == 1:
            table.note(-1, "has one component of the wind only", "give both or none")
        offset = 0.0
        if table.columns.get("temperature", ("", ""))[1] in CELSIUS:
            offset = 273.15
            table.columns["temperature"] = (table.columns["temperature"][0], "K")
        read = {
            name: table.numbers(name, unit)
            for name, unit in UNITS.items()
            if name in REQUIRED or name in table.columns
        }
        height = read["height"]
        pressure = read["pressure"]
        low = f"the pressure is below {PRESSURE_MIN:g} Pa"
        table.note_rows(np.diff(height, prepend=-np.inf) <= 0, "the height does not increase", SORT)
        table.note_rows(pressure < PRESSURE_MIN, low, "leave the row out: no air")
        falls = "the pressure does not fall with height"
        table.note_rows(np.diff(pressure, prepend=np.inf) >= 0, falls, CURE)
        table.check()
        temperature = read["temperature"] + offset
        humidity = read[kinds[0]]
        kind = kinds[0]
        calm = not winds
        wind = wind_speed(np.maximum(height - site.altitude, 0.0)), np.zeros_like(height)
        h2o = humidity
        if kind == "relative humidity":
            h2o = from_relative(humidity, pressure, temperature)
        elif kind == "vapour density":
            h2o = from_density(humidity, pressure, temperature)
        elif kind == "specific humidity":
            h2o = from_specific(humidity)
        found = Column(
            pressure=pressure,
            height=height,
            temperature=temperature,
            h2o=h2o,
            wind_east=wind[0] if calm else read["wind east"],
            wind_north=wind[1] if calm else read["wind north"],
            ozone_pressure=pressure if "ozone" in read else None,
            ozone=read.get("ozone"),
            stated=f"table {self.table.name}"
            + (" (without winds: a west wind of 8 to 38 m/s)" if calm else ""),
        )
        self._check(table, found, kind, humidity)
        return found

    @staticmethod
    def _check(table: table_files.Table, column: Column, kind: str, humidity: Floats) -> None:
        """Note levels that no air has."""
        height = column.height
        faults = list(impossible(column))
        if kind == "relative humidity":
            faults.append((humidity > 1.2, f"the {kind} is above 120 %"))
            if 0 < humidity.max() <= DRY_AIR:
                text = f"the {kind} is {humidity.max():.2g} at most, which no air has"
                table.note(-1, text, CURE)
        if column.ozone is not None:
            faults.append((column.ozone < 0, "the ozone is negative"))
        for wrong, text in faults:
            table.note_rows(wrong, f"{text}: no air has that", CURE)
        if len(height) < 5 or height[-1] < HIGHEST:
            text = f"has {len(height)} heights up to {height[-1]:g} m above sea level"
            cure = f"give at least 5, up to {HIGHEST:g} m: vapour and most of the oxygen lie below"
            table.note(None, text, cure)
        table.check()


class Climatology(WeatherSource):
    """The median atmosphere of the site's embedded climatology at that season and hour.

    A site without climatology has the US Standard Atmosphere, where its PWV is given.
    """

    source: Literal["climatology"] = "climatology"
    """Registered name."""

    def column(self, site: Site, time: Instant) -> Column:
        if site.climatology is None and self.pwv is not None and self.pwv.metres is not None:
            return standard_column(site)
        return climatology_column(site, time)

    @staticmethod
    def ground_weather(scene: Scene) -> GroundWeather:
        """Weather at the telescope at the start of a scene, whatever its source."""
        profile = profile_of(scene.weather, scene.site, scene.time, scene.seed)
        return on_the_ground(profile, scene.time)


class Standard(WeatherSource):
    """The US Standard Atmosphere 1976 with a west wind, whatever the place and season: give its
    PWV.
    """

    source: Literal["standard"] = "standard"
    """Registered name."""

    def column(self, site: Site, time: Instant) -> Column:
        if self.pwv is None or self.pwv.metres is None:
            raise InputError(
                "the standard atmosphere has no PWV of its own",
                place="weather",
                cure="give pwv, e.g. 3 mm",
            )
        return standard_column(site)


DRY = 1e-12
"""m: PWV that a profile of 0 mm is given, so that the vapour keeps its shape; it absorbs 1e-9 of
what a millimetre does.
"""


def profile_of(
    weather: WeatherSource | None,
    site: Site,
    time: Instant,
    seed: int,
    pwv: float | None = None,
) -> Profile:
    """The profile of a scene; its ``stated`` says what was used, and why.

    Parameters
    ----------
    weather
        The scene's; None: the climatology.
    seed
        The scene's: of random PWV and wind.
    pwv
        Of the operator, m: it scales the vapour where the scene gives no PWV.

    Raises
    ------
    InputError
        Two different PWVs, a quantile where the source knows no distribution, and what the source
        raises.
    """
    weather = Climatology() if weather is None else weather
    if pwv is not None:
        check_pwv(pwv)
        if weather.pwv is not None and weather.pwv.metres != pwv:
            raise InputError(
                f"the PWV is given twice: {pwv * 1e3:g} mm by the operator, {weather.pwv} by the"
                " scene's weather",
                place="weather",
                cure="remove pwv from AtmosphereLayers or from weather",
            )
        weather = weather.model_copy(update={"pwv": Pwv(metres=pwv)})
    profile, how = _scaled(on_heights(weather.column(site, time), site), weather, seed)
    profile, wind = _blown(profile, weather, seed)
    return replace(
        profile,
        stated=(*profile.stated, ("PWV", how), *_supersaturated(profile), ("wind", wind)),
    )


def on_the_ground(profile: Profile, time: Instant, wind: AnyFloats | None = None) -> GroundWeather:
    """Readings of instruments at the telescope; ``wind`` (east, north) [m/s] if it is not the
    profile's.
    """
    ground = profile.at(0.0)
    air = profile.at(10.0)
    vapour = float(air.vapour_density)
    temperature = float(air.temperature)
    dry = (float(air.pressure) - vapour * VAPOUR_GAS_CONSTANT * temperature) / (
        DRY_AIR_GAS_CONSTANT * temperature
    )
    east, north = (air.wind_east, air.wind_north) if wind is None else wind
    return GroundWeather(
        time=time.posix,
        pwv=profile.pwv,
        pressure=float(ground.pressure),
        temperature=temperature,
        ground_temperature=float(ground.temperature),
        humidity=vapour / (vapour + dry),
        wind_east=float(east),
        wind_north=float(north),
    )


def _supersaturated(profile: Profile) -> tuple[tuple[str, str], ...]:
    """The statement on a profile that is supersaturated: it is used as it is."""
    saturated = saturation_pressure(profile.temperature) / profile.pressure
    over = profile.h2o > saturated * (1 + 1e-9)
    if not over.any():
        return ()
    most = float((profile.h2o / saturated)[over].max())
    share = 1 - replace(profile, h2o=np.minimum(profile.h2o, saturated)).pwv / profile.pwv
    text = (
        f"at {np.count_nonzero(over)} of {len(over)} levels, up to {most:.0%}; {share:.2%} of the"
        " column is above saturation"
    )
    return (("relative humidity above 100 %", f"{text}; taken as it is"),)


def _scaled(profile: Profile, weather: WeatherSource, seed: int) -> tuple[Profile, str]:
    given = weather.pwv
    if given is None:
        return profile, f"{profile.pwv * 1e3:.4g} mm, as the source has it"
    if given.metres is not None:
        return profile.scaled(max(given.metres, DRY)), f"{given.metres * 1e3:.4g} mm, as given"
    law = profile.distribution
    if law is None:
        raise InputError(
            f"a PWV of '{given}' needs a distribution, and source '{weather.source}' has one state"
            " of the atmosphere only",
            place="weather",
            cure="give the PWV in mm, or leave it away to take the source's own",
        )
    quantile = given.quantile
    drawn = ""
    if quantile is None:
        quantile = float(uniforms(stream_key(seed, "weather", "pwv"), 0, 1)[0])
        drawn = " (drawn)"
    wanted = law.at(quantile)
    low = law.at(0.25) * 1e3
    high = law.at(0.75) * 1e3
    text = f"{wanted * 1e3:.4g} mm, the {100 * quantile:.4g} % quantile{drawn}"
    season = (
        f"of that season and hour: median {law.median * 1e3:.4g} mm, half the days between"
        f" {low:.3g} and {high:.3g} mm"
    )
    return profile.scaled(wanted), f"{text} {season}"


def _blown(profile: Profile, weather: WeatherSource, seed: int) -> tuple[Profile, str]:
    if profile.wind_east_spread is None or profile.wind_north_spread is None:
        return profile, "as the source has it"
    if weather.wind == "median":
        return profile, "medians of the components"
    if weather.wind == "typical":
        return profile.typical_wind, "median speed along the median direction"
    z = [float(x) for x in normals(stream_key(seed, "weather", "wind"), 0, 2)]
    east = profile.wind_east + z[0] * profile.wind_east_spread
    north = profile.wind_north + z[1] * profile.wind_north_spread
    return (
        replace(profile, wind_east=east, wind_north=north),
        f"drawn: medians {z[0]:+.2f}, {z[1]:+.2f} spreads (east, north)",
    )
