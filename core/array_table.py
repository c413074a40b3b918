"""Focal planes from tables: where detectors look, and what each has of its own.

ECSV, FITS, VOTable, IPAC, or CSV whose first line names the columns, with units in brackets. A
table has `name`, `xi` and `eta`; what else it may have is in `QUANTITIES` and `TEXTS`. What it does
not have holds as the instrument or its band states it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .configuration.diagnostics import nearest
from .errors import InputError
from .focalplane import Focalplane
from .storage.table_files import Table
from .types import Bools, Floats, Indices, Integers

QUANTITIES = {
    "xi": "rad",
    "eta": "rad",
    "polarization_angle": "rad",
    "polarization_efficiency": "",
    "fwhm": "rad",
    "main_beam_efficiency": "",
    "illumination_efficiency": "",
    "net": "K s(1/2)",
    "knee": "Hz",
    "slope": "",
    "pink_minimum_frequency": "Hz",
}
"""Columns of numbers and their units inside."""
TEXTS = ("name", "band", "wafer", "dead")
"""Columns of text."""
POSITIVE = {
    "fwhm",
    "main_beam_efficiency",
    "illumination_efficiency",
    "slope",
    "pink_minimum_frequency",
}
LARGEST = {
    "polarization_efficiency": 1.0,
    "main_beam_efficiency": 1.0,
    "illumination_efficiency": 1.0,
    "slope": 3.0,
}
SIGNED = {"xi", "eta", "polarization_angle"}
FARTHEST = math.tan(0.5)
"""Largest distance of a detector from the boresight, tan(rad): half the largest field of view of an
`Instrument`.
"""
DEAD = {"true": 1, "yes": 1, "1": 1, "false": 0, "no": 0, "0": 0, "": 0}
"""Values of the column `dead`."""
ALIASES = {
    **dict.fromkeys(
        ("gamma", "pol_angle", "pol_ang", "polangle", "psi_pol", "polarization"),
        "polarization_angle",
    ),
    **dict.fromkeys(("pol_eff", "pol_efficiency", "poleff"), "polarization_efficiency"),
    **dict.fromkeys(("psd_fknee", "fknee", "f_knee"), "knee"),
    **dict.fromkeys(("psd_alpha", "alpha"), "slope"),
    **dict.fromkeys(("psd_fmin", "fmin", "f_min"), "pink_minimum_frequency"),
    "beam_fwhm": "fwhm",
    **dict.fromkeys(("det", "detector", "det_id", "det_name", "detector_name"), "name"),
}
"""Names of columns in sotodlib, so3g and TOAST: their gamma runs from eta towards xi, as
`Focalplane.polarization_angle` does.
"""
LEAKAGE = "pol_leakage"
"""TOAST's cross-polar leakage e, in place of the efficiency (1 - e) / (1 + e)."""
KNOWN = (*TEXTS, *QUANTITIES, LEAKAGE)
"""Columns that are read."""
ANGLE = ("polarization_angle",)
PLACE = ("xi", "eta")
NOT_READ: dict[str, tuple[tuple[str, ...], str]] = {
    "psd_net": (
        ("net",),
        (
            "write net: on the sky, after calibration, in K_RJ s(1/2) (TOAST's is of the CMB's"
            " temperature)"
        ),
    ),
    **dict.fromkeys(
        ("psi", "pol", "pol_x", "pol_y"),
        (ANGLE, "write polarization_angle, from eta towards xi"),
    ),
    **dict.fromkeys(("theta", "phi"), (PLACE, "write xi and eta")),
    "quat": (PLACE + ANGLE, "write xi, eta and polarization_angle"),
    "x": (("xi",), "write xi"),
    "y": (("eta",), "write eta"),
    "nep": (("net",), "write net"),
    "tau": ((), "remove it, and give the step of the time constant a value"),
}
"""Columns that say where detectors look, or how well, in ways that are not read. Of each the
columns of ours beside which it is not needed (none: it is always refused), and the cure."""
OF_INSTRUMENT = (
    "fwhm",
    "main_beam_efficiency",
    "illumination_efficiency",
    "net",
    "knee",
    "slope",
    "pink_minimum_frequency",
)
"""Columns of what an instrument or a band states for all of its detectors."""


