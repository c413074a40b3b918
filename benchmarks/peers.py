"""The atmosphere, and a whole chain, against TOAST and maria in one run.

    python benchmarks/peers.py --toast /path/to/python --maria /path/to/python
    python benchmarks/peers.py --maria /path/to/python --what atmosphere --case M2 --repeat 1
    python benchmarks/peers.py --maria /path/to/python --what statistics    # covariance and
    spectrum of realizations

Each code runs in an environment of its own, one process a run, one thread, in turns. CPU seconds
are those of the process, all its threads and its children, without imports; memory is the process's
peak. What each figure holds: docs/peers.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Report = dict[str, Any]

HERE = Path(__file__).parent / "peers"
ARCMIN, DEG = np.pi / 180 / 60, np.pi / 180
ELEVATION = 50 * DEG
DATE = "2022-08-01T23:00:00Z"
SITE = {"latitude": -23.0193 * DEG, "longitude": -67.7532 * DEG, "altitude": 5050.0}
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Case:
    """A camera and a scan: dish [m], band centre [GHz], field [rad], scan size [rad] and speed
    [rad/s] on the sky.
    """

    about: str
    diameter: float
    band: float
    field: float
    detectors: int
    rate: float
    seconds: float
    scan: str
    size: float
    speed: float


CASES = {
    "M2": Case(
        "100 m dish, daisy",
        100,
        93,
        4.2 * ARCMIN,
        223,
        100,
        516,
        "daisy",
        4 * ARCMIN,
        50 * ARCMIN / 60,
    ),
    "SURVEY": Case(
        "6 m dish, 7.8 deg, azimuth scan of 30 deg",
        6,
        150,
        7.8 * DEG,
        500,
        100,
        60,
        "azimuth",
        30 * DEG,
        1.5 * DEG,
    ),
}


STARES = {
    "100 m, 4 arcmin": (CASES["M2"], 2 * ARCMIN),
    "6 m, 1 deg": (CASES["SURVEY"], 0.5 * DEG),
}
"""Camera, and offset of four detectors from a fifth at the centre."""
STARE_RATE, STARE_SECONDS = 4.0, 240.0
PAIRS = {"in azimuth": (1, 2), "in elevation": (3, 4)}


def boresight(case: Case, t: Floats) -> tuple[Floats, Floats]:
    """Azimuth and elevation, rad."""
    if case.scan == "daisy":
        phase = t * case.speed / case.size
        z = np.sin(phase) * np.exp(1j * phase * np.pi / 10) + 0.15 * np.cos(phase) * np.exp(
            1j * np.sqrt(2) * phase * np.pi / 10
        )
        return 150 * DEG + case.size * z.real / np.cos(ELEVATION), ELEVATION + case.size * z.imag
    reach = case.size / 2 / np.cos(ELEVATION)
    return 150 * DEG + reach * np.sin(t * case.speed / np.cos(ELEVATION) / reach), np.full(
        len(t), ELEVATION
    )


def write_case(case: Case, path: Path) -> int:
    """What every script reads, SI units; the number of samples of all detectors."""
    from zonda.core.instrument import hexagonal_packing

    x, y = hexagonal_packing(case.detectors)
    scale = np.tan(case.field / 2) / np.hypot(x, y).max()
    t = np.arange(round(case.seconds * case.rate)) / case.rate
    _write(path, case, t, case.rate, x * scale, y * scale, *boresight(case, t))
    return case.detectors * len(t)


def write_stare(case: Case, offset: float, path: Path) -> None:
    """Five detectors that look at one place: the centre, and ``offset`` [rad] to each side of
    it.
    """
    t = np.arange(round(STARE_SECONDS * STARE_RATE)) / STARE_RATE
    xi, eta = offset * np.array([[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]])
    _write(
        path, case, t, STARE_RATE, xi, eta, np.full(len(t), 150 * DEG), np.full(len(t), ELEVATION)
    )


def _write(
    path: Path,
    case: Case,
    t: Floats,
    rate: float,
    xi: Floats,
    eta: Floats,
    azimuth: Floats,
    elevation: Floats,
) -> None:
    from zonda.core.configuration.time import Instant

    np.savez(
        path,
        xi=xi,
        eta=eta,
        seconds=t,
        azimuth=azimuth,
        elevation=elevation,
        rate=float(rate),
        duration=len(t) / rate,
        diameter=float(case.diameter),
        band_centre=case.band * 1e9,
        band_width=20e9,
        pwv=1e-3,
        pwv_rms=0.03,
        date=DATE,
        start=Instant.parse(DATE).posix,
        **SITE,
    )


def tables(folder: Path) -> None:
    """What maria reads, made from zonda's air, unless the user names a folder of her own
    (``MARIA_CACHE_DIR``).
    """
    sys.path.insert(0, str(HERE))
    from maria_tables import write_tables
    from zonda_atmosphere import chajnantor

    from zonda.core.configuration.time import Instant

    write_tables(folder, "chajnantor", chajnantor(SITE), Instant.parse(DATE))


def call(python: str, script: str, arguments: list[str], folder: Path, limit: float) -> str:
    """The last line that a script prints. A failure is a `RuntimeError` of one line."""
    environment = {
        **os.environ,
        **dict.fromkeys(ONE_THREAD, "1"),
        "MARIA_CACHE_DIR": os.environ.get("MARIA_CACHE_DIR", str(folder)),
    }
    if python == sys.executable:
        environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    try:
        done = subprocess.run(
            [python, str(HERE / script), *arguments],
            env=environment,
            capture_output=True,
            text=True,
            timeout=limit,
            cwd=folder,
        )
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"not done after {limit:g} s") from None
    except OSError as error:
        raise RuntimeError(f"cannot be run: {error}") from None
    if done.returncode:
        raise RuntimeError(
            (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        )
    return (done.stdout.strip().splitlines() or [""])[-1]


def in_turns(
    runs: dict[str, tuple[str, str, list[str]]], options: argparse.Namespace, folder: Path
) -> dict[str, list[Report]]:
    """What every run reports, ``--repeat`` times, one after another so that all meet the same
    noise.
    """
    found: dict[str, list[Report]] = {name: [] for name in runs}
    failed: set[str] = set()
    for _ in range(options.repeat):
        for name, (python, script, arguments) in runs.items():
            if name in failed:
                continue
            try:
                found[name].append(
                    json.loads(call(python, script, arguments, folder, options.limit))
                )
            except RuntimeError as error:
                print(f"  {name:8s} {error}")
                failed.add(name)
    return {name: reports for name, reports in found.items() if reports}


def middle(reports: list[Report], *keys: str) -> float:
    """Median over the repeats of the sum of some figures."""
    return float(np.median([sum(r[key] for key in keys) for r in reports]))


def atmosphere(name: str, peers: dict[str, str], options: argparse.Namespace, folder: Path) -> None:
    path = folder / f"{name}.npz"
    n = write_case(CASES[name], path)
    case = CASES[name]
    size = (
        f"{case.detectors} detectors, {case.rate:g} Hz, {case.seconds:g} s, {n / 1e6:.1f} M samples"
    )
    print(f"\n{name}, the atmosphere alone: {case.about}; {size}")
    runs = {"zonda": (sys.executable, "zonda_atmosphere.py", [str(path)])}
    if "maria" in peers:
        runs["maria"] = (peers["maria"], "maria_atmosphere.py", [str(path)])
    if "toast" in peers:
        runs["toast"] = (peers["toast"], "toast_atmosphere.py", [str(path)])
    found = in_turns(runs, options, folder)
    columns = (
        f"{'set-up s':>9s} {'evaluation s':>13s} {'ns/sample':>10s} {'x zonda':>8s}"
        f" {'first run s':>12s} {'peak GB':>8s}"
    )
    print(f"  {'':8s} {'version':8s} {columns} {'before':>7s}")
    unit = middle(found["zonda"], "setup", "evaluation") if "zonda" in found else float("nan")
    for who, reports in found.items():
        total = middle(reports, "setup", "evaluation")
        apart = (
            f"{middle(reports, 'setup'):9.2f} {middle(reports, 'evaluation'):13.2f}"
            f" {total / n * 1e9:10.1f} {total / unit:8.1f}"
        )
        memory = f"{middle(reports, 'peak'):8.2f} {middle(reports, 'before'):7.2f}"
        print(
            f"  {who:8s} {reports[0]['version']:8s} {apart} {middle(reports, 'first'):12.1f}"
            f" {memory}",
            flush=True,
        )


def chain(peers: dict[str, str], options: argparse.Namespace, folder: Path) -> None:
    path = folder / "M2.npz"
    n = write_case(CASES["M2"], path)
    print(f"\nM2, sky to map: {n / 1e6:.1f} M samples")
    runs = {"zonda": (sys.executable, "zonda_chain.py", [str(path)])}
    if "maria" in peers:
        runs["maria"] = (peers["maria"], "maria_chain.py", [str(path)])
    found = in_turns(runs, options, folder)
    for who, reports in found.items():
        total = middle(reports, "simulation", "mapping")
        figures = (
            f"{total:8.2f} CPU s, {total / n * 1e9:8.1f} ns/sample, peak"
            f" {middle(reports, 'peak'):.2f} GB"
        )
        print(f"  {who:8s} {reports[0]['version']:8s} {figures}", flush=True)
    if len(found) > 1:
        ratio = middle(found["maria"], "simulation", "mapping") / middle(
            found["zonda"], "simulation", "mapping"
        )
        print(f"  maria / zonda: {ratio:.0f}")


def statistics(peers: dict[str, str], options: argparse.Namespace, folder: Path) -> None:
    sys.path.insert(0, str(HERE))
    from statistics_table import table

    runs = {"zonda": (sys.executable, "zonda_statistics.py")}
    if "maria" in peers:
        runs["maria"] = (peers["maria"], "maria_statistics.py")
    for name, (case, offset) in STARES.items():
        path = folder / "stare.npz"
        write_stare(case, offset, path)
        print(
            f"\nStare of {STARE_SECONDS:g} s, {name} between detectors; measured / expected,"
            f" {options.realizations} realizations"
        )
        for who, (python, script) in runs.items():
            out = folder / f"{who}.npz"
            try:
                call(
                    python,
                    script,
                    [str(path), str(out), str(options.realizations)],
                    folder,
                    options.limit,
                )
            except RuntimeError as error:
                print(f"  {who:8s} {error}")
                continue
            for what, ratio in table(out, PAIRS):
                print(f"  {who:8s} {what:20s} {ratio}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--toast",
        metavar="PYTHON",
        help="interpreter of an environment with toast (PyPI: toast-cmb)",
    )
    parser.add_argument(
        "--maria", metavar="PYTHON", help="interpreter of an environment with maria 1.5"
    )
    parser.add_argument(
        "--what",
        nargs="*",
        choices=["atmosphere", "chain", "statistics"],
        default=["atmosphere", "chain", "statistics"],
    )
    parser.add_argument(
        "--case",
        nargs="*",
        choices=list(CASES),
        default=list(CASES),
        help="of the atmosphere; default: all",
    )
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--realizations", type=int, default=48)
    parser.add_argument(
        "--limit", type=float, default=1200, help="seconds that a process may take (default 1200)"
    )
    options = parser.parse_args()
    peers = installed({"toast": options.toast, "maria": options.maria})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "maria" in peers:
            tables(folder)
        if "atmosphere" in options.what:
            for case in options.case:
                atmosphere(case, peers, options, folder)
        if "chain" in options.what:
            chain(peers, options, folder)
        if "statistics" in options.what:
            statistics(peers, options, folder)
    print(f"\nload of the machine {os.getloadavg()[0]:.1f}")


def installed(pythons: dict[str, str | None]) -> dict[str, str]:
    """Of the environments named, those that hold their package; a line for each of the others."""
    found = {}
    for name, python in pythons.items():
        try:
            if python is None:
                raise OSError("no environment named")
            subprocess.run(
                [python, "-c", f"import importlib.util as u; assert u.find_spec('{name}')"],
                check=True,
                capture_output=True,
            )
            found[name] = python
        except (OSError, subprocess.CalledProcessError) as error:
            print(
                f"{name}: not installed"
                f" ({error if isinstance(error, OSError) else 'not found by ' + str(python)})"
            )
    return found


if __name__ == "__main__":
    main()
