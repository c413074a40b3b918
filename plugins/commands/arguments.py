"""Arguments that several commands take: places, times and files of pictures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.site import Site


def place_of(text: str) -> Site:
    """A registered site, or one written as 'latitude, longitude, altitude'."""
    from zonda.core.registry import sites
    from zonda.core.site import Site

    if "," not in text:
        found: Site = sites.create(text)
        return found
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 3:
        raise click.BadParameter(
            "a place is 'latitude, longitude, altitude', e.g. '46.5 deg, 8 deg, 3500 m'",
            param_hint="SITE",
        )
    latitude, longitude, altitude = parts
    given = {"name": "place", "latitude": latitude, "longitude": longitude, "altitude": altitude}
    made: Site = checked("SITE", lambda: Site.model_validate(given))
    return made


def instant_of(text: str | None) -> Instant:
    """The time that ``--time`` gives; now where it is absent."""
    from datetime import UTC, datetime

    from zonda.core.configuration.time import Instant

    made: Instant = checked(
        "--time",
        lambda: Instant.parse(text or datetime.now(UTC).replace(second=0, microsecond=0)),
    )
    return made


def checked(what: str, make: Any) -> Any:
    """Result of ``make``; pydantic's refusals become mistakes of the command line."""
    from pydantic import ValidationError
    from pydantic_core import PydanticCustomError

    try:
        return make()
    except ValidationError as err:
        text = "; ".join(f"{'.'.join(map(str, e['loc']))}: {_fault(e)}" for e in err.errors())
        raise click.BadParameter(text, param_hint=what) from None
    except PydanticCustomError as err:
        raise click.BadParameter(err.message(), param_hint=what) from None


def picture(text: str) -> Any:
    """The option ``--output`` of a picture, PNG, PDF or SVG; ``text``: its help."""

    def check(_context: Any, _option: Any, path: Path | None) -> Path | None:
        if path is not None and path.suffix.lower() not in (".png", ".pdf", ".svg"):
            raise click.BadParameter(f"{path} does not end in .png, .pdf or .svg")
        return path

    kind = click.Path(path_type=Path)
    return click.option("--output", type=kind, callback=check, metavar="FILE.png", help=text)


def draw(figure: Any, path: Path, err: bool = False) -> None:
    """Write a figure, and print its path; ``err``: to stderr."""
    from zonda.core.storage.files import atomic_path

    with atomic_path(path) as temporary:
        figure.savefig(temporary)
    click.echo(f"\n{path}", err=err)


LIMITS = {"latitude": "-90 to 90 deg", "longitude": "-360 to 360 deg", "altitude": "-500 to 9000 m"}
"""Limits of the coordinates of a place, in the units of the command line."""


def _fault(error: Any) -> str:
    limits = (
        LIMITS.get(str(error["loc"][-1]))
        if error["type"].startswith(("less_than", "greater_than"))
        else None
    )
    if limits is None:
        return str(error["msg"])
    value = float(error["input"]) if limits.endswith(" m") else math.degrees(error["input"])
    return f"{value:g} {limits.split()[-1]} is outside the limits, {limits}"
