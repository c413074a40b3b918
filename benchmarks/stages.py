"""What the chain costs, stage by stage: ns per sample, CPU seconds, peak memory, as ratios to a reference in the same run.

    python benchmarks/stages.py            # all cases, each in a process of its own
    python benchmarks/stages.py M2         # one case
    python benchmarks/stages.py M2 --threads 2 --repeat 5

The reference is numpy drawing as many float32 normal deviates (``Generator.standard_normal``), the least that any simulation
of detector noise does with that library. CPU seconds are those of the whole process, all threads, after imports and
compilation (a run of a few seconds of data beforehand); the median of the repeats is printed.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

CASES = {
    "M2": ("223 detectors x 100 Hz x 516 s, one scan", {"scan_duration": "516 s", "sample_rate": "100 Hz"}),
    "M2-45min": ("223 detectors x 50 Hz x 45 min, one scan", {"scan_duration": "45 min", "sample_rate": "50 Hz"}),
}


def pipeline(pointing):
    import zonda

    cluster = Path(zonda.__file__).resolve().parents[1] / "pipelines" / "data" / "merging_cluster.fits"
    return zonda.Pipeline(
        [
            zonda.PointingDaisy(radius="4 arcmin", speed="50 arcsec/s", **pointing),
            zonda.SkyMap(file=cluster),
            zonda.AtmosphereLayers(pwv="7.7 mm", pwv_rms="0.5 %"),
            zonda.WhiteNoise(),
            zonda.PinkNoise(),
            zonda.Efficiency(),
            zonda.HighpassFilter(frequency="0.08 Hz"),
            zonda.CommonModeFilter(modes=1),
            zonda.BinMap(pixel="2 arcsec", width="15 arcmin"),
        ]
    )


def measure(case: str, threads: int, repeat: int) -> None:
    import numpy as np

    import zonda

    about, pointing = CASES[case]
    scene = zonda.Scene(site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=1)
    pipeline({**pointing, "scan_duration": "30 s"}).run(scene, threads=threads)  # imports, compilation
    baseline = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    chain, totals, walls, runs = pipeline(pointing), [], [], []
    for _ in range(repeat):
        cpu, wall = time.process_time(), time.perf_counter()
        data = chain.run(scene, threads=threads)
        totals.append(time.process_time() - cpu)
        walls.append(time.perf_counter() - wall)
        runs.append({(label, stage): seconds for label, stage, seconds in data.provenance["timings"]})
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    n = data.observations[0].n_detectors * data.observations[0].n_samples
    rng, buffer = np.random.default_rng(1), np.empty(1 << 20, np.float32)
    reference = []
    for _ in range(3 * repeat):
        cpu = time.process_time()
        rng.standard_normal(out=buffer, dtype=np.float32)
        reference.append((time.process_time() - cpu) / buffer.size)
    per = float(np.median(reference))
    total = float(np.median(totals))
    print(f"\n{case}: {about} = {n / 1e6:.1f} M samples; {threads} thread(s), median of {repeat}")
    print(f"  {'stage':34s} {'CPU s':>8s} {'ns/sample':>10s} {'x reference':>12s}")
    stages = {key: float(np.median([r.get(key, 0.0) for r in runs])) for key in runs[0]}
    for (label, stage), seconds in stages.items():
        if seconds > 5e-4:
            print(f"  {label + ' ' + stage:34s} {seconds:8.3f} {seconds / n * 1e9:10.2f} {seconds / n / per:12.2f}")
    rest = total - sum(stages.values())
    print(f"  {'everything else':34s} {rest:8.3f} {rest / n * 1e9:10.2f} {rest / n / per:12.2f}")
    print(f"  {'whole chain':34s} {total:8.3f} {total / n * 1e9:10.2f} {total / n / per:12.2f}")
    print(f"  wall {np.median(walls):.3f} s; peak memory {peak:.2f} GB, of which {baseline:.2f} GB before the first run")
    print(f"  reference: numpy float32 normals {per * 1e9:.2f} ns/sample")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", nargs="*", choices=[*CASES, []], help="default: all")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    if len(options.case) == 1:
        measure(options.case[0], options.threads, options.repeat)
        return 0
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    for case in options.case or CASES:
        arguments = [case, "--threads", str(options.threads), "--repeat", str(options.repeat)]
        subprocess.run([sys.executable, __file__, *arguments], check=True, env=environment)
    return 0


if __name__ == "__main__":
    sys.exit(main())
