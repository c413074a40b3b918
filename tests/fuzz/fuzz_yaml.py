"""Pipeline files of any bytes: a `PipelineFile` that writes itself down and reads back the same, or
a `ZondaError`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from engine import ROOT, fuzz, guided_by, scratch, told

with guided_by("zonda.core", "zonda.operators", "yaml"):
    import yaml  # noqa: F401

    from zonda.core.configuration.pipeline_file import load, parse
    from zonda.core.errors import ZondaError

FILE = scratch(".yaml")
FILE.with_name("map.fits").write_bytes(b"a file that is there")

SMALL = """\
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h00m00s +20d00m00s
operators:
  - PointingDaisy: {scan_duration: 2 s}
  - SkyMap: {file: map.fits}
  - Efficiency
  - BinMap
"""
WORDS = """\
version: 1
name: a b
requires: [numpy>=1]
runs: {noiseless: {only: [sky]}, free: {without: [sky]}}
precision: float64
accuracy: {target: 1 %, metric: peak}
budget: {map_rms: 3 uK}
seed: 0x10
site: {name: here, latitude: 38 deg, longitude: -79 deg, altitude: 1 km}
instrument: &i
  name: c
  telescope: {name: t, diameter: 100 m}
  band: {name: b, low: 78 GHz, high: 108 GHz}
  detectors: 7
  field_of_view: 4 arcmin
  net: 1 mK s(1/2)
time: 2024-11-25T02:00-05:00
target: {az: 180 deg, el: 60 deg}
weather: {pwv: 25 %, wind: random}
x-a: &a {<<: {pixel: 2 arcsec}}
operators:
  - PointingBackAndForth: {scan_duration: 5 min, throw: 3 deg, speed: 1 deg/s}
  - AtmosphereLayers: {pwv: 7.7 mm, layers: 2, wind: {speed: 12 m/s, direction: 200 deg}}
  - WhiteNoise
  - PinkNoise: {knee: 1 Hz}
  - Efficiency
  - HighpassFilter: {frequency: 0.08 Hz}
  - CommonModeFilter: {modes: 1}
  - BinMap: *a
  - SaveTOD: {streams: [signal, sky]}
  - SaveMap
"""


def target(data: bytes) -> None:
    """The text, and behind a zero byte settings as ``--set`` takes them, one a line."""
    content, _, settings = data.partition(b"\0")
    FILE.write_bytes(content)
    overrides = settings.decode("utf-8", "replace").split("\n") if settings else []
    try:
        file = load(FILE, overrides)
    except ZondaError as err:
        told(err)
        return
    text = file.resolved_yaml()
    again = parse(text, name=str(FILE), folder=FILE.parent).resolved_yaml()
    assert again == text, "the resolved file does not read back to itself"


def seeds() -> Iterator[bytes]:
    yield SMALL.encode()
    yield WORDS.encode()
    yield SMALL.encode() + b"\0BinMap.pixel=2 arcsec\nseed=8\nruns={a: {only: [sky]}}"
    for path in (ROOT / "pipelines").glob("*.yaml"):
        yield path.read_bytes()


def words() -> list[str]:
    """Keys, operators, units and notation."""
    from zonda.core.configuration.schema import json_schema
    from zonda.core.configuration.units import KINDS

    found: set[str] = set()

    def walk(node: object) -> None:
        if isinstance(node, dict):
            found.update(f"{key}: " for key in node.get("properties", {}))
            found.update(str(value) for value in node.get("enum", []))
            for value in node.values():
                walk(value)
        elif isinstance(node, list):
            for value in node:
                walk(value)

    walk(json_schema())
    notation = [
        "&a ",
        "*a",
        "<<: ",
        "!!python/object:os.system ",
        "? ",
        "---\n",
        "|\n",
        "1e999",
        "-0",
        ".nan",
        "9" * 40,
        "{",
        "[",
        "  - ",
    ]
    return sorted(
        word
        for word in found
        | set(notation)
        | {f"1 {unit}" for kind in KINDS.values() for unit in kind.display}
        if len(word) < 60
    )


if __name__ == "__main__":
    fuzz("yaml", target, seeds, longest=3000, words=words())
