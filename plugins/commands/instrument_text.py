"""Text that ``zonda show instrument`` prints."""

from __future__ import annotations

import textwrap

import numpy as np

from zonda.core.focalplane import Focalplane
from zonda.core.instrument import Instrument
from zonda.core.numerics.angles import angle_text
from zonda.core.tables import aligned
from zonda.core.types import Floats

STAND_IN = "stand-in: "
"""What begins a part of `provenance` (parts end with a semicolon) that says which number is not
published.
"""
HEAD = ("band", "GHz", "detectors", "FWHM", "NET [mK_RJ sqrt(s)]", "knee [Hz]", "slope")
WIDTH = 100


def lines(instrument: Instrument, plane: Focalplane) -> list[str]:
    """The instrument, its bands, where its numbers come from and which are stand-ins."""
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
    table = []
    for k, (name, camera) in enumerate(instrument.cameras.items()):
        rows = plane.of_band(k) if instrument.bands else plane
        nu = camera.band.frequency / 1e9
        table.append(
            (
                name,
                f"{nu[0]:.4g} to {nu[-1]:.4g}",
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
    low, high = (angle_text(float(value)) for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def _wrapped(texts: list[str]) -> list[str]:
    return [line for text in texts for line in textwrap.wrap(text, WIDTH, subsequent_indent="  ")]
