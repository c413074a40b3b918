"""Half an hour of a 6 m survey telescope, two bands, polarized, in one HEALPix map each: CPU time
by step, memory, forecast.

    python benchmarks/survey_night.py                                # a tenth of it: half a minute
    python benchmarks/survey_night.py --factor 1                     # 30 min, 6.2e8 samples
    python benchmarks/survey_night.py --factor 1 --memory 2.5 --common-mode
    python benchmarks/survey_night.py --factor 1 --band f090         # one band alone

2 x 1720 detectors in pairs with shared pixels, 100 Hz: constant-elevation scans, atmosphere, white
and pink noise, polynomials of each detector's scan, the ground's template, maps of I, Q and U and
of their half-difference; no stream is saved. With `--common-mode` one singular mode of each band is
removed too. A first run of 12 s, not counted, compiles. CPU seconds are those of a process of its
own with imports and planning; by step, those that the pipeline timed. The forecast is that of
`zonda plan`.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

PIXELS = 860
BANDS = (("f090", 77, 106, 300), ("f150", 130, 170, 360))


def text(seconds: float, options: argparse.Namespace) -> str:
    """The pipeline file."""
    chosen = [band for band in BANDS if options.band in ("", band[0])]
    bands = "".join(
        f"    - {{name: {n}, low: {a} GHz, high: {b} GHz, net: {net} uK s(1/2), knee: 0.5 Hz,"
        f" detectors: {2 * PIXELS}}}\n"
        for n, a, b, net in chosen
    )
    return f"""
site: llano_de_chajnantor
seed: 11
instrument:
  name: survey
  telescope: {{name: dish, diameter: 6 m}}
  bands:
{bands}
  polarization: pairs
  field_of_view: 4.9 deg
  main_beam_efficiency: 0.8
  illumination_efficiency: 0.9
  sample_rate: 100 Hz
time: 2022-08-01T23:00
target: {{az: 180 deg, el: 50 deg}}
operators:
  - PointingBackAndForth: {{throw: 20 deg, speed: 1 deg/s, acceleration: 1 deg/s2, scan_duration: {seconds:g} s}}
  - AtmosphereLayers: {{pwv: 1 mm, pwv_rms: 2 %}}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - PolynomialFilter: {{order: 3}}
  - GroundFilter
{"  - CommonModeFilter: {modes: 1}" if options.common_mode else ""}
  - BinMap: {{stokes: IQU, nside: {options.nside}, half_difference: {options.half_difference}}}
  - SaveMap
"""


def one(file: Path, memory: int | None) -> None:
    """Plan and run the file in this process; figures as JSON."""
    from zonda.core.machine import one_blas_thread

    one_blas_thread()
    warnings.simplefilter("ignore")
    import zonda

    loaded = zonda.load(str(file))
    made = zonda.plan(loaded, prune_all=False, threads=1, memory=memory)
    start = time.process_time()
    loaded = made.apply(loaded)
    more = {} if memory is None else {"ceiling": memory}
    data = loaded.pipeline().run(loaded.scene(), output=file.parent / "out", threads=1, **more)
    run = time.process_time() - start
    steps: dict[str, float] = {}
    for label, _, seconds in data.provenance["timings"]:
        steps[label] = steps.get(label, 0.0) + seconds
    used = time.process_time()
    forecast = zonda.plan(zonda.load(str(file)), prune_all=False, threads=1, measure=True).timing
    labels = {*forecast.setup, *forecast.growing}
    found = {
        "cpu": used, "run": run, "steps": steps, "forecast": forecast.total,
        "bytes": made.memory, "expected": {k: forecast.of(k) for k in labels},
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }  # fmt: skip
    print(json.dumps(found))


def launch(folder: Path, seconds: float, options: argparse.Namespace) -> dict:
    """Figures of a run in a process of its own."""
    file = folder / "night.yaml"
    file.write_text(text(seconds, options))
    command = [sys.executable, __file__, "--one", str(file)]
    command += ["--memory", str(options.memory)] if options.memory else []
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--factor", type=float, default=0.1, help="share of the 30 min (default 0.1)"
    )
    parser.add_argument("--nside", type=int, default=1024)
    parser.add_argument("--memory", type=float, help="GB that the run may hold")
    parser.add_argument(
        "--common-mode", action="store_true", help="remove a singular mode of each band"
    )
    parser.add_argument(
        "--half-difference", default="halves", help="that of BinMap (default halves)"
    )
    parser.add_argument(
        "--band", default="", choices=["", *(name for name, *_ in BANDS)], help="one band alone"
    )
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    memory = None if options.memory is None else round(options.memory * 1e9)
    if options.one:
        one(Path(options.one), memory)
        return
    seconds = 1800 * options.factor
    samples = (1 if options.band else len(BANDS)) * 2 * PIXELS * seconds * 100
    with TemporaryDirectory() as folder:
        launch(Path(folder), 12.0, options)
        f = launch(Path(folder), seconds, options)
    print(f"{samples:.3g} samples, {seconds:g} s; CPU s, ns per sample, forecast s")
    for label in {**f["steps"], **f["expected"]}:
        used = f["steps"].get(label, 0.0)
        print(
            f"  {label:28s} {used:7.2f} {used / samples * 1e9:7.2f}"
            f" {f['expected'].get(label, 0.0):7.2f}"
        )
    print(f"  {'the run':28s} {f['run']:7.2f} {f['run'] / samples * 1e9:7.2f}")
    print(
        f"  {'the process, with imports':28s} {f['cpu']:7.2f} {f['cpu'] / samples * 1e9:7.2f}"
        f" {f['forecast']:7.2f}"
    )
    print(f"peak memory {f['peak'] / 1e9:.2f} GB, forecast {f['bytes'] / 1e9:.2f} GB")
    print(f"forecast / actual CPU {f['forecast'] / f['cpu']:.2f}")


if __name__ == "__main__":
    main()
