"""Noise of single detectors as a table: what `zonda noise` writes, and `LoadTOD` and instruments
read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zonda.core.errors import InputError
from zonda.core.storage.files import reading
from zonda.core.types import Floats

UNITS = {"net": "K s(1/2)", "knee": "Hz", "slope": ""}
"""Columns and their SI units."""

CURE = "give a table that `zonda noise` wrote: ECSV with columns name, net, knee and slope"


@dataclass(frozen=True)
class NoiseTable:
    """NET [K_RJ sqrt(s)], knee [Hz] and slope by detector."""

    path: Path
    names: dict[str, int]
    columns: dict[str, Floats]

    def of(self, detectors: list[str], place: str) -> dict[str, Floats]:
        """The columns for these detectors. Raises InputError where one is not in the table."""
        if lacking := [name for name in detectors if name not in self.names]:
            text = (
                f"{len(lacking)} of {len(detectors)} detectors are not in {self.path}, e.g."
                f" {lacking[0]}"
            )
            cure = (
                "make the table of this file: zonda noise FILE; flag detectors that it finds no"
                " noise of"
            )
            raise InputError(text, place=place, cure=cure)
        rows = np.array([self.names[name] for name in detectors])
        return {name: values[rows] for name, values in self.columns.items()}


def read_noise(path: Path) -> NoiseTable:
    """Read a table. Raises InputError where it is none, lacks a column, or has a value that cannot
    be.
    """
    place = f"noise table {path}"
    with reading(place, "ECSV", CURE):
        import astropy.units as u
        from astropy.table import Table

        table = Table.read(path, format="ascii.ecsv")
        if lacking := [name for name in ("name", *UNITS) if name not in table.colnames]:
            raise InputError(f"has no column {lacking[0]}", place=place, cure=CURE)
        names = [str(name) for name in table["name"]]
        columns = {}
        for name, unit in UNITS.items():
            values = np.asarray(np.ma.filled(table[name], np.nan), np.float64)
            columns[name] = values * (
                u.Unit(table[name].unit).to(unit) if table[name].unit is not None and unit else 1.0
            )
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(
            f"detector {twice!r} is there twice", place=place, cure="leave one of the rows out"
        )
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values) | (values < 0))
        if bad.size and name == "net":
            cure = "leave the detector out of the pipeline's file, or give it a number"
            raise InputError(
                f"net of detector {names[bad[0]]} is {values[bad[0]]:g}", place=place, cure=cure
            )
        values[bad] = {"net": 0.0, "knee": 0.0, "slope": 1.0}[
            name
        ]  # a detector without 1/f noise has neither
    return NoiseTable(path, {name: row for row, name in enumerate(names)}, columns)
