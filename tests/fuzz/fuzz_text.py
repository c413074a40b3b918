"""Tables of any bytes: profiles of the air, passbands, catalogues, focal planes, recorded pointing
and antenna logs, schedules, spectra, noise and stored fronts. Inputs begin with one byte that says
which.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from engine import ROOT, fuzz, guided_by, scratch, told

with guided_by(
    "zonda.operators.atmosphere.weather.sources",
    "zonda.operators.pointing.recording_files",
    "zonda.operators.pointing.schedule",
    "zonda.operators.sky.point_sources",
    "zonda.operators.sky.cmb",
    "zonda.core.array_table",
    "zonda.core.band",
    "zonda.core.storage.table_files",
    "zonda.core.accuracy.fronts",
):
    import numpy as np

    from zonda.core.accuracy.fronts import read
    from zonda.core.array_table import read_array
    from zonda.core.configuration.time import Instant
    from zonda.core.detector_files import read_noise
    from zonda.core.errors import ZondaError
    from zonda.core.instrument import Band
    from zonda.core.site import Site
    from zonda.operators.atmosphere.weather.sources import Table
    from zonda.operators.pointing.recording_files import read_recording
    from zonda.operators.pointing.schedule import read_schedule
    from zonda.operators.sky.cmb import read as read_spectrum
    from zonda.operators.sky.point_sources import Catalogue, PointSources

FILE = scratch(".txt")
SITE = Site(name="here", latitude="40.6 deg", longitude="10.1 deg", altitude="500 m")


def finite(*values: Any) -> None:
    assert all(np.isfinite(each).all() for each in values)


def air() -> None:
    column = Table(table=FILE).column(SITE, Instant.parse("2024-03-01"))
    finite(column.pressure, column.height, column.temperature, column.h2o)
    assert (np.diff(column.height) > 0).all()


def passband() -> None:
    band = Band(name="b", file=FILE)
    finite(band.centre, band.width)
    assert (np.diff(band.frequency) > 0).all()


def catalogue() -> None:
    found = Catalogue.read(PointSources(catalogue=FILE))
    finite(found.directions, found.flux, found.index)


def detectors() -> None:
    found = read_array(FILE)
    finite(*found.columns.values())
    assert len(set(found.names)) == len(found.names)


def recording() -> None:
    found = read_recording(FILE, "unix")
    assert len(found.seconds) == len(found.longitude) == len(found.latitude) == len(found.flags)


def schedule() -> None:
    for row in read_schedule(FILE)[0]:
        finite(row.duration, row.azimuth, row.elevation, row.rotation)
        assert row.duration > 0


def spectrum() -> None:
    found = read_spectrum(str(FILE))
    finite(found.values)
    assert found.rms > 0


def noise() -> None:
    finite(*read_noise(FILE).columns.values())


def front() -> None:
    points = read(FILE).points
    finite(*([p.error, p.seconds, p.spread, p.memory] for p in points))


READERS = {
    b"T": air,
    b"P": passband,
    b"C": catalogue,
    b"D": detectors,
    b"R": recording,
    b"S": schedule,
    b"M": spectrum,
    b"N": noise,
}


def target(data: bytes) -> None:
    FILE.write_bytes(data[1:])
    try:
        READERS.get(data[:1], front)()
    except (ZondaError, ValueError) as err:
        told(err)


LOG = (
    "#time ra-prg dec-prg az-prg el-prg az-real el-real x y z xt yt zt lst az-prg(no-cor)"
    " el-prog(no-cor) az-prog(center) type\n"
)


def tables() -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Readers and tables for them, as columns with units."""
    k = np.arange(6.0)
    yield b"P", {"frequency [GHz]": 140 + k, "transmission": [-0.01, 1, 1, 1, 1, 0]}
    yield (
        b"C",
        {
            "RA [deg]": 75 + k,
            "dec [deg]": k,
            "flux [Jy]": 1 + k,
            "spectral_index": k / 10,
        },
    )
    yield b"C", {"ra": ["05:00:00.5"] * 6, "dec": ["-20:30:15"] * 6, "S [mJy]": 1 + k}
    yield (
        b"D",
        {
            "name": [f"d{n:.0f}" for n in k],
            "xi [arcmin]": k / 7,
            "eta [arcmin]": -k / 9,
            "gamma [deg]": 45 * k,
            "net [uK s(1/2)]": 300 + k,
        },
    )
    yield (
        b"R",
        {
            "time [s]": 1732518000 + 0.1 * k,
            "az [deg]": 180 + k / 10,
            "el [deg]": 50 + k / 10,
            "flags": 0 * k,
        },
    )
    yield (
        b"R",
        {
            "time": [f"2024-11-25T07:00:00.{n:.0f}" for n in k],
            "ra [deg]": 75 + k / 100,
            "dec [deg]": 20 + k / 100,
        },
    )
    yield b"M", {"ell": 2 + k, "TT [uK2]": 1000 + k, "EE [uK2]": 10 + k, "TE [uK2]": k}
    yield (
        b"N",
        {"name": [f"d{n:.0f}" for n in k], "net": 1e-3 + k, "knee": 1 + k, "slope": 1 + 0 * k},
    )


