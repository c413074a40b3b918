"""Memory that a run is predicted to hold, beside the most that its process held.

    python benchmarks/memory_forecast.py [SCENE ...]

Each scene is a pipeline file. `zonda run` in a process of its own says what it expects
(`core/run/budget.py`, by which it also refuses), and the kernel what it held (`ru_maxrss`: resident
pages, those of libraries and mapped files included); `zonda plan` says what it expects before. All
of a scene is simulated (`--no-prune`), by two threads.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

THREADS = 2
HEAD = """\
site: green_bank
instrument: {{name: cam, telescope: {{name: dish, diameter: {dish} m}}, {bands},
  detectors: {detectors}, field_of_view: {field}, main_beam_efficiency: 0.3,
  illumination_efficiency: 0.8, polarization: {polarization},
  net: 1 mK s(1/2), knee: 1 Hz, sample_rate: {rate} Hz}}
time: 2024-11-25T07:00
target: 05h +20d
seed: 5
{more}
operators:
"""
CHAIN = """\
  - PointingDaisy: {{radius: {radius}, speed: {speed}, scan_duration: {duration}, scans: {scans}}}
  - SkyMap: {{file: {file}, centre: target}}
  - AtmosphereLayers: {{pwv_rms: 5 %}}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - HighpassFilter: {{frequency: 0.1 Hz}}
  - CommonModeFilter: {{modes: 1{method}}}
  - BinMap: {bins}
