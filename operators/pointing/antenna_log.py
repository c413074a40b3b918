"""Antenna logs of the ASTE telescope, as DESHIMA's observations have them (``.ant``): text, one row
every 0.1 s.

A line of names begins with ``#time``; rows have the UTC time (``20171113070543.1``), 17 numbers in
degrees and millimetres and what the telescope did. The beam is where the programme without the
pointing model's corrections wanted it, plus the error of tracking (as DESHIMA's own package demerge
takes it):

    azimuth = az-prog(no-cor) + az-real - az-prg,      the same for the elevation.          (1)
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from zonda.core import flags
from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.types import Floats

BEGINS = b"#time ra-"
"""How a log begins."""

AZ_PRG, EL_PRG, AZ_REAL, EL_REAL, AZ_NO_COR, EL_NO_COR, COLUMNS = 2, 3, 4, 5, 13, 14, 17
"""Places of the columns behind the time; how many there are."""

NAMES = {
    AZ_PRG: "az-prg",
    EL_PRG: "el-prg",
    AZ_REAL: "az-real",
    EL_REAL: "el-real",
    AZ_NO_COR: "az-prg(no-cor)",
    EL_NO_COR: "el-prg(no-cor)",
}
"""What a log calls the columns that are read; it also writes `prog` for `prg`."""

TYPES = {"SCAN": 0, "ON": 0, "ACC": flags.TURNAROUND, "TRAN": flags.TURNAROUND}
"""What the telescope did, and the flags of such a row; of others: `flags.IRREGULAR` (slews,
off-source positions).
"""

END = "END"
"""The last row, which is no measurement."""

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def read_log(path: Path, place: str) -> tuple[Instant, Floats, Floats, Floats, flags.Flags]:
    """Start, seconds since then, azimuth and elevation [rad], bits of `core.flags`, each (n,).

    Raises InputError for a row that is none, and where there is no row.
    """
    moments, numbers, bits = [], [], []
    with path.open(encoding="ascii", errors="replace") as file:
        for line, text in enumerate(file, 1):
            words = text.split()
            if words[:1] == ["#time"]:
                _check_names(words[1:], place)
            if not words or words[0].startswith("#") or words[-1] == END:
                continue
            try:
                moment = datetime.strptime(words[0], "%Y%m%d%H%M%S.%f").replace(tzinfo=UTC)
                values = [float(word) for word in words[1:-1]]
            except ValueError as err:
                cure = "leave the row out, or copy the log again"
                raise InputError(
                    f"line {line} is no row of an antenna log: {err}", place=place, cure=cure
                ) from None
            if len(values) != COLUMNS:
                text = f"line {line} has {len(values)} numbers between time and type, not {COLUMNS}"
                raise InputError(
                    text,
                    place=place,
                    cure="is the log complete? copy it again, or leave the row out",
                )
            moments.append((moment - EPOCH) / timedelta(microseconds=1))
            numbers.append(values)
            bits.append(TYPES.get(words[-1], flags.IRREGULAR))
    if not numbers:
        raise InputError(
            "has no row of a scan", place=place, cure="give the log of another observation"
        )
    table = np.radians(np.array(numbers))
    first = round(moments[0])
    azimuth = table[:, AZ_NO_COR] + _difference(table[:, AZ_REAL], table[:, AZ_PRG])
    elevation = table[:, EL_NO_COR] + table[:, EL_REAL] - table[:, EL_PRG]
    return (
        Instant(first * 1000),
        (np.array(moments) - first) * 1e-6,
        azimuth,
        elevation,
        np.array(bits, np.uint8),
    )


def _check_names(names: list[str], place: str) -> None:
    for at, name in NAMES.items():
        found = names[at].replace("prog", "prg") if at < len(names) else "nothing"
        if found != name:
            raise InputError(
                f"column {at + 2} of the antenna log is {found}, where {name} is read",
                place=place,
                cure=(
                    "give a log with the columns of ASTE, or a table of time, azimuth and elevation"
                ),
            )


def _difference(a: Floats, b: Floats) -> Floats:
    """a - b [rad], within half a turn."""
    return np.asarray((a - b + np.pi) % (2 * np.pi) - np.pi)
