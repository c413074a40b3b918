"""Golden master: bits and header cards of fifteen runs, before and after a change.

    python benchmarks/golden.py record FILE [CASE ...]     (on the commit before)
    python benchmarks/golden.py check FILE [CASE ...]      (on the commit after, same machine)

Each case is run as a user runs it, `python -m zonda run`, and the files of its products are read
with astropy and h5py: the digest of every array, and every header card that states no date,
version or path. Bits belong to one machine's instruction set and one set of libraries, so the
digests are not kept in the repository.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
from astropy.io import fits

VOLATILE = ("DATE", "CREATOR", "ORIGIN", "CHECKSUM", "DATASUM", "HISTORY", "COMMENT", "")
"""Cards that state a date, a version or the log of the run, whose wording may change."""
TEXTS = ("RESOLVED_YAML", "LOG")
"""Tables of text: they state paths, and what the run said."""
UNSTABLE = ("version", "created", "history", "yaml", "file", "uid")
"""Attributes of HDF5 files with a word of these in their name are left out, for the same reason."""

CAMERA = """
instrument:
  name: golden
  telescope: {{name: dish, diameter: 6 m}}
  bands:
    - {{name: f090, low: 77 GHz, high: 106 GHz, net: 300 uK s(1/2), knee: 0.5 Hz, detectors: {0}}}
    - {{name: f150, low: 130 GHz, high: 170 GHz, net: 360 uK s(1/2), knee: 0.3 Hz, detectors: {1}}}
  {2}
  field_of_view: 40 arcmin
  main_beam_efficiency: 0.8
  illumination_efficiency: 0.9
  sample_rate: 50 Hz
"""
HEAD = """
site: llano_de_chajnantor
seed: 11
time: 2022-08-01T23:00
target: {az: 180 deg, el: 50 deg}
"""
SCAN = """
operators:
  - PointingBackAndForth:
      {throw: 4 deg, speed: 1 deg/s, acceleration: 1 deg/s2, scan_duration: 40 s, scans: 2}
"""
NOISE = """
  - AtmosphereLayers: {pwv: 1 mm, pwv_rms: 2 %}
  - WhiteNoise
  - PinkNoise: {shared: 0.3}
  - Efficiency
"""
ENDS = """
  - BinMap: {pixel: 3 arcmin, half_difference: true, crosslinking: true}
  - SaveMap
"""
HIGHPASS = "\n  - HighpassFilter: {frequency: 0.2 Hz}"
STREAMS = "\n  - SaveTOD: {streams: [signal, atmosphere]}"
POLARIZED = "polarization: pairs\n  pixels: separate"
IQU = """
  - BinMap: {stokes: IQU, pixel: 4 arcmin, half_difference: true}
  - SaveMap
"""


def two(first: int = 38, second: int = 24, more: str = "pixels: separate") -> str:
    """Scene of a camera with two bands."""
    return HEAD + CAMERA.format(first, second, more)


def overlaid(filters: str, ends: str = ENDS) -> str:
    """Two bands of 19 and 12 detectors that look at the same places, filtered and mapped."""
    return two(19, 12, "pixels: overlaid") + SCAN + NOISE + filters + ends


def digest(array: np.ndarray) -> str:
    """Digest of shape, type and values; every NaN counts as the same."""
    values = np.asarray(array)
    if values.dtype.kind == "f":
        values = np.where(np.isnan(values), np.nan, values).astype(values.dtype.newbyteorder("="))
    if values.dtype.kind == "O":
        return hashlib.sha256(repr(values.tolist()).encode()).hexdigest()[:16]
    head = f"{values.shape} {values.dtype.kind}{values.dtype.itemsize} "
    return head + hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:16]


def of_fits(path: Path) -> dict[str, str]:
    """Arrays and cards of each HDU."""
    found = {}
    with fits.open(path, do_not_scale_image_data=True) as hdus:
        for number, hdu in enumerate(hdus):
            name = f"{number} {hdu.name}"
            if hdu.name in TEXTS:
                continue
            if isinstance(hdu, fits.BinTableHDU):
                for column in hdu.columns.names:
                    found[f"{name} {column}"] = digest(hdu.data[column])
            elif hdu.data is not None:
                found[name] = digest(hdu.data)
            for card in hdu.header.cards:
                if card.keyword not in VOLATILE and not card.keyword.startswith("VERS"):
                    found[f"{name} {card.keyword}"] = repr(card.value)
    return found


def of_hdf5(path: Path) -> dict[str, str]:
    """Datasets and attributes."""
    found = {}

    def visit(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = digest(item[()]) if "yaml" not in name else ""
        for key, value in item.attrs.items():
            if not any(word in key.lower() for word in UNSTABLE):
                found[f"{name}@{key}"] = repr(value)

    with h5py.File(path) as file:
        file.visititems(visit)
    return found


def products(folder: Path) -> dict[str, str]:
    """Figures of all FITS and HDF5 files under a folder of products."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if "tasks" in path.parts or not path.is_file():
            continue
        place = str(path.relative_to(folder))
        if path.suffix == ".fits":
            found |= {f"{place}: {key}": value for key, value in of_fits(path).items()}
        elif path.suffix == ".h5":
            found |= {f"{place}: {key}": value for key, value in of_hdf5(path).items()}
    if not found:
        raise SystemExit(f"{folder}: no products")
    return found