"""
CLUSTER = Path(__file__).resolve().parents[1] / "pipelines" / "data" / "merging_cluster.fits"
ONE = "band: {name: b, low: 80 GHz, high: 100 GHz}"
TWO = "bands: [{name: b, low: 80 GHz, high: 100 GHz}, {name: c, low: 140 GHz, high: 160 GHz}]"


def scene(outputs: str = "  - SaveMap\n", **changed: Any) -> str:
    """A pipeline file. ``outputs``: its last steps."""
    values = {
        "dish": 100,
        "bands": ONE,
        "detectors": 19,
        "field": "2 arcmin",
        "polarization": "none",
        "rate": 50,
        "more": "",
        "radius": "3 arcmin",
        "speed": "30 arcsec/s",
        "duration": "20 s",
        "scans": 2,
        "file": CLUSTER,
        "method": "",
        "bins": "{pixel: 5 arcsec}",
    } | changed
    return (HEAD + CHAIN).format(**values) + outputs


AIR = CHAIN.split("\n")[1] + "\n" + CHAIN.split("\n")[2] + "\n"
SHOWN = "  - SaveMap\n  - Plots\n  - Report\n"
NOISELESS = "runs: {noiseless: {only: [sky], modes: full}}"
WIDE = {"radius": "3 deg", "speed": "1 deg/s", "dish": 6, "field": "1 deg", "detectors": 217}
LARGE = {"detectors": 3000, "dish": 50, "radius": "0.25 deg", "speed": "0.3 deg/s", "rate": 225}
DENSE = WIDE | {"radius": "0.7 deg", "detectors": 3000, "rate": 100}
THREE = "runs: {white: {only: [white], modes: full}, pink: {only: [pink], modes: full}}"
LIKELIHOOD = "\n".join(
    line
    for line in scene(detectors=217, duration="60 s", scans=3).splitlines()
    if "Filter" not in line
).replace("BinMap", "MaximumLikelihoodMap")
SCENES: dict[str, tuple[str | list[str], list[str]]] = {
    "19 detectors": (scene(), []),
    "with pictures": (scene(SHOWN), []),
    "with a noiseless map": (scene(more=NOISELESS), []),
    "two bands": (scene(bands=TWO), []),
    "polarized, IQU": (scene(polarization="pairs", detectors=38, bins="{pixel: 5 arcsec, stokes: IQU}"), []),
    "HEALPix, nside 512": (scene(**WIDE, bins="{nside: 512}"), []),
    "HEALPix, nside 2048": (scene(**WIDE, bins="{nside: 2048}"), []),
    "HEALPix, nside 2048, IQU": (
        scene(**WIDE | {"polarization": "pairs", "detectors": 218}, bins="{nside: 2048, stokes: IQU}"),
        [],
    ),
    "2000 x 2000 pixels": (scene(bins="{pixel: 0.3 arcsec, width: 10 arcmin}"), []),
    "2000 x 2000 pixels, with pictures": (scene(SHOWN, bins="{pixel: 0.3 arcsec, width: 10 arcmin}"), []),
    "noise alone, HEALPix, nside 2048": (
        scene(**WIDE, bins="{nside: 2048}", duration="400 s").replace(AIR.format(file=CLUSTER), ""), ["--memory", "280MB"]
    ),
    "40 deg, nside 2048, noise alone": (
        scene(**WIDE | {"radius": "20 deg", "speed": "5 deg/s"}, bins="{nside: 2048}", duration="400 s", rate=20).replace(AIR.format(file=CLUSTER), ""), []
    ),
    "20 layers, a wide field": (scene(**WIDE).replace("pwv_rms: 5 %", "pwv_rms: 5 %, layers: 20"), []),
    "1 h": (scene(duration="1 h", scans=1, detectors=217), []),
    "well covered, 2000 x 2000 pixels": (scene(**DENSE, bins="{pixel: 4 arcsec}").replace(AIR.format(file=CLUSTER), ""), []),
    "there, three signals": (scene(**DENSE | {"more": THREE}, bins="{pixel: 4 arcsec}").replace(AIR.format(file=CLUSTER), ""), []),
    "there, IQU": (scene(**DENSE | {"polarization": "pairs"}, bins="{pixel: 4 arcsec, stokes: IQU}").replace(AIR.format(file=CLUSTER), ""), []),
    "there, with pictures": (scene(SHOWN, **DENSE, bins="{pixel: 4 arcsec}").replace(AIR.format(file=CLUSTER), ""), []),
    "3000 detectors, 20 s": (scene(**LARGE, bins="{pixel: 4 arcsec}"), []),
    "there, singular modes of a stream on disk": (
        scene(**LARGE, bins="{pixel: 8 arcsec}", method=", method: svd"),
        ["--memory", "450MB"],
    ),
    "there, 80 s": (
        scene(**LARGE | {"duration": "80 s", "scans": 1}, bins="{pixel: 8 arcsec}", method=", method: svd"),
        ["--memory", "450MB"],
    ),
    "there, its stream made again": (
        scene(**LARGE, bins="{pixel: 8 arcsec}", method=", method: mean"),
        ["--memory", "450MB"],
    ),
    "maximum likelihood": (LIKELIHOOD, ["--set", "MaximumLikelihoodMap.pixel=5 arcsec"]),
    "there, 1 arcsec": (LIKELIHOOD, ["--set", "MaximumLikelihoodMap.pixel=1 arcsec"]),
    "float64": (scene(more="precision: float64", detectors=217, duration="200 s"), []),
    "mustang2_cluster": (["mustang2_cluster"], []),
    "atlast_reduced, 20 s": (
        ["atlast_reduced", "--set", "PointingDaisy.scan_duration=20 s", "--set", "PointingDaisy.scans=1"],
        [],
    ),
    "atlast_full, 2 s": (["atlast_full", "--set", "PointingDaisy.scan_duration=2 s"], []),
    "campaign": (scene(more="campaign: {realizations: 3, engine: serial}"), []),
}  # fmt: skip


def run(arguments: list[str]) -> None:
    """Run zonda in this process; print what it expected to hold, and held at stages."""
    import resource

    import zonda.core.run.budget as budget
    from zonda.core.cli.entry import main
    from zonda.core.machine import resident_memory
    from zonda.core.run.schedule import schedule

    told: dict[str, Any] = {"parts": {}, "during": 0, "end": 0}
    divide, at_end = budget.divided, budget.at_end

    def listen(views: Any, settings: Any, *more: int) -> Any:
        found = divide(views, settings, *more)
        blocks = schedule(views, found)
        told["during"] = found.process - found.memory + blocks.bytes
        told["begin"] = resident_memory()
        told["parts"] = budget._of_steps(views, found.threads, blocks.spilled)
        told["parts"]["blocks"] = blocks.bytes
        return found

    def listen_at_end(*given: Any) -> Any:
        told["at end"] = at_end(*given)
        told["end"] = budget.BASE + sum(told["at end"].values())
        return told["at end"]

    budget.divided, budget.at_end = listen, listen_at_end
    status = main(arguments)
    told |= {"status": status, "held": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024}
    told["predicted"] = max(told["during"], told["end"]) if "begin" in told else None
    print(json.dumps(told))


def plan(arguments: list[str]) -> None:
    """Print what `zonda plan` expects."""
    from zonda.core.configuration.pipeline_file import load
    from zonda.core.plan.planner import plan

    settings = tuple(b for a, b in pairwise(arguments) if a == "--set")
    memory = [b for a, b in pairwise(arguments) if a == "--memory"]
    most = int(memory[0].removesuffix("MB")) * 10**6 if memory else None
    file = load(arguments[0], settings)
    if file.header.campaign is not None:
        from zonda.core.campaign.command import source
        from zonda.core.campaign.prepare import outline

        file = outline(source(arguments[0], settings, False))[1]
    file.look()
    made = plan(file, prune_all=False, threads=THREADS, memory=most, measure=False)
    print(json.dumps({"plan": made.memory}))


def process(what: str, arguments: list[str]) -> dict[str, Any]:
    """The last line of a child process of this script."""
    command = [sys.executable, __file__, f"--{what}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    if found.get("status"):
        found["said"] = done.stderr.strip().splitlines()
    return found


def main() -> None:
    if sys.argv[1:2] in (["--run"], ["--plan"]):
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        {"--run": run, "--plan": plan}[sys.argv[1]](sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", metavar="SCENE")
    parser.add_argument("--parts", action="store_true", help="Print what each step is to hold.")
    options = parser.parse_args()
    print(f"{'MB':42s} plan   run  held  at start  plan/held  run/held")
    for name in options.scenes or SCENES:
        file, more = SCENES[name]
        with tempfile.TemporaryDirectory() as folder:
            if isinstance(file, str):
                (Path(folder) / "p.yaml").write_text(file)
                file = [f"{folder}/p.yaml"]
            planned = process("plan", [*file, *more])["plan"]
            out = ["--output", f"{folder}/out", "--threads", str(THREADS), "--no-prune"]
            found = process("run", ["run", *file, *more, *out])
        if found["status"]:
            print(f"{name:42s} {planned / 1e6:4.0f}  {found.get('said')}")
            continue
        sizes = [planned, *(found[key] for key in ("predicted", "held", "begin"))]
        ratios = [planned / found["held"], found["predicted"] / found["held"]]
        numbers = " ".join(f"{size / 1e6:5.0f}" for size in sizes)
        print(f"{name:41s}{numbers}     {ratios[0]:9.2f} {ratios[1]:9.2f}", flush=True)
        if options.parts:
            parts = found["parts"] | {f"then {k}": v for k, v in found["at end"].items()}
            print(", ".join(f"{k} {v / 1e6:.1f}" for k, v in parts.items() if v > 1e5))


if __name__ == "__main__":
    main()
