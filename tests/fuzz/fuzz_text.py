"""Text tables of any bytes: profiles of the air, passbands and stored fronts. Inputs begin with one
byte that says which.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from engine import ROOT, fuzz, guided_by, scratch, told

with guided_by(
    "zonda.operators.atmosphere.weather.sources",
    "zonda.core.instrument",
    "zonda.core.accuracy.fronts",
):
    import numpy as np

    from zonda.core.accuracy.fronts import read
    from zonda.core.configuration.time import Instant
    from zonda.core.errors import ZondaError
    from zonda.core.instrument import Band
    from zonda.core.site import Site
    from zonda.operators.atmosphere.weather.sources import Table

FILE = scratch(".txt")
SITE = Site(name="here", latitude="40.6 deg", longitude="10.1 deg", altitude="500 m")


def target(data: bytes) -> None:
    FILE.write_bytes(data[1:])
    try:
        if data[:1] == b"T":
            column = Table(table=FILE).column(SITE, Instant.parse("2024-03-01"))
            assert all(
                np.isfinite(v).all()
                for v in (column.pressure, column.height, column.temperature, column.h2o)
            )
            assert (np.diff(column.height) > 0).all()
        elif data[:1] == b"P":
            band = Band(name="b", file=FILE)
            assert np.isfinite([band.centre, band.width]).all()
            assert band.centre > 0
        else:
            front = read(FILE)
            assert all(
                np.isfinite([p.error, p.seconds, p.spread, p.memory]).all() for p in front.points
            )
    except (ZondaError, ValueError) as err:
        told(err)


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
    point = {"setting": {"a.b": "1"}, "error": 0.1, "seconds": 1, "spread": 0, "memory": 5}
    front = {
        "format": 1,
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
)

if __name__ == "__main__":
    fuzz("text", target, seeds, longest=20_000, words=WORDS)
