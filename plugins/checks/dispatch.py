"""Another instruction set: the same scene without the vector instructions that this machine has."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import zonda
from zonda.core.checks import Family, Measured
from zonda.core.machine import arithmetic, command

from .scenes import DISPATCH, camera, scene, sky_file

checks = Family("dispatch")

SCALE = 2.0**-20
"""Rounding of float32, relative, of some sixteen operations one after the other."""


def small_map(place: str) -> None:
    """Run a small scene with everything in it; write its map and the largest value of its
    streams.
    """
    with sky_file(1e-3 * np.random.default_rng(0).standard_normal((64, 64))) as path:
        steps = [
            zonda.PointingDaisy(radius="2 arcmin", speed="1 arcmin/s", scan_duration="40 s"),
            zonda.SkyMap(file=path),
            zonda.AtmosphereLayers(pwv="5 mm"),
            zonda.WhiteNoise(),
            zonda.PinkNoise(),
            zonda.Efficiency(),
            zonda.HighpassFilter(frequency="0.1 Hz"),
            zonda.CommonModeFilter(),
            zonda.BinMap(pixel="4 arcsec", width="6 arcmin", half_difference=False),
        ]
        data = zonda.Pipeline(steps).run(scene(camera(37)), threads=1, keep=("atmosphere", "pink"))
    largest = max(float(np.abs(x).max()) for x in data.observations[0].detdata.values())
    np.savez(
        Path(place) / "map.npz",
        signal=data.products["map"].signal,
        hits=data.products["map"].hits,
        largest=largest,
    )


def _in_a_process(folder: Path, environment: dict[str, str]) -> dict[str, np.ndarray]:
    folder.mkdir()
    done = subprocess.run(
        command(__name__, "small_map", str(folder)),
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"the run on another instruction set failed: {done.stderr[-2000:]}")
    with np.load(folder / "map.npz") as found:
        return dict(found)


def baseline() -> dict[str, str]:
    """Environment variables that restrict numba and numpy to the architecture's basic instruction
    set.
    """
    numpy = str(arithmetic()["numpy instructions"])
    return {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NPY_DISABLE_CPU_FEATURES": numpy,
    }


@checks.add(
    DISPATCH,
    reference="the same scene without vector instructions",
    limit=10,
    unit="x 2^-20 of the largest value",
)
def another_instruction_set() -> Measured:
    """largest difference of a filtered map, over float32's rounding of the streams it is made of;
    the same hits
    """
    with TemporaryDirectory() as folder:
        here = _in_a_process(Path(folder, "here"), {})
        there = _in_a_process(Path(folder, "there"), baseline())
    change = float(np.nanmax(np.abs(here["signal"] - there["signal"])))
    same = np.array_equal(here["hits"], there["hits"])
    return change / (SCALE * float(here["largest"])) if same else np.inf, f"{change:.1e} K"
