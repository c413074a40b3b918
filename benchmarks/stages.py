"""What the chain costs, stage by stage: ns per sample, CPU seconds, peak memory, against what was
asked for.

    python benchmarks/stages.py            # all cases, each in a process of its own
    python benchmarks/stages.py M2         # one case
    python benchmarks/stages.py M2 --threads 2 --repeat 5
    python benchmarks/stages.py M2 --prototypes FOLDER   # beside the prototypes' chain, run by
    turns in the same process

The reference is numpy drawing as many float32 normal deviates (``Generator.standard_normal``), the
least that any simulation of detector noise does with that library: ratios to it compare machines.
CPU seconds are those of the whole process, all threads, after imports and compilation (a run of a
few seconds of data beforehand). Medians of the repeats, with the range for the whole chain: on a
machine that does other work too, the least is the nearest to the truth.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import subprocess
import sys
import time
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

from zonda.core.machine import one_blas_thread

one_blas_thread()  # as `zonda run` does: idle threads of BLAS take CPU time


@dataclass(frozen=True)
class Case:
    """A scan, and the CPU seconds and memory [GB] that its chain may take (0: no limit).

    ``instrument``: changes of the named one. ``steps``: parameters of operators by class.
    """

    about: str
    scene: dict[str, str]
    pointing: dict[str, str]
    cpu: float = 0.0
    memory: float = 0.0
    instrument: dict[str, object] = field(default_factory=dict)
    steps: dict[str, dict[str, object]] = field(default_factory=dict)


GREEN_BANK = {
    "site": "green_bank",
    "instrument": "mustang2",
    "time": "2024-11-25T07:00",
    "target": "05h +20d",
}
CHAJNANTOR = {"site": "llano_de_chajnantor", "time": "2022-08-01T23:00", "target": "260d -10d"}
M2_DAISY = {"radius": "4 arcmin", "speed": "50 arcsec/s"}
M2_STEPS: dict[str, dict[str, object]] = {
    "AtmosphereLayers": {"pwv": "7.7 mm", "pwv_rms": "0.5 %"},
    "HighpassFilter": {"frequency": "0.08 Hz"},
    "BinMap": {"pixel": "2 arcsec", "width": "15 arcmin"},
}
AT_STEPS: dict[str, dict[str, object]] = {
    "AtmosphereLayers": {"pwv_rms": "5 %", "highest": "3000 m"},
    "HighpassFilter": {"frequency": "0.5 Hz"},
    "BinMap": {"pixel": "4 arcsec"},
}

CASES = {
    "M2": Case(
        "223 detectors x 100 Hz x 516 s, one scan",
        GREEN_BANK,
        {**M2_DAISY, "scan_duration": "516 s", "sample_rate": "100 Hz"},
        1.5,
        1.0,
        steps=M2_STEPS,
    ),
    "M2-45min": Case(
        "223 detectors x 50 Hz x 45 min, one scan",
        GREEN_BANK,
        {**M2_DAISY, "scan_duration": "45 min", "sample_rate": "50 Hz"},
        3.0,
        1.0,
        steps=M2_STEPS,
    ),
    "AT-slice": Case(
        "AtLAST's reduced camera, 3000 detectors x 225 Hz x 30 s",
        {**CHAJNANTOR, "instrument": "atlast"},
        {"radius": "0.25 deg", "speed": "0.45 deg/s", "scan_duration": "30 s"},
        steps=AT_STEPS,
    ),
    "LAT": Case(
        "6 m, 7.8 deg, 2000 detectors x 200 Hz x 60 s",
        {**CHAJNANTOR, "instrument": "so_lat"},
        {"radius": "3 deg", "speed": "1 deg/s", "scan_duration": "60 s", "sample_rate": "200 Hz"},
        instrument={"detectors": 2000, "field_of_view": math.radians(7.8)},
        steps={**AT_STEPS, "BinMap": {"pixel": "1 arcmin"}},
    ),
    "FULL-slice": Case(
        "AtLAST's full field of 2 deg at 900 Hz, 1024 of its detectors x 20 s",
        {**CHAJNANTOR, "instrument": "atlast"},
        {"radius": "1 deg", "speed": "0.9 deg/s", "scan_duration": "20 s", "sample_rate": "900 Hz"},
        instrument={"detectors": 1024, "field_of_view": math.radians(2)},
        steps={**AT_STEPS, "BinMap": {"pixel": "4 arcsec"}},
    ),
}

BARS = {
    "atmosphere": (["AtmosphereLayers"], 0.5),
    "white and pink noise": (["WhiteNoise", "PinkNoise"], 3.5),
    "sky, cubic B-spline": (["SkyMap"], 9.4),
    "high-pass": (["HighpassFilter"], 2.1),
    "common mode": (["CommonModeFilter"], 1.5),
    "binning": (["BinMap"], 2.5),
}
"""What prototypes reached on a quiet 2.x GHz Sapphire Rapids core (AVX-512), ns per sample; 1.5
times that is a fair bar.

