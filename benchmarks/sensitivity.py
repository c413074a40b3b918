"""The forecast of `zonda sensitivity` against simulations of the same pipelines on four cameras:
tables of docs/sensitivity.md.

    python benchmarks/sensitivity.py [--case NAME ...] [--seeds N] [--json FILE]
    python benchmarks/sensitivity.py --radii [--seeds N]

The cases are daisies of MUSTANG-2 (one scan), AtLAST's reduced camera and APEX (345 GHz), and
azimuth scans of ACT. ``--radii``: minutes of MUSTANG-2 to 5 sigma on a Gaussian of 1 arcmin, with
daisies of several radii.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import zonda
from zonda.core.configuration.pipeline_file import PipelineFile, parse

ACT = """
name: act
seed: 5
site: llano_de_chajnantor
instrument: act
time: 2022-08-01T09:00
target: 30d -10d
operators:
  - PointingBackAndForth:
      {throw: 2 deg, speed: 30 arcmin/s, acceleration: 30 arcmin/s2, scan_duration: 5 min, sample_rate: 100 Hz}
  - AtmosphereLayers: {pwv_rms: 3 %}
  - WhiteNoise
  - PinkNoise: {knee: 0.5 Hz, shared: 0.5}
  - Efficiency
  - HighpassFilter: {frequency: 0.1 Hz}
  - CommonModeFilter
  - BinMap: {pixel: 0.5 arcmin, half_difference: false}
"""
APEX = """
name: apex
seed: 5
site: llano_de_chajnantor
instrument: apex
time: 2022-08-01T09:00
target: 30d -10d
operators:
  - PointingDaisy: {radius: 5 arcmin, speed: 120 arcsec/s, scan_duration: 6 min, scans: 2, gap: 20 s}
  - AtmosphereLayers: {pwv_rms: 2 %}
  - WhiteNoise
  - PinkNoise: {knee: 1 Hz, slope: 1.4}
  - Efficiency
  - HighpassFilter: {frequency: 0.2 Hz}
  - CommonModeFilter
  - BinMap: {pixel: 4 arcsec, half_difference: false}
"""


class Case(NamedTuple):
    """A pipeline, the radius of the circle that its depth is averaged over, and how often it is
    simulated.
    """

    pipeline: str
    settings: tuple[str, ...]
    radius: str
    seeds: int


CASES = {
    "MUSTANG-2": Case(
        "mustang2_cluster",
        ("PointingDaisy.scans=1", "PointingDaisy.offsets=none"),
        "0.5 arcmin",
        48,
    ),
    "AtLAST, reduced": Case("atlast_reduced", (), "7.5 arcmin", 4),
    "ACT": Case(ACT, (), "20 arcmin", 16),
    "APEX": Case(APEX, (), "2 arcmin", 24),
}


def file_of(case: Case) -> PipelineFile:
    """A case's pipeline."""
    return (
        parse(case.pipeline) if "\n" in case.pipeline else zonda.load(case.pipeline, case.settings)
    )


RADII = 1.5, 3, 5, 8


def minutes(seeds: int) -> None:
    """Print the minutes to 5 sigma of a source's peak: by noise alone, forecast, simulated."""
    print("| radius of the daisy | noise alone | forecast | simulated |")
    print("| --- | --- | --- | --- |", flush=True)
    for radius in RADII:
        settings = [f"PointingDaisy.radius={radius} arcmin", "PointingDaisy.scans=1"]
        file = zonda.load("mustang2_cluster", [*settings, "PointingDaisy.offsets=none"])
        found = zonda.sensitivity(file, source="gaussian 1 arcmin", peak="0.3 mJy/beam")
        row = next(r for r in found.audited(seeds).audit.rows if r.part == "S/N peak")
        noise = found.seconds * (5 * found.rms() / found.source.smoothed) ** 2
        simulated = found.seconds * (5 / row.mean) ** 2
        each = [noise, found.reach("5 sigma"), simulated, 2 * simulated * row.error / row.mean]
        figures = "{:.1f} | {:.1f} | {:.1f} +- {:.1f}".format(*(t / 60 for t in each))
        print(f"| {radius} arcmin | {figures} |", flush=True)


def main() -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", action="append", choices=CASES, help="default: all")
    parser.add_argument("--seeds", type=int, help="default: as many as the case has")
    parser.add_argument("--json", type=Path, help="write the figures to a file, too")
    parser.add_argument("--radii", action="store_true", help="minutes to 5 sigma of a source")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    if arguments.radii:
        minutes(arguments.seeds or 16)
        return
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent,
    )
    print(f"commit {commit.stdout.strip()}\n")
    print(
        "| case | part | forecast [uK_RJ] | simulated | difference | z | stated | CPU of the"
        " forecast |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    rows = []
    for name in arguments.case or CASES:
        case = CASES[name]
        begin = time.process_time()
        found = zonda.sensitivity(file_of(case), radius=case.radius)
        used = time.process_time() - begin
        audited = found.audited(arguments.seeds or case.seeds)
        assert audited.audit is not None
        for row in audited.audit.rows:
            stated = found.depth.error.get(row.part, found.depth.total_error(found.seconds))
            figures = [
                f"{row.forecast * 1e6:.2f}",
                f"{row.mean * 1e6:.2f} +- {row.error * 1e6:.2f} ({row.seeds} seeds)",
            ]
            figures += [
                f"{100 * row.difference:+.1f} %",
                f"{row.z:+.1f}",
                f"{100 * stated:.0f} %",
                f"{used:.1f} s",
            ]
            print(f"| {' | '.join([name, row.part, *figures])} |", flush=True)
            rows.append(
                {
                    "case": name,
                    "part": row.part,
                    "forecast": row.forecast,
                    "simulated": row.mean,
                    "error": row.error,
                }
            )
    if arguments.json:
        arguments.json.write_text(
            json.dumps({"commit": commit.stdout.strip(), "rows": rows}, indent=2)
        )


if __name__ == "__main__":
    main()