def zonda(*arguments: object) -> list[str]:
    """A command line."""
    return [sys.executable, "-m", "zonda", *map(str, arguments)]


def run(file: Path | str, output: Path, *options: str) -> dict[str, str]:
    """Run a pipeline file; figures of its products."""
    command = zonda("run", file, "--output", output, *options)
    done = subprocess.run(command, capture_output=True, text=True, cwd=output.parent)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stdout}\n{done.stderr}")
    return products(output)


def plain(text: str, *options: str) -> Callable[[Path], dict[str, str]]:
    """A case that is one run of one file in full."""

    def case(folder: Path) -> dict[str, str]:
        (folder / "case.yaml").write_text(text)
        return run(folder / "case.yaml", folder / "out", "--no-prune", *options)

    return case


def shipped(name: str, *options: str) -> Callable[[Path], dict[str, str]]:
    """A case that is a shipped pipeline, shortened."""
    return lambda folder: run(name, folder / "out", "--no-prune", *options)


def recorded(saved: str, text: str) -> Callable[[Path], dict[str, str]]:
    """A case that simulates and saves streams, then maps what was saved."""

    def case(folder: Path) -> dict[str, str]:
        (folder / "first.yaml").write_text(saved)
        (folder / "second.yaml").write_text(text)
        found = run(folder / "first.yaml", folder / "out", "--no-prune")
        files = ", ".join(str(p) for p in sorted((folder / "out").glob("tod_*")))
        second = text.replace("FILES", f"[{files}]")
        (folder / "second.yaml").write_text(second)
        again = run(folder / "second.yaml", folder / "again", "--no-prune")
        return found | {f"again/{key}": value for key, value in again.items()}

    return case


def resolved(folder: Path) -> dict[str, str]:
    """A run, and the run of its resolved.yaml, whose arrays must be the same."""
    (folder / "case.yaml").write_text(overlaid(HIGHPASS))
    found = run(folder / "case.yaml", folder / "out")
    again = run(folder / "out" / "resolved.yaml", folder / "again")
    other = [k for k in found if found[k] != again.get(k) and ".fits: " in k and "sha" not in k]
    if other:
        raise SystemExit(f"resolved.yaml gives other bits: {other[:5]}")
    return found


CAMPAIGN = (
    HEAD
    + "instrument: {name: one, telescope: {name: dish, diameter: 6 m}, net: 300 uK s(1/2),"
    + " band: {name: f090, low: 77 GHz, high: 106 GHz}, detectors: 19, field_of_view: 40 arcmin,"
    + " main_beam_efficiency: 0.8, illumination_efficiency: 0.9, sample_rate: 50 Hz}\n"
    + "campaign: {realizations: 6, engine: processes, workers: 2}"
    + SCAN
    + NOISE
    + HIGHPASS
    + ENDS
)


def killed(folder: Path) -> dict[str, str]:
    """A campaign that is killed and resumed, against one that runs through."""
    (folder / "case.yaml").write_text(CAMPAIGN)
    whole = run(folder / "case.yaml", folder / "whole")
    command = zonda("run", folder / "case.yaml", "--output", folder / "killed")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, start_new_session=True, **quiet)
    time.sleep(6)  # wherever it is by then: the products must be the same
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    order = "resume" if (folder / "killed" / "campaign.json").exists() else "run"
    target = [folder / "killed"] if order == "resume" else [*command[4:]]
    subprocess.run(zonda(order, *target), check=True, capture_output=True)
    again = products(folder / "killed")
    other = [key for key in whole if whole[key] != again.get(key)]
    if other:
        raise SystemExit(f"the resumed campaign gives other bits: {other[:5]}")
    return whole


