"""Focal planes from tables: where detectors look, and what each has of its own.

ECSV, or CSV whose first line names the columns, with units in brackets. A table has `name`, `xi`
and `eta`; what else it may have is in `QUANTITIES` and `TEXTS`. What it does not have holds as the
instrument or its band states it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .configuration.diagnostics import nearest
from .errors import InputError
from .focalplane import Focalplane
from .storage.table_mistakes import Mistakes
from .types import Floats

if TYPE_CHECKING:
    from .storage.ecsv import Table

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
POSITIVE = (
    "fwhm",
    "main_beam_efficiency",
    "illumination_efficiency",
    "slope",
    "pink_minimum_frequency",
)
LARGEST = {
    "polarization_efficiency": 1.0,
    "main_beam_efficiency": 1.0,
    "illumination_efficiency": 1.0,
    "slope": 3.0,
}
SIGNED = ("xi", "eta", "polarization_angle")
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
ANGLE, PLACE = ("polarization_angle",), ("xi", "eta")
NOT_READ: dict[str, tuple[tuple[str, ...], str]] = {
    "psd_net": (
        ("net",),
        (
            "write net: on the sky, after calibration, in K_RJ s(1/2) (TOAST's is of the CMB's"
            " temperature)"
        ),
    ),
    **dict.fromkeys(
        ("psi", "pol", "pol_x", "pol_y"), (ANGLE, "write polarization_angle, from eta towards xi")
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
    place
        The file, as messages call it.
    names, bands
        Of each detector; ``bands`` is empty where there is no such column.
    columns
        By name, (n,) SI: `QUANTITIES`, and ``wafer`` and ``dead`` as whole numbers.
    lines
        Line of the file of each; of the heading last.
    notes
        Which columns were read under another name, and which are not used.
    """

    place: str
    names: list[str]
    bands: list[str]
    columns: Mapping[str, NDArray[Any]]
    lines: Sequence[int]
    notes: Sequence[str] = ()

    @property
    def reach(self) -> float:
        """Largest distance of a detector from the boresight, tan(rad)."""
        return float(np.hypot(self.columns["xi"], self.columns["eta"]).max())

    def rows(self, band: str) -> NDArray[np.intp]:
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
        if several and not self.bands:
            cure = f"add it, with the name of a band in each row: {', '.join(counts)}"
            raise InputError(
                "has no column 'band', and the instrument has several", place=self.place, cure=cure
            )
        unknown = [k for k, band in enumerate(self.bands) if band not in counts]
        if unknown and (several or len(unknown) == len(self.names)):
            mistakes = Mistakes(self.place)
            for k in unknown:
                hint = nearest(self.bands[k], list(counts))
                cure = f"{hint + ' ' if hint else ''}the instrument has: {', '.join(counts)}"
                mistakes.add(
                    self.lines[k],
                    f"detector {self.names[k]} is of the unknown band {self.bands[k]!r}",
                    cure,
                )
            mistakes.tell()
        for band, stated in counts.items():
            found = len(self.rows(band))
            if not found:
                text = (
                    f"has no detector of the band {band}; its bands:"
                    f" {', '.join(sorted(set(self.bands)))}"
                )
                cure = f"give the band {band} a row or more, or leave it out of the instrument"
                raise InputError(text, place=self.place, cure=cure)
            if found != stated:
                of = f" of the band {band}" if self.bands else ""
                rest = (
                    f"; others are of {', '.join(sorted(set(self.bands) - set(counts)))}"
                    if unknown
                    else ""
                )
                text = f"detectors{of}: {found} rows, but the instrument states {stated}{rest}"
                raise InputError(
                    text, place=self.place, cure=f"leave out detectors, or write detectors: {found}"
                )


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
    from .storage.ecsv import read_table  # most runs read no table

    table = read_table(path)
    mistakes = Mistakes(table.place)
    table, notes = _by_known_names(table, mistakes)
    _check_columns(table, mistakes)
    names = table.texts("name") if "name" in table.columns else [""] * len(table)
    seen: dict[str, int] = {}
    for name, line in zip(names if "name" in table.columns else (), table.lines, strict=False):
        if not name or name in seen:
            text = f"name {name!r} is that of line {seen[name]} too" if name else "has no name"
            mistakes.add(line, text, "give each detector a name of its own")
        seen.setdefault(name, line)
    columns: dict[str, NDArray[Any]] = {}
    for key, unit in QUANTITIES.items():
        if key in table.columns:
            with mistakes.noted():
                columns[key] = table.numbers(key, unit)
            _check_limits(table, key, mistakes)
    if "polarization_angle" in columns:
        _check_angles(table, mistakes)
    if LEAKAGE in table.columns:
        _add_efficiency(table, columns, mistakes)
    if {"xi", "eta"} <= columns.keys():
        _check_distances(table, names, np.hypot(columns["xi"], columns["eta"]), mistakes)
    if "polarization_angle" in columns:
        columns.setdefault("polarization_efficiency", np.ones(len(names)))
    if "wafer" in table.columns:
        columns["wafer"] = _numbered(table.texts("wafer"))
    if "dead" in table.columns:
        columns["dead"] = _dead(table, mistakes)
    mistakes.tell()
    bands = table.texts("band") if "band" in table.columns else []
    known = (*TEXTS, *QUANTITIES, LEAKAGE)
    if unused := [name for name in table.columns if name not in known]:
        notes.append(f"not used: {', '.join(unused)}")
    return ArrayTable(table.place, names, bands, columns, table.lines, notes)