@dataclass(frozen=True)
class ArrayTable:
    """A table of detectors that was read.

    Attributes
    ----------
    table
        The file.
    names, bands
        Of each detector; ``bands`` is empty where there is no such column.
    columns
        By name, (n,) SI: `QUANTITIES`, and ``wafer`` and ``dead`` as whole numbers.
    notes
        Which columns were read under another name, and which are not used.
    """

    table: Table
    names: Sequence[str]
    bands: Sequence[str]
    columns: Mapping[str, NDArray[Any]]
    notes: Sequence[str] = ()

    @property
    def reach(self) -> float:
        """Largest distance of a detector from the boresight, tan(rad)."""
        return float(np.hypot(self.columns["xi"], self.columns["eta"]).max())

    def rows(self, band: str) -> Indices:
        """Rows of a band; all rows if the table has no column for it."""
        if not self.bands:
            return np.arange(len(self.names))
        return np.flatnonzero(np.array(self.bands) == band)

    def plane(self, band: str, otherwise: Mapping[str, float]) -> Focalplane:
        """The detectors of a band, in the order of the table; ``otherwise``: `OF_INSTRUMENT` where
        there is no column.
        """
        rows = self.rows(band)
        found = {key: np.full(len(rows), value) for key, value in otherwise.items()}
        found |= {key: values[rows] for key, values in self.columns.items()}
        found["minimum_frequency"] = found.pop("pink_minimum_frequency")
        return Focalplane([self.names[row] for row in rows], **found)

    def check(self, counts: Mapping[str, int], several: bool) -> None:
        """Refuse a table that does not suit the bands of an instrument with ``counts`` of detectors
        (InputError).

        A camera of one band may be one of several that the table has.
        """
        table = self.table
        has = f"the instrument has: {', '.join(counts)}"
        if several and not self.bands:
            cure = f"add it, with the name of a band in each row: {', '.join(counts)}"
            table.note(None, "has no column 'band', and the instrument has several", cure)
            table.check()
        unknown = [k for k, band in enumerate(self.bands) if band not in counts]
        if several or len(unknown) == len(self.names):
            for k in unknown:
                text = f"detector {self.names[k]} is of the unknown band {self.bands[k]!r}"
                table.note(k, text, f"{nearest(self.bands[k], list(counts))} {has}".strip())
            table.check()
        bands = sorted(set(self.bands))
        for band, stated in counts.items():
            found = len(self.rows(band))
            text = f"has no detector of the band {band}; its bands: {', '.join(bands)}"
            cure = f"give the band {band} a row or more, or leave it out of the instrument"
            if found and found != stated:
                of = f" of the band {band}" if self.bands else ""
                rest = f"; others are of {', '.join(b for b in bands if b not in counts)}"
                text = f"detectors{of}: {found} rows, but the instrument states {stated}"
                text += rest if unknown else ""
                cure = f"leave out detectors, or write detectors: {found}"
            if found != stated or not found:
                table.note(None, text, cure)
                table.check()


def read_array(path: Path) -> ArrayTable:
    """Read a table of detectors.

    Raises InputError, of all mistakes at once, for missing columns, names that are there twice,
    values that are not finite or out of their limits, unknown units, and columns that are misspelt.
    """
    try:
        state = path.stat()
    except OSError:
        raise InputError("no such file", place=str(path), cure="check the path") from None
    return _read(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=4)
def _read(path: Path, changed: int, size: int) -> ArrayTable:
    from .detector_files import read_detectors  # most runs read no table
    from .storage.table_files import read_table

    table, notes = read_detectors(path) or (read_table(path), [])
    notes += _rename(table)
    _check_columns(table)
    names = table.texts("name") if "name" in table.columns else []
    seen: dict[str, int] = {}
    for row, name in enumerate(names):
        if not name or name in seen:
            text = f"name {name!r} is that of line {seen[name]} too" if name else "has no name"
            table.note(row, text, "give each detector a name of its own")
        seen.setdefault(name, table.lines[row])
    columns: dict[str, NDArray[Any]] = {}
    for key, unit in QUANTITIES.items():
        if key in table.columns:
            columns[key] = table.numbers(key, unit)
            _check_limits(table, key)
    if "polarization_angle" in columns:
        _check_angles(table)
        columns.setdefault("polarization_efficiency", np.ones(len(table)))
    if LEAKAGE in table.columns:
        if "polarization_efficiency" in table.columns:
            text = f"has {LEAKAGE!r} beside 'polarization_efficiency'"
            table.note(-1, text, "remove one of the two columns")
        leakage = table.numbers(LEAKAGE)
        _note_values(table, LEAKAGE, (leakage < 0) | (leakage > 1), "give 0 to 1")
        if "polarization_angle" in columns:
            columns["polarization_efficiency"] = (1 - leakage) / (1 + leakage)
    if names and {"xi", "eta"} <= columns.keys():
        _check_distances(table, names, np.hypot(columns["xi"], columns["eta"]))
    if "wafer" in table.columns:
        columns["wafer"] = _numbered(table.texts("wafer"))
    if "dead" in table.columns:
        dead = [text.lower() for text in table.texts("dead")]
        wrong = np.array([text not in DEAD for text in dead])
        table.note_rows(wrong, lambda row: f"dead is {dead[row]!r}", "write true or false")
        columns["dead"] = np.array([DEAD.get(text, 0) for text in dead], np.int64)
    table.check()
    bands = table.texts("band") if "band" in table.columns else []
    if unused := [name for name in table.columns if name not in KNOWN]:
        notes.append(f"not used: {', '.join(unused)}")
    return ArrayTable(table, names, bands, columns, notes)