CASES: dict[str, Callable[[Path], dict[str, str]]] = {
    "mustang2_cluster": shipped("mustang2_cluster", "--set", "PointingDaisy.scan_duration=1 min"),
    "atlast_reduced": shipped("atlast_reduced", "--set", "PointingDaisy.scan_duration=10 s"),
    "atlast_full": shipped("atlast_full", "--set", "PointingDaisy.scan_duration=1 s"),
    "two_bands": plain(overlaid(HIGHPASS + "\n  - CommonModeFilter", ENDS + STREAMS)),
    "separate_bands": plain(
        two() + SCAN + NOISE + HIGHPASS + "\n  - CommonModeFilter: {modes: 2}" + ENDS + STREAMS
    ),
    "group_wafer": plain(overlaid(HIGHPASS + "\n  - CommonModeFilter: {group: wafer}")),
    "group_all": plain(
        two() + SCAN + NOISE + HIGHPASS + "\n  - CommonModeFilter: {group: all}" + ENDS + STREAMS
    ),
    "iqu_plate": plain(
        two(38, 24, POLARIZED)
        + SCAN
        + "  - HalfWavePlate: {frequency: 2 Hz}"
        + NOISE
        + "  - PolynomialFilter: {order: 3}\n  - GroundFilter"
        + IQU
    ),
    "healpix": plain(
        two(38, 24, POLARIZED)
        + SCAN
        + NOISE
        + "  - PolynomialFilter: {order: 2}"
        + "\n  - BinMap: {stokes: IQU, nside: 512, half_difference: true}\n  - SaveMap"
    ),
    "load_bands": recorded(
        overlaid(HIGHPASS, STREAMS),
        "operators:\n  - LoadTOD: {file: FILES}\n  - CommonModeFilter" + ENDS,
    ),
    "fits_round_trip": recorded(
        CAMPAIGN.replace("campaign: {realizations: 6, engine: processes, workers: 2}", "").replace(
            ENDS, "\n  - SaveTOD: {format: fits}"
        ),
        "operators:\n  - LoadTOD: {file: FILES}\n  - CommonModeFilter" + ENDS,
    ),
    "small_memory": plain(
        two(1000, 800)
        + SCAN.replace("40 s", "150 s")
        + NOISE
        + HIGHPASS
        + "\n  - CommonModeFilter: {group: all}"
        + ENDS,
        "--memory",
        "600 MB",
    ),
    "car_map": plain(
        overlaid(
            HIGHPASS, "\n  - BinMap: {pixel: 3 arcmin, projection: CAR, smooth: beam}\n  - SaveMap"
        )
    ),
    "campaign_killed": killed,
    "resolved": resolved,
}


def main(order: str, record: Path, names: list[str]) -> int:
    """Record the figures of the cases, or compare them with those on record."""
    before = json.loads(record.read_text()) if record.exists() else {}
    failed = 0
    for name in names or CASES:
        start = time.perf_counter()
        with TemporaryDirectory() as folder:
            found = CASES[name](Path(folder))
        seconds = f"{time.perf_counter() - start:.0f} s"
        if order == "record":
            before[name] = found
            record.write_text(json.dumps(before, indent=1))
            print(f"{name}: {len(found)} figures, {seconds}", flush=True)
            continue
        # the table of the plan changed with issue 25: whether there is one depends on the scene's size
        known, found = (
            {
                key: value
                for key, value in each.items()
                if " PLAN " not in key and "zonda_plan" not in key
            }
            for each in (before[name], found)
        )
        other = [key for key in known | found if known.get(key) != found.get(key)]
        failed += bool(other)
        verdict = f"{len(other)} of {len(known)} differ" if other else f"{len(known)} the same"
        print(f"{name}: {verdict}, {seconds}", flush=True)
        for key in other[:20]:
            print(f"    {key}: {known.get(key)} -> {found.get(key)}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2]), sys.argv[3:]))