def _by_known_names(table: Table, mistakes: Mistakes) -> tuple[Table, list[str]]:
    """The table with our names for columns that others call otherwise (`ALIASES`), and notes of
    them.
    """
    columns, notes = dict[str, tuple[list[str], str]](), list[str]()
    there = {ALIASES.get(written.lower(), written) for written in table.columns}
    for written, column in table.columns.items():
        own = written if written in (*TEXTS, *QUANTITIES) else ALIASES.get(written.lower(), written)
        if own != written and (own in table.columns or own in columns):
            if own == "name":
                own = written  # of several names, one is enough
            else:
                mistakes.add(
                    table.lines[-1],
                    f"has {written!r} beside {own!r}",
                    "remove one of the two columns",
                )
                continue
        if own != written:
            notes.append(f"{written} is read as {own}")
        instead, cure = NOT_READ.get(own.lower(), ((), ""))
        if cure and not (instead and there.issuperset(instead)):
            mistakes.add(table.lines[-1], f"has a column {written!r}, which is not read", cure)
        columns[own] = column
    return replace(table, columns=columns), notes


def _check_angles(table: Table, mistakes: Mistakes) -> None:
    """Angles of polarization that are in another unit than written: turns and turns of rad, or
    degrees that are parts of pi.
    """
    values, unit = table.values("polarization_angle"), table.columns["polarization_angle"][1]
    size = np.abs(values[np.isfinite(values) & (values != 0)])
    cure = "see that the unit of the angles is right"
    if unit in ("rad", "radian") and size.size and size.max() > 4 * np.pi:
        mistakes.add(
            table.lines[-1],
            f"polarization_angle goes to {size.max():g} rad, more than two turns",
            cure,
        )
    parts = size / (np.pi / 24)
    if (
        unit in ("deg", "degree")
        and 0 < size.max(initial=0) < 6.3
        and (np.abs(parts - np.round(parts)) < 0.02).all()
    ):
        text = (
            f"polarization_angle has {', '.join(f'{v:g}' for v in np.unique(size)[:3])} deg: parts"
            " of pi, as in rad"
        )
        mistakes.add(table.lines[-1], text, cure)


def _add_efficiency(table: Table, columns: dict[str, NDArray[Any]], mistakes: Mistakes) -> None:
    """The efficiency that follows from TOAST's leakage, for detectors with an angle."""
    if "polarization_efficiency" in table.columns:
        mistakes.add(
            table.lines[-1],
            f"has {LEAKAGE!r} beside 'polarization_efficiency'",
            "remove one of the two columns",
        )
        return
    with mistakes.noted():
        leakage = table.numbers(LEAKAGE)
        for row in np.flatnonzero((leakage < 0) | (leakage > 1)).tolist():
            mistakes.add(
                table.lines[row], f"{LEAKAGE} is {table.texts(LEAKAGE)[row]}", "give 0 to 1"
            )
        if "polarization_angle" in columns:
            columns["polarization_efficiency"] = (1 - leakage) / (1 + leakage)


def _check_columns(table: Table, mistakes: Mistakes) -> None:
    """Check that the required columns are there and none is misspelt."""
    known = (*TEXTS, *QUANTITIES, LEAKAGE)
    misspelt = {
        c: hint
        for c in table.columns
        if c not in known
        and c.lower() not in NOT_READ
        and (hint := nearest(c, [k for k in known if k not in table.columns]))
    }
    for column, hint in misspelt.items():
        mistakes.add(table.lines[-1], f"has an unknown column {column!r}", hint)
    for name in ("name", "xi", "eta"):
        if name not in table.columns and not any(repr(name) in hint for hint in misspelt.values()):
            cure = f"a table of detectors has name, xi and eta; it has: {', '.join(table.columns)}"
            mistakes.add(table.lines[-1], f"has no column {name!r}", cure)


def _check_limits(table: Table, key: str, mistakes: Mistakes) -> None:
    """Check the limits of a column: those of a pure number, and zero, hold in every unit."""
    values = table.values(key)
    low = -np.inf if key in SIGNED else 0.0
    limits = "more than 0" if key in POSITIVE else "0 or more"
    limits += f", at most {LARGEST[key]:g}" if key in LARGEST else ""
    for row in np.flatnonzero(
        (values < low) | (values > LARGEST.get(key, np.inf)) | ((values == 0) & (key in POSITIVE))
    ).tolist():
        mistakes.add(table.lines[row], f"{key} is {table.texts(key)[row]}", f"give {limits}")


def _check_distances(table: Table, names: list[str], away: Floats, mistakes: Mistakes) -> None:
    for row in np.flatnonzero(away > FARTHEST).tolist():
        degrees, most = (math.degrees(math.atan(tangent)) for tangent in (away[row], FARTHEST))
        text = f"detector {names[row]} looks {degrees:.4g} deg away from the boresight"
        mistakes.add(
            table.lines[row],
            text,
            f"give xi and eta within {most:.4g} deg; see that their units are right",
        )


def _numbered(texts: list[str]) -> NDArray[np.int64]:
    """Whole numbers as they are; names by their place in the alphabet."""
    try:
        return np.array([int(text) for text in texts], np.int64)
    except ValueError:
        return np.unique(texts, return_inverse=True)[1].astype(np.int64).ravel()


def _dead(table: Table, mistakes: Mistakes) -> NDArray[np.int64]:
    texts = [text.lower() for text in table.texts("dead")]
    for text, line in zip(texts, table.lines, strict=False):
        if text not in DEAD:
            mistakes.add(line, f"dead is {text!r}", "write true or false")
    return np.array([DEAD.get(text, 0) for text in texts], np.int64)


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
            value, unit = float(np.median(table.columns[key][rows])), QUANTITIES[key]
            found[key] = f"{value!r} {unit}" if unit else value
    return {key: value for key, value in found.items() if stated.get(key) is None}