The bar of another machine is 1.5 times what the prototypes reach there (``--prototypes``)."""


def scene_of(name):
    """What a case observes."""
    import zonda

    case = CASES[name]
    scene = zonda.Scene(**case.scene, seed=1)
    if case.instrument:
        scene = scene.model_copy(
            update={"instrument": scene.instrument.model_copy(update=case.instrument)}
        )
    return scene


def pipeline_of(name, short=False, **pointing):
    """A case's chain; ``short``: of 10 s, to compile it."""
    import zonda

    case = CASES[name]
    cluster = (
        files("zonda.pipelines") / "data" / "merging_cluster.fits"
    )  # in an installed package and in this tree
    pointing = {**case.pointing, **pointing, **({"scan_duration": "10 s"} if short else {})}
    kinds = [
        "AtmosphereLayers",
        "WhiteNoise",
        "PinkNoise",
        "Efficiency",
        "HighpassFilter",
        "CommonModeFilter",
        "BinMap",
    ]
    steps = [getattr(zonda, kind)(**case.steps.get(kind, {})) for kind in kinds]
    sky = zonda.SkyMap(file=cluster, centre="target")
    return zonda.Pipeline([zonda.PointingDaisy(**pointing, check_limits="warn"), sky, *steps])


def peak_memory():
    """GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def reference(repeat):
    """Seconds per float32 normal deviate of numpy."""
    import numpy as np

    rng, buffer, times = np.random.default_rng(1), np.empty(1 << 20, np.float32), []
    for _ in range(repeat):
        cpu = time.process_time()
        rng.standard_normal(out=buffer, dtype=np.float32)
        times.append((time.process_time() - cpu) / buffer.size)
    return float(np.median(times))


def verdict(value, limit):
    if not limit:
        return "no limit"
    return f"{value / limit:5.2f} of the limit" + ("" if value <= limit else ": MISSED")


def measure(name, threads, repeat, prototypes=None):
    import numpy as np
    from prototypes import Prototype

    case = CASES[name]
    scene = scene_of(name)
    pipeline_of(name, short=True).run(scene, threads=threads)  # imports, compilation
    before = peak_memory()
    chain, totals, walls, runs, theirs = pipeline_of(name), [], [], [], []
    prototype = Prototype(prototypes, name) if prototypes else None
    if prototype and prototype.absent:
        print(f"{name}: without prototypes: {prototype.absent}")
        prototype = None
    for _ in range(repeat):
        cpu, wall = time.process_time(), time.perf_counter()
        data = chain.run(scene, threads=threads)
        totals.append(time.process_time() - cpu)
        walls.append(time.perf_counter() - wall)
        runs.append(
            {(label, stage): seconds for label, stage, seconds in data.provenance["timings"]}
        )
        if prototype:
            theirs.append(prototype.stages())
    peak, per = peak_memory(), reference(3 * repeat)
    n = data.observations[0].n_detectors * data.observations[0].n_samples
    stages = {key: float(np.median([r.get(key, 0.0) for r in runs])) for key in runs[0]}
    total = float(np.median(totals))
    rest = float(np.median([t - sum(r.values()) for t, r in zip(totals, runs, strict=True)]))

    def row(what, seconds, more=""):
        print(
            f"  {what:34s} {seconds:8.3f} {seconds / n * 1e9:10.2f} {seconds / n / per:12.2f}{more}"
        )

    print(
        f"\n{name}: {case.about} = {n / 1e6:.1f} M samples; {threads} thread(s), median of {repeat}"
    )
    print(f"  {'stage':34s} {'CPU s':>8s} {'ns/sample':>10s} {'x reference':>12s}")
    for (label, stage), seconds in stages.items():
        if seconds > 5e-4:
            row(f"{label} {stage}", seconds)
    row("everything else", rest)
    row("whole chain", total, f"   {min(totals):.3f} to {max(totals):.3f} s")

    def together(labels, run):
        return (
            sum(
                s
                for (label, stage), s in run.items()
                if label in labels and stage in ("exec", "measure")
            )
            / n
            * 1e9
        )

    print(
        f"\n  {'exec and measure together, ns/sample':38s} {'median':>6s} {'least':>6s}"
        f" {'bar':>6s}",
        end="",
    )
    print(f" {'prototype, least':>18s} {'ratio':>6s}" if prototype else "")
    for what, (labels, best) in BARS.items():
        times = [together(labels, run) for run in runs]
        least, bar = min(times), 1.5 * best
        line = f"  {what:38s} {np.median(times):6.2f} {least:6.2f} {bar:6.2f}"
        if prototype:
            bar = 1.5 * min(t[what] for t in theirs)
            line += f" {bar / 1.5:18.2f} {1.5 * least / bar:6.2f}"
        print(line + ("" if least <= bar else "  above"))
    print(
        f"\n  CPU {total:.3f} s of {case.cpu:g} s: {verdict(total, case.cpu)}; wall"
        f" {np.median(walls):.3f} s"
    )
    print(
        f"  peak memory {peak:.2f} GB ({before:.2f} GB before) of {case.memory:g} GB:"
        f" {verdict(peak, case.memory)}"
    )
    print(
        f"  reference: numpy float32 normals {per * 1e9:.2f} ns/sample; load of the machine"
        f" {os.getloadavg()[0]:.1f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("case", nargs="*", choices=[*CASES, []], help="default: all")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--prototypes", type=Path, help="folder of the prototypes' research code")
    options = parser.parse_args()
    if len(options.case) == 1:
        measure(options.case[0], options.threads, options.repeat, options.prototypes)
        return 0
    for case in options.case or CASES:
        arguments = [case, "--threads", str(options.threads), "--repeat", str(options.repeat)]
        arguments += ["--prototypes", str(options.prototypes)] if options.prototypes else []
        subprocess.run([sys.executable, __file__, *arguments], check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
