"""``zonda when``: when a target is up tonight and through the year at a site, with the PWV to
expect, the Sun and the Moon.

Only click is imported with this module.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zonda.core.cli import listing

from .arguments import checked, draw, instant_of, place_of

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target
    from zonda.core.instrument import Band


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("target", nargs=-1, required=True, metavar="TARGET")
@click.option(
    "--site",
    metavar="SITE",
    shell_complete=listing.complete_sites,
    help="Registered name, or 'latitude, longitude, altitude'.  [required]",
)
@click.option(
    "--time",
    metavar="TIME",
    help="The night that is meant; UTC unless it carries an offset.  [default: now]",
)
@click.option(
    "--above",
    default="30 deg",
    show_default=True,
    metavar="ANGLE",
    help="Lowest elevation that is useful.",
)
@click.option(
    "--instrument",
    "instruments",
    multiple=True,
    metavar="NAME",
    shell_complete=listing.complete_instruments,
    help="Whose transmission to show; may be repeated.",
)
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print JSON; draw only where --output is given.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder of the figure.  [default: out/when]",
)
def when(
    target: tuple[str, ...],
    site: str | None,
    time: str | None,
    above: str,
    instruments: tuple[str, ...],
    as_json: bool,
    output: Path | None,
) -> None:
    """Show when a target is up tonight and through the year.

    TARGET is a position as in a pipeline file (17h20m -10d, 'galactic 120 deg -30 deg', 'az 180 deg
    el 60 deg'), or sun, moon, mercury, venus, mars, jupiter, saturn, uranus or neptune. Names of
    other objects are not looked up: nothing is downloaded.
    """
    from zonda.core import registry
    from zonda.core.configuration.units import Unit
    from zonda.core.storage.files import check_output_folder, product_path

    for part in target:
        if part.startswith("--"):
            raise click.NoSuchOption(
                part.partition("=")[0],
                possibilities=["--site"] if site is None else None,
            )
    if site is None:
        raise click.MissingParameter(param_hint="'--site'", param_type="option")
    name = " ".join(target)
    subject = target_of(name)
    place = place_of(site)
    moment = instant_of(time)
    limit = checked("--above", lambda: Unit("rad", "30 deg").parse(above))
    if not 0 <= limit < math.pi / 2:
        raise click.BadParameter(
            f"{above} is outside the limits, 0 deg to 90 deg",
            param_hint="'--above'",
        )
    if output is not None:
        check_output_folder(output)
    cameras = {text: registry.instruments.create(text).cameras for text in instruments}
    bands: dict[str, Band] = {
        text if len(of) == 1 else f"{text} {name}": camera.band
        for text, of in cameras.items()
        for name, camera in of.items()
    }

    from .visibility import Seen, as_dict, lines, months, night_of

    seen = Seen(name, place, moment, night_of(place, moment, subject, limit), bands)
    year = list(months(place, moment.datetime.year, subject, limit))
    if as_json:
        import json

        click.echo(json.dumps(as_dict(seen, year), indent=2))
    else:
        click.echo("\n".join(lines(seen, year)))
    if as_json and output is None:
        return
    from .weather_plots import when_figure

    path = product_path(output or "out/when", f"{name}_{place.name}", ".png")
    draw(when_figure(seen, year), path, err=as_json)


def target_of(text: str) -> Target | str:
    """A position, or the lower-case name of a body. Raises click.BadParameter for anything else."""
    from pydantic_core import PydanticCustomError

    from zonda.core.configuration.target import Target
    from zonda.core.numerics.bodies import BODIES

    if (body := text.strip().lower()) in BODIES:
        return body
    try:
        return Target.parse(text)
    except PydanticCustomError as err:
        message = err.message()
        if re.match(r"(?!(icrs|galactic|horizontal|ra|az|l)\b)[A-Za-z]", text, re.IGNORECASE):
            bodies = f"{', '.join(BODIES[:-1])} and {BODIES[-1]}"
            cure = "look its position up and write it, e.g. '13:47:30.6 -11:45:09'"
            message = (
                f"names of objects are not looked up, as zonda uses no network: {text!r} is not one"
                f" of {bodies}; {cure}"
            )
        raise click.BadParameter(message, param_hint="TARGET") from None