def _rename(table: Table) -> list[str]:
    """Give columns that others call otherwise (`ALIASES`) our names; notes of them."""
    columns = dict[str, tuple[Sequence[str], str]]()
    notes = list[str]()
    there = {ALIASES.get(written.lower(), written.lower()) for written in table.columns}
    for written, column in table.columns.items():
        plain = written.lower()
        own = plain if plain in KNOWN and plain not in table.columns else written
        own = written if written in KNOWN else ALIASES.get(plain, own)
        if own != written and (own in table.columns or own in columns):
            if own == "name":
                own = written  # of several names, one is enough
            else:
                text = f"has {written!r} beside {own!r}"
                table.note(-1, text, "remove one of the two columns")
                continue
        if own != written:
            notes.append(f"{written} is read as {own}")
        instead, cure = NOT_READ.get(own.lower(), ((), ""))
        if cure and not (instead and there.issuperset(instead)):
            table.note(-1, f"has a column {written!r}, which is not read", cure)
        columns[own] = column
    table.columns = columns
    return notes


def _check_angles(table: Table) -> None:
    """Angles of polarization that are in another unit than written: turns and turns of rad, or
    degrees that are parts of pi.
    """
    values = table.values("polarization_angle")
    unit = table.columns["polarization_angle"][1]
    size = np.abs(values[np.isfinite(values) & (values != 0)])
    largest = size.max(initial=0)
    parts = size / (np.pi / 24)
    text = ""
    if unit in ("rad", "radian") and largest > 4 * np.pi:
        text = f"polarization_angle goes to {largest:g} rad, more than two turns"
    near = (np.abs(parts - np.round(parts)) < 0.02).all()
    if unit in ("deg", "degree") and 0 < largest < 6.3 and near:
        some = ", ".join(f"{v:g}" for v in np.unique(size)[:3])
        text = f"polarization_angle has {some} deg: parts of pi, as in rad"
    if text:
        table.note(-1, text, "see that the unit of the angles is right")


def _check_columns(table: Table) -> None:
    """Check that the required columns are there and none is misspelt."""
    lacking = [key for key in KNOWN if key not in table.columns]
    hints = {
        column: nearest(column, lacking)
        for column in table.columns
        if column not in KNOWN and column.lower() not in NOT_READ
    }
    for column, hint in hints.items():
        if hint:
            table.note(-1, f"has an unknown column {column!r}", hint)
    for name in ("name", "xi", "eta"):
        if name in lacking and not any(repr(name) in hint for hint in hints.values()):
            cure = f"a table of detectors has name, xi and eta; it has: {', '.join(table.columns)}"
            table.note(-1, f"has no column {name!r}", cure)


def _check_limits(table: Table, key: str) -> None:
    """Check the limits of a column: those of a pure number, and zero, hold in every unit."""
    values = table.values(key)
    most = LARGEST.get(key, np.inf)
    low = -np.inf if key in SIGNED else 0.0
    limits = "more than 0" if key in POSITIVE else "0 or more"
    limits += f", at most {most:g}" if key in LARGEST else ""
    wrong = (values < low) | (values > most) | ((values == 0) & (key in POSITIVE))
    _note_values(table, key, wrong, f"give {limits}")


def _note_values(table: Table, key: str, wrong: Bools, cure: str) -> None:
    table.note_rows(wrong, lambda row: f"{key} is {table.texts(key)[row]}", cure)


def _check_distances(table: Table, names: Sequence[str], away: Floats) -> None:
    degrees, most = np.degrees(np.arctan(away)), math.degrees(math.atan(FARTHEST))
    table.note_rows(
        away > FARTHEST,
        lambda row: f"detector {names[row]} looks {degrees[row]:.4g} deg away from the boresight",
        f"give xi and eta within {most:.4g} deg; see that their units are right",
    )


def _numbered(texts: Sequence[str]) -> Integers:
    """Whole numbers as they are; names by their place in the alphabet."""
    try:
        return np.array([int(text) for text in texts], np.int64)
    except ValueError:
        return np.unique(texts, return_inverse=True)[1].astype(np.int64).ravel()


def stated_by(table: ArrayTable, band: str, stated: Mapping[str, Any]) -> dict[str, Any]:
    """Configuration of a band from the table, for keys that ``stated`` lacks: number of detectors,
    and medians of columns.

    Of all detectors where the table has none of this band, which `ArrayTable.check` refuses.
    """
    rows = table.rows(band)
    rows = rows if len(rows) else np.arange(len(table.names))
    found: dict[str, Any] = {"detectors": len(rows)}
    for key in OF_INSTRUMENT:
        if key in table.columns:
            value = float(np.median(table.columns[key][rows]))
            unit = QUANTITIES[key]
            found[key] = f"{value!r} {unit}" if unit else value
    return {key: value for key, value in found.items() if stated.get(key) is None}
