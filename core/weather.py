"""The weather of a scene: where the state of the atmosphere comes from, and how much water vapour
it holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import ValidationInfo

from .configuration.diagnostics import TextValue, mistake, refusal
from .configuration.parameters import Parameters
from .configuration.units import Unit
from .errors import InputError, ZondaError
from .registry import weather_sources
from .types import Floats

if TYPE_CHECKING:
    from .configuration.time import Instant
    from .site import Site

PWV_MAX = 60e-3
"""m: more water vapour than any atmosphere on Earth holds above a telescope."""

SHORTHAND = {"file": "era5", "table": "table"}
"""Keys that name their source by themselves; where there is none, and no `source`, it is the
climatology.
"""


@dataclass(frozen=True)
class Pwv(TextValue):
    """Precipitable water vapour as a user gives it: a value, a quantile of what the place has at
    that season and hour, or a random draw from the same distribution.
    """

    json_schema: ClassVar[dict[str, Any]] = {
        "type": "string",
        "examples": ["1.2 mm", "25 %", "random"],
    }

    metres: float | None = None
    """Value, m."""
    quantile: float | None = None
    """Quantile, 0 to 1. Where both are None: random."""

    @classmethod
    def parse(cls, value: Any) -> Pwv:
        """From ``1.2 mm``, ``25 %``, ``random``, an astropy quantity, or a Pwv."""
        if isinstance(value, Pwv):
            return value
        text = value.strip() if isinstance(value, str) else ""
        if text.lower() == "random":
            return cls()
        if text.endswith("%"):
            quantile = Unit("").parse(text)
            if not 0 < quantile < 1:
                raise mistake(
                    f"a quantile of {text} is outside the limits, above 0 % and below 100 %"
                )
            return cls(quantile=quantile)
        metres = Unit("m").parse(value)
        if not 0 <= metres <= PWV_MAX:
            message = (
                f"a precipitable water vapour of {metres * 1e3:g} mm is outside the limits, 0 to"
                f" {PWV_MAX * 1e3:g} mm"
            )
            raise mistake(
                message,
                (
                    "more than any atmosphere on Earth holds"
                    if metres > 0
                    else "it cannot be negative"
                ),
            )
        return cls(metres=metres)

    def __str__(self) -> str:
        if self.metres is not None:
            return Unit("m").write(self.metres)
        return f"{self.quantile * 100:.12g} %" if self.quantile is not None else "random"


@dataclass(frozen=True)
class GroundWeather:
    """The weather at the telescope, as observatories log it.

    Attributes
    ----------
    time
        POSIX s that it belongs to.
    pwv
        m, of the column above the telescope at zenith.
    pressure, temperature, ground_temperature
        Pa on the ground; K, 10 m above the ground and on it.
    humidity
        Specific, kg of vapour per kg of moist air, 10 m above the ground.
    wind_east, wind_north
        Velocity of the air towards east and north, m/s, 10 m above the ground.
    """

    time: float
    pwv: float
    pressure: float
    temperature: float
    ground_temperature: float
    humidity: float
    wind_east: float
    wind_north: float


@dataclass(frozen=True)
class Column:
    """The atmosphere above a place on levels, from the lowest up: what a weather source delivers.

    Attributes
    ----------
    pressure, height, temperature, h2o
        (n,) Pa, m above sea level (geopotential), K, volume mixing ratio. Levels below the site are
        used to interpolate.
    wind_east, wind_north
        (n,) velocity of the air towards east and north, m/s.
    ozone_pressure, ozone
        (m,) Pa and volume mixing ratio; None: those of the US Standard Atmosphere.
    log_vapour_spread, wind_east_spread, wind_north_spread
        (n,) standard deviations of ln(vapour density) and of the winds [m/s] over the weather of
        that season and hour, where the source knows them: without them there is neither a quantile
        nor a random draw.
    column_spread
        Standard deviation of ln(PWV) below and above its median, as shares of what
        ``log_vapour_spread`` would give if all levels varied together; None: 0.77 both.
    ground_temperature
        K on the ground, where an inversion lies there that the levels do not resolve; None: as the
        levels have it.
    stated
        One line for the reports: where these levels come from.
    """

    pressure: Floats
    height: Floats
    temperature: Floats
    h2o: Floats
    wind_east: Floats
    wind_north: Floats
    ozone_pressure: Floats | None = None
    ozone: Floats | None = None
    log_vapour_spread: Floats | None = None
    wind_east_spread: Floats | None = None
    wind_north_spread: Floats | None = None
    column_spread: tuple[float, float] | None = None
    ground_temperature: float | None = None
    stated: str = ""


class WeatherSource(Parameters):
    """Base of weather sources. A third party subclasses it and names it in the entry-point group
    ``zonda.weather_sources``.
    """

    source: str = ""
    """Registered name of the source: `climatology`, `era5`, `table`, `standard`, or a plugin's."""
    pwv: Pwv | None = None
    """PWV at zenith: a value (1.2 mm), a quantile for the season and hour (25 %), or random; None:
    as the source has it.
    """
    wind: Literal["typical", "median", "random"] = "typical"
    """Of a source that knows the spread of the winds: the median speed along the median direction,
    the medians of the components (slower), or a draw with the scene's seed."""

    def column(self, site: Site, time: Instant) -> Column:
        """The atmosphere above ``site`` at ``time``.

        Raises
        ------
        InputError
            Where the source does not cover the place or the time, with a cure.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define column(site, time)")


def resolve(value: Any) -> tuple[type[WeatherSource], dict[str, Any]]:
    """The class that a name or a mapping stands for, and the mapping with its ``source`` filled in.

    Raises
    ------
    RegistryError
        A source that is not installed.
    InputError
        Neither a name nor a mapping, or two sources at once.
    """
    given = {"source": value} if isinstance(value, str) else value
    example = (
        "write for example weather: {pwv: 1.2 mm}, {pwv: 25 %}, {file: era5.nc} or {table:"
        " profile.csv}"
    )
    if not isinstance(given, dict):
        raise InputError(f"the weather is a mapping, not {value!r:.60}", cure=example)
    named = [key for key in SHORTHAND if key in given]
    if "source" not in given and len(named) > 1:
        raise InputError(
            f"{' and '.join(named)} are two sources of weather",
            cure=f"keep one; {example}",
        )
    if isinstance(value, str) and (value[:1].isdigit() or value.strip().lower() == "random"):
        raise InputError(
            f"'{value}' is no source of weather",
            cure=f"write weather: {{pwv: {value}}}; {example}",
        )
    name = str(given.get("source") or (SHORTHAND[named[0]] if named else "climatology"))
    return weather_sources.get(name), {**given, "source": name}


def weather_source(value: Any, info: ValidationInfo) -> Any:
    """A `WeatherSource` from its registered name, from a mapping, or as it is. Raises
    ValueError.
    """
    if value is None or isinstance(value, WeatherSource):
        return value
    try:
        source, given = resolve(value)
    except ZondaError as err:
        raise refusal(err) from None
    return source.model_validate(given, context=info.context)