def written(columns: dict[str, Any]) -> Iterator[bytes]:
    """A table in every format that is read."""
    from astropy.table import Table as Made

    rows = zip(*columns.values(), strict=True)
    lines = [list(columns), *([str(cell) for cell in row] for row in rows)]
    for mark in ",;\t":
        yield "\n".join(mark.join(line) for line in lines).encode()
    made = Made()
    for heading, values in columns.items():
        name, _, unit = heading.partition(" [")
        made[name] = values
        made[name].unit = unit.rstrip("]").replace("s(1/2)", "s**0.5") or None
    for kind in ("ascii.ecsv", "ascii.ipac", "votable", "fits"):
        made.write(FILE, format=kind, overwrite=True)
        yield FILE.read_bytes()
    FILE.unlink()


def seeds() -> Iterator[bytes]:
    rows = "".join(
        f"{h}, {1000 * 0.88 ** (h / 1000):.2f}, {288 - 6.5 * h / 1000}, {80 - h / 200}\n"
        for h in range(0, 12000, 1000)
    )
    yield (
        b"T# air\nheight [m], pressure [hPa], temperature [K], relative humidity [%]\n"
        + rows.encode()
    )
    yield b"P" + "".join(f"{f} {max(0, 1 - abs(f - 90) / 15)}\n" for f in range(75, 106)).encode()
    yield b"P# GHz\n75 0\n90 1\n105 0\n"
    for kind, columns in tables():
        for content in written(columns):
            yield kind + content
    site = "#Site Telescope\nATACAMA SAT -22.958 -67.786 5200.0\n"
    times = "2027-06-23 08:01:00 2027-06-23 08:11:00"
    for version in (
        f"{times} 45.0 a 110.0 142.0 50.0 21 3",
        "2027-06-23 08:01:00|2027-06-23 08:11:00|45|a|350|20|50|21|3",
        f"{times} 61579.3 61579.4 45 a 110 142 50 R 10 120 12 121 30 200 31 201 0.25 21 3 0.5",
    ):
        yield b"S" + f"{site}{version}\n".encode()
    states = ("ACC", "ON", "SCAN", "TRAN", "END")
    numbers = [f"{30 + k / 10:.4f}" for k in range(17)]
    rows = [f"2017111307054{k}.1 {' '.join(numbers)} {state}" for k, state in enumerate(states)]
    yield b"R" + (LOG + "\n".join(rows) + "\n").encode()
    point = {"setting": {"a.b": "1"}, "error": 0.1, "seconds": 1, "spread": 0, "memory": 5}
    front = {
        "format": 2,
        "metric": "peak",
        "fingerprint": "a",
        "reference_error": 0.1,
        "points": [point],
        "shorter": {},
    }
    yield b"F" + json.dumps(front | {"reference": {}, "seed": 1, "versions": {}}).encode()
    yield b"F" + next((ROOT / "pipelines" / "fronts").glob("*.json")).read_bytes()


WORDS = (
    "height [km], ",
    "ozone [ppm]",
    "wind east [m/s]",
    "NaN",
    "inf",
    "-1",
    "1e308",
    "1e-320",
    "0x10",
    "1_0",
    "NaN,",
    "Infinity",
    '"setting": ',
    "null",
    "[]",
    "[" * 50,
    "9" * 400,
    "# %ECSV 1.0",
    "!astropy.units.Unit {unit: 10**99}",
    "<TD>",
    "&lt;",
    "[deg]",
    "05:60:00",
    "SPECIAL",
)

if __name__ == "__main__":
    fuzz("text", target, seeds, longest=20_000, words=WORDS)
