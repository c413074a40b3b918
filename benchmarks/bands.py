"""CPU time of a camera with two bands and shared pixels beside each of its bands alone: `python
benchmarks/bands.py [CASE ...]`.

The chain (pointing, atmosphere, white and pink noise, efficiencies, high-pass filter, common mode,
map) on one thread, in one process, after a run that compiles; and the whole command, `zonda run`
with maps, pictures and a report. By turns, medians.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

from zonda.core.machine import one_blas_thread

one_blas_thread()

BANDS = {
    "f090": "{name: f090, low: 77 GHz, high: 106 GHz, net: 300 uK s(1/2), knee: 0.5 Hz}",
    "f150": "{name: f150, low: 130 GHz, high: 170 GHz, net: 360 uK s(1/2), knee: 0.5 Hz}",
}
NARROW = "radius: 4 arcmin, speed: 50 arcsec/s, scan_duration: 8.6 min"
MIDDLE = "radius: 1 deg, speed: 0.5 deg/s, scan_duration: 5 min"
WIDE = "radius: 3 deg, speed: 1 deg/s, scan_duration: 2 min"
CASES = {
    "100 m, 4.2 arcmin": ("223", "4.2 arcmin", "100 m", "100 Hz", NARROW, "2 arcsec"),
    "6 m, 1 deg": ("430", "1 deg", "6 m", "50 Hz", MIDDLE, "30 arcsec"),
    "6 m, 7.8 deg": ("430", "7.8 deg", "6 m", "100 Hz", WIDE, "2 arcmin"),
}
REPEAT = 5


def text(case: str) -> str:
    """The pipeline file."""
    detectors, field, dish, rate, scan, pixel = CASES[case]
    return f"""
site: llano_de_chajnantor
instrument:
  name: camera
  telescope: {{name: dish, diameter: {dish}}}
  bands: [{", ".join(BANDS.values())}]
  detectors: {detectors}
  field_of_view: {field}
  main_beam_efficiency: 0.8
  illumination_efficiency: 0.9
  sample_rate: {rate}
time: 2022-08-01T23:00
target: 260d -10d
operators:
  - PointingDaisy: {{{scan}, scans: 2}}
  - AtmosphereLayers: {{pwv: 1 mm, pwv_rms: 2 %}}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - HighpassFilter: {{frequency: 0.1 Hz}}
  - CommonModeFilter
  - BinMap: {{pixel: {pixel}}}
  - SaveMap
  - Plots
  - Report
"""


def chain(file: Path, settings: list[str]) -> float:
    """CPU seconds of the steps up to the map."""
    from zonda.core.configuration.pipeline_file import load
    from zonda.core.output import Output
    from zonda.core.pipeline import Pipeline

    loaded = load(file, settings)
    pipeline = Pipeline([o for o in loaded.operators if not isinstance(o, Output)])
    start = time.process_time()
    pipeline.run(loaded.scene(), threads=1)
    return time.process_time() - start


def command(file: Path, settings: list[str]) -> float:
    """CPU seconds of ``zonda run``, all processes."""
    before = os.times()
    options = [part for setting in settings for part in ("--set", setting)]
    script = Path(sys.executable).with_name("zonda")
    subprocess.run(
        [script, "run", file, "--threads", "1", "--output", file.parent / "out", *options],
        check=True,
        capture_output=True,
    )
    after = os.times()
    return (
        after.children_user + after.children_system - before.children_user - before.children_system
    )


def main(names: list[str]) -> None:
    """One line a case: each band alone, both together, and the ratio to the mean of one."""
    warnings.simplefilter("ignore")
    with TemporaryDirectory() as folder:
        for case in names or CASES:
            file = Path(folder) / "bands.yaml"
            file.write_text(text(case))
            for what in (chain, command):
                found: dict[str, list[float]] = {name: [] for name in (*BANDS, "both")}
                for repeat in range(REPEAT + 1):  # the first may compile
                    for name, seconds in found.items():
                        used = what(file, [] if name == "both" else [f"instrument.band={name}"])
                        seconds += [used] if repeat else []
                medians = {name: statistics.median(seconds) for name, seconds in found.items()}
                ratio = medians["both"] / statistics.mean(medians[name] for name in BANDS)
                told = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in medians.items())
                print(f"{case}, {what.__name__}: {told}; ratio {ratio:.2f}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
