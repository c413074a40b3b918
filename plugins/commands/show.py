"""``zonda show instrument``: the bands, detectors and focal plane of an instrument, printed and
drawn.

Only click is imported with this module.
"""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zonda.core.cli import listing

from .arguments import draw, picture

if TYPE_CHECKING:
    from zonda.core.focalplane import Focalplane
    from zonda.core.instrument import Instrument
    from zonda.core.types import Floats

HEAD = ("band", "GHz", "detectors", "FWHM", "NET [mK_RJ sqrt(s)]", "knee [Hz]", "slope")
WIDTH = 100


@click.group()
def show() -> None:
    """Show an instrument: its bands, its detectors and a picture of its focal plane."""


@show.command()
@click.argument("name", shell_complete=listing.complete_instruments)
@picture("The picture.  [default: out/show/NAME.png]")
def instrument(name: str, output: Path | None) -> None:
    """Print what an instrument is, and draw its focal plane (also as PDF or SVG).

    NAME is a registered name (`zonda plugins`), or a YAML file that describes an instrument or a
    pipeline.
    """
    from zonda.core.plots import focal_plane_figure
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


def lines(instrument: Instrument, plane: Focalplane) -> list[str]:
    """Text of an instrument: its bands, the sources of its numbers, and which are stand-ins."""
    from zonda.core.numerics.sphere import angle_text
    from zonda.core.tables import aligned

    telescope = instrument.telescope
    rows = [
        (
            "telescope",
            f"{telescope.name}, {telescope.diameter:g} m"
            + (f", at {telescope.site}" if telescope.site else ""),
        ),
        ("field of view", angle_text(instrument.field_of_view)),
        ("detectors", _detectors(instrument, plane)),
        ("sample rate", f"{instrument.sample_rate:g} Hz"),
        (
            "efficiencies",
            (
                f"main beam {instrument.main_beam_efficiency:g}, illumination"
                f" {instrument.illumination_efficiency:g}"
            ),
        ),
    ]
    head = (
        f"{instrument.name}: {instrument.description}"
        if instrument.description
        else instrument.name
    )
    found = [
        head,
        "",
        *aligned(rows, gap=" "),
        "",
        *_bands(instrument, plane),
    ]
    sources, stand_ins = split_provenance(instrument)
    for title, texts in (("source", sources), ("stand-ins", stand_ins)):
        if texts:
            found.append("")
            wide = " " * (max(len(key) for key, _ in rows) - len(title))
            first, *others = _wrapped(texts)
            found += aligned([(title + wide, first), *(("", line) for line in others)], gap=" ")
    return found


def split_provenance(instrument: Instrument) -> tuple[list[str], list[str]]:
    """Split sources of the numbers of an instrument and its bands from stand-ins."""
    from zonda.core.instrument import STAND_IN

    bands = [
        (f"{name}: " if instrument.bands else "band: ", camera.band)
        for name, camera in instrument.cameras.items()
    ]
    parts = [part.strip() for part in instrument.provenance.split(";")]
    parts += [
        (STAND_IN if part.strip().startswith(STAND_IN) else "")
        + who
        + part.strip().removeprefix(STAND_IN)
        for who, band in bands
        for part in band.provenance.split(";")
    ]
    parts = [part for part in dict.fromkeys(parts) if part and not part.endswith(": ")]
    named = [part.removeprefix(STAND_IN) for part in parts if part.startswith(STAND_IN)]
    return [part for part in parts if not part.startswith(STAND_IN)], named


def _detectors(instrument: Instrument, plane: Focalplane) -> str:
    import numpy as np

    how = f"{instrument.layout} layout"
    if instrument.focalplane_table is not None:
        how = f"from {instrument.focalplane_table.name}"
    wafers = len(np.unique(plane.wafer))
    each = (
        " in each band"
        if instrument.bands
        and instrument.pixels != "shared"
        and instrument.focalplane_table is None
        else ""
    )
    said = [
        f"{len(plane)}",
        how,
        f"{wafers} wafers{each}" if wafers > 1 else "",
        "polarized" if plane.polarized else "not polarized",
    ]
    if len(instrument.bands) > 1 and instrument.focalplane_table is None:
        said.insert(2, f"pixels {instrument.pixels}")
    if dead := int(plane.dead.sum()):
        said.append(f"{dead} dead")
    return ", ".join(filter(None, said))


def _bands(instrument: Instrument, plane: Focalplane) -> list[str]:
    from zonda.core.tables import aligned

    table = []
    for k, (name, camera) in enumerate(instrument.cameras.items()):
        rows = plane.of_band(k) if instrument.bands else plane
        low, high = (edge / 1e9 for edge in camera.band.edges)
        table.append(
            (
                name,
                f"{low:.4g} to {high:.4g}",
                f"{len(rows)}",
                _angles(rows.fwhm),
                _span(rows.net * 1e3),
                _span(rows.knee),
                _span(rows.slope),
            )
        )
    return aligned(table, HEAD)


def _span(values: Floats) -> str:
    low, high = (f"{value:.3g}" for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def _angles(values: Floats) -> str:
    from zonda.core.numerics.sphere import angle_text

    low, high = (angle_text(float(value)) for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def _wrapped(texts: list[str]) -> list[str]:
    return [line for text in texts for line in textwrap.wrap(text, WIDTH, subsequent_indent="  ")]
