"""``zonda show instrument``: the bands, detectors and focal plane of an instrument, printed and
drawn.

Only click is imported with this module.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from zonda.core.cli import complete

from .arguments import draw, picture

if TYPE_CHECKING:
    from zonda.core.instrument import Instrument


@click.group()
def show() -> None:
    """Show an instrument: its bands, its detectors and a picture of its focal plane."""


@show.command()
@click.argument("name", shell_complete=complete.instruments)
@picture("The picture.  [default: out/show/NAME.png]")
def instrument(name: str, output: Path | None) -> None:
    """Print what an instrument is, and draw its focal plane (also as PDF or SVG).

    NAME is a registered name (`zonda plugins`), or a YAML file that describes an instrument or a
    pipeline.
    """
    from zonda.core.plots import focal_plane_figure, lines
    from zonda.core.storage.files import product_path

    camera = _instrument(name)
    plane = camera.focalplane()
    click.echo("\n".join(lines(camera, plane)))
    draw(focal_plane_figure(camera, plane), output or product_path("out/show", camera.name, ".png"))


def _instrument(name: str) -> Instrument:
    from zonda.core.configuration.pipeline_file import load
    from zonda.core.discovery import is_yaml_file, names_in
    from zonda.core.registry import instruments

    if is_yaml_file(name) and "operators" in names_in(Path(name)):
        return load(name).scene().instrument
    found: Instrument = instruments.create(name)
    return found
