"""``zonda weather``: the atmosphere above a site, printed and drawn; ``zonda weather fetch``: ERA5
from the Climate Data Store.

Only click is imported with this module; each command imports what it needs.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from zonda.core.cli import listing

from .arguments import checked, draw, instant_of, picture, place_of


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
    from zonda.operators.atmosphere.weather import summary
    from zonda.operators.atmosphere.weather.radiative_transfer import ELEVATION_MAX, ELEVATION_MIN
    from zonda.operators.atmosphere.weather.sources import profile_of

    place, when = place_of(site), instant_of(time)
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
    parts, water = [summary.place_lines(place, when, air), summary.profile_lines(air)], None
    if place.climatology is not None:
        water = summary.pwv_by_month(place, when.datetime.year)
        parts.append(summary.pwv_lines(water))
    if bands:
        parts.append(summary.band_lines(air, bands, angle))
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

    place, when = place_of(site), instant_of(time)
    with atomic_path(output) as temporary:
        retrieve(place, when, hours, temporary)
    click.echo(f"{output}")
