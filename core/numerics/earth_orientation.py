"""UT1-UTC and polar motion from the IERS tables that astropy installs with itself. Nothing is ever
downloaded.

The files are read here rather than through `astropy.utils.iers`, which takes a second of CPU and
may reach for the network.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..types import Floats

MEAN_POLE = (0.035, 0.29)
"""Polar motion where no table reaches [arcsec]: astropy's 50-year mean."""


class Orientation(NamedTuple):
    """Earth orientation at n instants."""

    ut1_utc: Floats
    """(n,) s."""
    x: Floats
    """(n,) polar motion, rad."""
    y: Floats
    """(n,) polar motion, rad."""
    source: str
    """Name and last day of the table, or the assumption that replaces it."""
    known: bool
    """False where the tables do not reach: then UT1 = UTC and the mean pole are assumed, as astropy
    does.
    """


def orientation(mjd: Floats) -> Orientation:
    """Linear interpolation (as astropy's) at UTC modified Julian dates (n,), all from one table."""
    first, last = int(np.floor(mjd.min())), int(np.floor(mjd.max())) + 1
    for name, read in (
        ("IERS C04", _c04),
        ("IERS finals2000A, the latest values of which are predictions", _finals),
    ):
        values = read(first, last)
        if values is not None:
            x, y, ut1_utc = _interpolate(mjd - first, values)
            return Orientation(ut1_utc, x, y, name, True)
    x, y = np.radians(np.array(MEAN_POLE) / 3600.0)[:, None] * np.ones_like(mjd)
    return Orientation(
        np.zeros_like(mjd),
        x,
        y,
        "none for this date: UT1 = UTC (within 0.9 s) and the mean pole assumed",
        False,
    )


def _interpolate(days: Floats, values: Floats) -> Floats:
    """(3, n): x, y [rad], UT1-UTC [s] at days since the first row; a leap second between two rows
    is no change of UT1.
    """
    lower = np.floor(days).astype(int)
    step = values[lower + 1] - values[lower]
    step[:, 2] -= np.round(step[:, 2])
    at = values[lower] + (days - lower)[:, None] * step
    at[:, :2] = np.radians(at[:, :2] / 3600.0)
    return np.ascontiguousarray(at.T)


def _c04(first: int, last: int) -> Floats | None:
    """Final values x ["], y ["], UT1-UTC [s] of the days ``first`` to ``last``, (last - first + 1,
    3): fields 4 to 7.
    """
    from astropy_iers_data import IERS_B_FILE  # type: ignore[import-untyped]

    return _rows(IERS_B_FILE, first, last, lambda line: line[16:62].split())


def _finals(first: int, last: int) -> Floats | None:
    """Table of fixed columns, as from `_c04`: Bulletin B where it is given, else Bulletin A, which
    ends in a year of predictions.
    """
    from astropy_iers_data import IERS_A_FILE

    def fields(line: bytes) -> list[bytes]:
        bulletin_a, bulletin_b = (
            (line[18:27], line[37:46], line[58:68]),
            (line[134:144], line[144:154], line[154:165]),
        )
        return [
            line[7:15],
            *(bulletin_b if all(part.strip() for part in bulletin_b) else bulletin_a),
        ]

    return _rows(IERS_A_FILE, first, last, fields)


def _rows(
    file: str,
    first: int,
    last: int,
    fields: Callable[[bytes], list[bytes]],
) -> Floats | None:
    """The rows of ``first`` to ``last`` of a file with one line per day, or None where it does not
    hold them all.
    """
    with open(file, "rb") as table:
        while (line := table.readline())[:1] == b"#":
            pass
        begin = table.tell() - len(line)
        even = (os.stat(file).st_size - begin) % max(len(line), 1) == 0
        try:
            offset = max(first - int(float(fields(line)[0])), 0)
            table.seek(
                begin + offset * len(line) if even else begin
            )  # lines of one length: 5 MB of days gone by are passed over
            lines = table.read((last - first + 1) * len(line) if even else -1).splitlines()
            found = [fields(line) for line in lines[0 if even else offset :][: last - first + 1]]
            rows = np.array(found, dtype="S").astype(float)
        except (IndexError, ValueError):  # blank columns: days to come
            return None
    if rows.ndim != 2 or not np.array_equal(rows[:, 0], np.arange(first, last + 1)):
        return None
    return np.ascontiguousarray(rows[:, 1:])
