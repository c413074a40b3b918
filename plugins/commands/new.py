"""``zonda new pipeline`` and ``zonda new plugin``: files to begin with. Only click is imported with
this module.
"""

from __future__ import annotations

import importlib.util
import keyword
import math
import re
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

import click

from zonda.core.cli import listing

from .arguments import checked

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target

TEMPLATES = Path(__file__).parent / "templates"
HOUR_ANGLES = (-1.5, 1.0, -0.5, -3.0, 0.0, 3.0, -5.0)
"""Hours from the meridian at which a new pipeline may begin to observe; the first at which the
telescope can.
"""
NIGHT = "2025-01-15"
"""Date of a new pipeline's observation."""
J2000 = 946728000.0
"""Seconds since 1970 of 2000-01-01T12:00."""
NORTH = "05h00m00s +20d00m00s"
SOUTH = "05h00m00s -30d00m00s"


@click.group()
def new() -> None:
    """Write files to begin with: a pipeline, or a plugin of your own."""


@new.command()
@click.argument("name", default="pipeline", metavar="[NAME]")
@click.option(
    "--instrument",
    default="mustang2",
    show_default=True,
    metavar="NAME",
    shell_complete=listing.complete_instruments,
)
@click.option(
    "--site",
    metavar="NAME",
    shell_complete=listing.complete_sites,
    help="[default: the telescope's own]",
)
@click.option(
    "--target",
    metavar="POSITION",
    help="E.g. '13h47m30s -11d45m' or 'galactic 120 deg -30 deg'.  [default: one that rises]",
)
def pipeline(name: str, instrument: str, site: str | None, target: str | None) -> None:
    """Write NAME.yaml, a pipeline file with comments, which `zonda check` accepts and `zonda run`
    runs.

    A file that is there is never replaced. The time is one at which the telescope can observe the
    target.
    """
    from zonda.core.errors import OutputError
    from zonda.core.storage.files import write_text

    path = Path(name if name.endswith((".yaml", ".yml")) else f"{name}.yaml")
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", path.stem):
        raise OutputError(
            f"{path.stem!r} cannot be the name of a pipeline",
            cure="use letters, digits, - and _",
        )
    _check_free(path)
    text = pipeline_text(path, instrument, site, target)
    write_text(path, text)
    click.echo(f"{path}")
    click.echo(f"zonda check {path}; zonda run {path}", err=True)


@new.command()
@click.argument("name")
def plugin(name: str) -> None:
    """Make the folder NAME: a plugin with an operator, an instrument and tests, which pass at once.

    Install it with `pip install -e ".[test]"` in that folder and run `pytest`. A folder that is
    there is never written to.
    """
    from zonda.core.errors import OutputError

    package = re.sub(r"[-.]", "_", name).lower()
    if (
        not re.fullmatch(r"[A-Za-z][A-Za-z0-9]*([-_.][A-Za-z0-9]+)*", name)
        or keyword.iskeyword(package)
        or package == "zonda"
    ):
        cure = "use letters, digits and hyphens, e.g. zonda-mycamera"
        raise OutputError(
            f"{name!r} cannot be the name of a plugin",
            place="zonda new plugin",
            cure=cure,
        )
    if importlib.util.find_spec(package):
        cure = f"choose another name, e.g. zonda-{name}"
        raise OutputError(
            f"a Python module {package!r} is installed already",
            place="zonda new plugin",
            cure=cure,
        )
    folder = Path(name)
    _check_free(folder)
    operator = "".join(word.capitalize() for word in package.split("_")) + "Drift"
    values = {"name": name, "package": package, "operator": operator}
    made = {}
    for template in sorted((TEMPLATES / "plugin").rglob("*.tmpl")):
        inside = str(template.relative_to(TEMPLATES / "plugin").with_suffix("")).replace(
            "package",
            package,
        )
        made[inside] = Template(template.read_text(encoding="utf-8")).substitute(values)
    _write_folder(folder, made)
    click.echo(f"{folder}/")
    click.echo(f'cd {folder}; pip install -e ".[test]"; pytest', err=True)


def _check_free(path: Path) -> None:
    from zonda.core.errors import OutputError

    if path.exists() or path.is_symlink():
        raise OutputError("exists already", place=str(path), cure="choose another name")
    if not path.parent.is_dir():
        raise OutputError(
            "there is no such folder",
            place=str(path.parent),
            cure="make it, or choose another",
        )


def _write_folder(folder: Path, texts: dict[str, str]) -> None:
    """Write all files to a temporary folder and rename it, so that none is there if one fails."""
    import os
    import shutil

    from zonda.core.storage.files import temporary_sibling, writing

    draft = temporary_sibling(folder)
    try:
        with writing(folder):
            for inside, text in texts.items():
                path = draft / inside
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
            os.rename(draft, folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def pipeline_text(path: Path, instrument: str, site: str | None, target: str | None) -> str:
    """The pipeline file. Raises ZondaError for names that are unknown, and where the telescope
    cannot observe the target.
    """
    import numpy as np

    from zonda.core.assembly.checks import run_checks
    from zonda.core.configuration.pipeline_file import parse
    from zonda.core.configuration.target import Target
    from zonda.core.errors import PointingError
    from zonda.core.registry import instruments, sites

    if target is not None:
        checked("--target", lambda: Target.parse(target))
    camera = instruments.create(instrument)
    site = site or camera.telescope.site or "chajnantor"
    where = sites.create(site)
    target = target or (NORTH if where.latitude > 0 else SOUTH)
    beam = float(np.degrees(camera.focalplane().fwhm.min())) * 3600
    pixel = float(f"{beam / 4:.1g}")
    values = {
        "file": path.name,
        "stem": path.stem,
        "site": site,
        "instrument": instrument,
        "target": target,
    }
    template = Template((TEMPLATES / "pipeline.yaml.tmpl").read_text(encoding="utf-8"))
    values |= {"pixel": f"{pixel:g} arcsec", "pwv": "25 %" if where.climatology else "2 mm"}
    drafted = parse(template.substitute(values, time=NIGHT), name=path.name).scene().target
    assert drafted is not None
    failed: PointingError | None = None
    for hours in HOUR_ANGLES:
        text = template.substitute(values, time=_start(drafted, where.longitude, hours))
        file = parse(text, name=path.name)
        try:
            run_checks(file.pipeline(), file.scene(), saved=False)
        except PointingError as err:
            failed = failed or err
            continue
        return text
    assert failed is not None
    raise failed


def _start(target: Target, longitude: float, hours: float) -> str:
    """When the target is ``hours`` from the meridian, to the minute; any time of a horizontal
    one.
    """
    from zonda.core.configuration.time import Instant

    if target.frame == "horizontal":
        return f"{NIGHT}T06:00"
    begin = Instant.parse(NIGHT)
    days = (begin.posix - J2000) / 86400
    sidereal = (
        18.697374558 + 24.06570982441908 * days + math.degrees(longitude) / 15
    )  # mean sidereal time, h (IAU 1982)
    wait = (math.degrees(target.icrs()[0]) / 15 + hours - sidereal) % 24 / 1.00273790935
    return begin.shifted(round(wait * 60) * 60.0).isoformat()[:16]
