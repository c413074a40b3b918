"""``zonda weather``: the atmosphere above a site, printed and drawn; ``zonda weather fetch``: ERA5
from the Climate Data Store.

Only click is imported with this module; each command imports what it needs.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from zonda.core.cli import listing

from .arguments import checked, draw, instant_of, picture, place_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from zonda.core.configuration.time import Instant
    from zonda.core.instrument import Band
    from zonda.core.site import Site
    from zonda.operators.atmosphere.weather.climatology import PwvByMonth
    from zonda.operators.atmosphere.weather.profiles import Profile

HEIGHTS = (0.0, 250.0, 500.0, 1e3, 2e3, 3e3, 5e3, 8e3, 12e3, 20e3)
"""m above the site, in the table."""


class WithDefault(click.Group):
    """A group whose first command is meant where none is named: ``zonda weather green_bank``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put ``show`` before what names no command."""
        known = self.commands.keys() | (ctx.help_option_names if len(args) == 1 else ())
        if args and args[0] not in known:
            args = ["show", *args]
        return super().parse_args(ctx, args)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[Any]:
        """Sites beside the commands."""
        return [
            *super().shell_complete(ctx, incomplete),
            *listing.complete_sites(ctx, self.commands["show"].params[0], incomplete),
        ]


@click.group(cls=WithDefault, subcommand_metavar="SITE [OPTIONS] | fetch SITE [OPTIONS]")
def weather() -> None:
    """Show the atmosphere above a site: profile, PWV, and what instruments see; `fetch` gets ERA5.

    SITE is a registered name (`zonda plugins`), or 'latitude, longitude, altitude', e.g. '46.5 deg,
    8 deg, 3500 m'.
    """


SIGNS = {"ignore_unknown_options": True}
"""A southern latitude begins with a minus."""

_site = click.argument("site", metavar="SITE", shell_complete=listing.complete_sites)
_time = click.option(
    "--time",
    metavar="TIME",
    help="UTC unless it carries an offset, e.g. 2024-11-25T07:00.  [default: now]",
)


@weather.command(context_settings=SIGNS)
@_site
@_time
@click.option(
    "--instrument",
    "instruments",
    multiple=True,
    metavar="NAME",
    shell_complete=listing.complete_instruments,
    help="Whose bands to show; may be repeated.",
)
@click.option(
    "--pwv",
    metavar="PWV",
    help="Water: 1.2mm, 25%, or random.  [default: as the source has it]",
)
@click.option(
    "--file",
    metavar="FILE.nc",
    help="ERA5 file to take the weather from, instead of the climatology.",
)
@click.option(
    "--table",
    metavar="FILE.csv",
    help="Table to take the weather from, instead of the climatology.",
)
@click.option(
    "--elevation",
    default="90 deg",
    show_default=True,
    metavar="ANGLE",
    help="Of the line of sight.",
)
@click.option("--seed", default=0, show_default=True, help="Of a random PWV.")
@picture("The figure.  [default: out/weather/SITE.png]")
def show(
    site: str,
    time: str | None,
    instruments: tuple[str, ...],
    elevation: str,
    seed: int,
    output: Path | None,
    **source: str | None,
) -> None:
    """Print the profile, the PWV by month and hour, and what bands see; draw them (also as PDF or
    SVG).
    """
    from zonda.core import registry, weather
    from zonda.core.configuration.units import Unit
    from zonda.core.storage.files import product_path
    from zonda.operators.atmosphere.weather.climatology import pwv_by_month
    from zonda.operators.atmosphere.weather.radiative_transfer import ELEVATION_MAX, ELEVATION_MIN
    from zonda.operators.atmosphere.weather.sources import profile_of

    place = place_of(site)
    when = instant_of(time)
    given = {key: value for key, value in source.items() if value is not None}
    cls, values = weather.resolve(given)
    model = checked("weather", lambda: cls.model_validate(values))
    angle = checked("--elevation", lambda: Unit("rad", "60 deg").parse(elevation))
    if not ELEVATION_MIN <= angle <= ELEVATION_MAX:
        limits = f"{math.degrees(ELEVATION_MIN):g} deg to 90 deg"
        raise click.BadParameter(
            f"{elevation} is outside the limits, {limits}",
            param_hint="'--elevation'",
        )
    cameras = (
        camera
        for name in instruments
        for camera in registry.instruments.create(name).cameras.values()
    )
    bands = list(dict.fromkeys(camera.band for camera in cameras))
    air = profile_of(model, place, when, seed)
    parts = [place_lines(place, when, air), profile_lines(air)]
    water = None
    if place.climatology is not None:
        water = pwv_by_month(place, when.datetime.year)
        parts.append(pwv_lines(water))
    if bands:
        parts.append(band_lines(air, bands, angle))
    click.echo("\n\n".join("\n".join(lines) for lines in parts))

    from zonda.plugins.commands.weather_plots import weather_figure

    title = f"{place.name}, {when}, PWV {air.pwv * 1e3:.3g} mm"
    figure = weather_figure(title, air, water, angle, bands)
    draw(figure, output or product_path("out/weather", place.name, ".png"))


@weather.command(context_settings=SIGNS)
@_site
@_time
@click.option(
    "--hours",
    default=6,
    show_default=True,
    type=click.IntRange(1, 240),
    help="How many hours from TIME on.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    default=Path("era5.nc"),
    show_default=True,
    metavar="FILE.nc",
)
def fetch(site: str, time: str | None, hours: int, output: Path) -> None:
    """Get ERA5 for a site and time from the Climate Data Store, for `weather: {file: era5.nc}`.

    Needs a (free) key and the package cdsapi: pip install 'zonda[weather]', then
    https://cds.climate.copernicus.eu/how-to-api.
    """
    from zonda.core.storage.files import atomic_path
    from zonda.operators.atmosphere.weather.era5 import retrieve

    place = place_of(site)
    when = instant_of(time)
    with atomic_path(output) as temporary:
        retrieve(place, when, hours, temporary)
    click.echo(f"{output}")


def place_lines(site: Site, time: Instant, profile: Profile) -> list[str]:
    """Lines about place, time and source of the profile."""
    where = (
        f"{math.degrees(site.latitude):.4f} deg, {math.degrees(site.longitude):.4f} deg,"
        f" {site.altitude:g} m"
    )
    head = f"{site.name}: {site.description}" if site.description else site.name
    return [head, f"{where}; {time}", *(f"{what}: {text}" for what, text in profile.stated)]


def profile_lines(profile: Profile) -> list[str]:
    """A table of the profile; the wind is that which blows, coming from a direction."""
    import numpy as np

    from zonda.core.tables import aligned

    air = profile.at(HEIGHTS)
    columns = (
        ("above site", "m", ".0f", air.height),
        ("pressure", "hPa", ".1f", air.pressure / 100),
        ("temperature", "K", ".1f", air.temperature),
        ("vapour", "g/m3", ".3g", air.vapour_density * 1e3),
        ("wind", "m/s", ".1f", np.hypot(air.wind_east, air.wind_north)),
        ("from", "deg", ".0f", np.degrees(np.arctan2(-air.wind_east, -air.wind_north)) % 360),
    )
    heads, units, forms, values = zip(*columns, strict=True)
    rows = [
        [f"{x:{form}}" for x, form in zip(row, forms, strict=True)]
        for row in zip(*values, strict=True)
    ]
    return aligned([units, *rows], heads, ">", indent="  ")


def pwv_lines(water: PwvByMonth) -> list[str]:
    """A table of the PWV by month and hour."""
    from zonda.core.tables import aligned
    from zonda.operators.atmosphere.weather.climatology import HOURS, MONTHS, QUANTILES

    head = ("", *(f"{hour:02d}h" for hour in HOURS), "|", *(f"{100 * q:g} %" for q in QUANTILES))
    rows = [
        (month, *map(_short, medians), "|", *map(_short, quantiles))
        for month, medians, quantiles in zip(MONTHS, water.median, water.quantiles, strict=True)
    ]
    title = "PWV [mm]: median by hour (UTC), and quantiles of the month"
    return [title, *aligned(rows, head, "<>")]


def band_lines(profile: Profile, bands: Iterable[Band], elevation: float) -> list[str]:
    """Emission and transmission of bands at several PWVs and an elevation [rad]."""
    from zonda.core.tables import aligned
    from zonda.operators.atmosphere.weather.bands import BandAtmosphere
    from zonda.operators.atmosphere.weather.profiles import PWV_MAX, pwv_steps

    steps = pwv_steps(profile)
    at = f"at an elevation of {math.degrees(elevation):g} deg"
    lines = [f"{at}: emission of the atmosphere (background 0 K), transmission, opacity"]
    for band in bands:
        seen = BandAtmosphere(band, profile, min(max(*steps, 1e-4) * 1.01, PWV_MAX))
        low, high = (edge / 1e9 for edge in band.edges)
        lines.append(f"  {band.name} ({low:.6g} to {high:.6g} GHz)")
        rows = []
        for pwv in steps:
            passed = float(seen.transmission(pwv, elevation))
            rows.append(
                (
                    f"PWV {_short(pwv)} mm:",
                    f"{float(seen.emission(pwv, elevation)):.2f} K_RJ,",
                    f"{passed:{'.4f' if passed >= 1e-3 else '.1e'}},",
                    f"{float(seen.opacity(pwv, elevation)):.4g}",
                    "<" if pwv == profile.pwv else "",
                )
            )
        lines += aligned(rows, align=">", indent="    ")
    return lines


def _short(pwv: float) -> str:
    return f"{pwv * 1e3:.2f}" if pwv < 10e-3 else f"{pwv * 1e3:.1f}"
