"""What planning buys: time, memory and the difference in the map, with and without pruning;
predicted against actual.

    python benchmarks/plan.py                 # all scenes, each run in a process of its own
    python benchmarks/plan.py stare survey    # some

CPU seconds are those of a whole process with its imports and planning, compiled code from the cache
(a first run, not counted, fills it). "plan s" is what planning took of them, most of it imports
that the run needs anyway; "steps s" is the CPU time of the pipeline's steps alone, without imports,
planning and reading.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
SCENES = {
    "stare": HERE / "plan" / "stare.yaml",
    "mustang2_cluster": "mustang2_cluster",
    "atlast_daisy": HERE / "plan" / "atlast_daisy.yaml",
    "survey": HERE / "plan" / "survey.yaml",
}


def one(scene, folder, prune):
    """Run one scene in this process; figures as JSON."""
    from zonda.core.machine import one_blas_thread

    one_blas_thread()
    import zonda

    file = zonda.load(str(SCENES[scene]))
    start = time.process_time()
    made = zonda.plan(file, prune_all=prune, threads=1)
    planning = time.process_time() - start
    file = made.apply(file)
    data = file.pipeline().run(file.scene(), output=folder, threads=1)
    actual = time.process_time()
    timed = {}
    for label, _, seconds in data.provenance["timings"]:
        timed[label] = timed.get(label, 0.0) + seconds
    found = {
        "predicted": made.prediction.total,
        "actual": actual,
        "planning": planning,
        "bytes": made.prediction.bytes,
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "noise": made.noise[1],
        "stages": {k: [v, timed.get(k, 0.0)] for k, v in made.prediction.seconds.items()},
        "steps": sum(timed.values()),
        "decided": [f"{d.name}: {d.choice.what}" for d in made.decided if d.chosen > 0],
        "left_out": [f"{r.run} {r.operator}".strip() for r in made.structure.rows],
    }
    print(json.dumps(found))


def launch(scene, folder, prune):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [
        sys.executable,
        __file__,
        "--one",
        scene,
        "--folder",
        str(folder),
        *([] if prune else ["--no-prune"]),
    ]
    done = subprocess.run(command, check=True, env=environment, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def difference(a, b, noise):
    """rms of the difference of two maps over the rms of the first one's noise, where it is deep."""
    import numpy as np
    from astropy.io import fits

    if not (a / "map.fits").exists() or not (b / "map.fits").exists():
        return None
    with fits.open(a / "map.fits") as one, fits.open(b / "map.fits") as other:
        hits = one["HITS"].data
        deep = hits >= np.quantile(hits[hits > 0], 0.5)
        delta = (one[0].data - other[0].data)[deep]
        return float(np.sqrt(np.nanmean(delta**2) / np.nanmean(one["NOISE"].data[deep] ** 2)))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", choices=[*SCENES, []], help="default: all")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    parser.add_argument("--no-prune", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument(
        "--stages", action="store_true", help="predicted and actual seconds of each operator"
    )
    options = parser.parse_args()
    if options.one:
        one(options.one, Path(options.folder), not options.no_prune)
        return 0
    print(
        f"{'scene':18s} {'':8s} {'CPU s':>7s} {'predicted':>9s} {'pred/act':>8s} "
        f"{'GB':>5s} {'predicted':>9s} {'plan s':>6s} {'steps s':>7s}"
    )
    for scene in options.scenes or SCENES:
        with tempfile.TemporaryDirectory() as temporary:
            folders = [Path(temporary) / "all", Path(temporary) / "plan"]
            launch(scene, Path(temporary) / "first", False)
            for folder, prune in zip(folders, (False, True), strict=True):
                f = launch(scene, folder, prune)
                what = "planned" if prune else "all on"
                print(
                    f"{scene:18s} {what:8s} {f['actual']:7.1f} {f['predicted']:9.1f}"
                    f" {f['predicted'] / f['actual']:8.2f} {f['peak'] / 1e9:5.2f}"
                    f" {f['bytes'] / 1e9:9.2f} {f['planning']:6.1f} {f['steps']:7.1f}"
                )
                if options.stages:
                    for label, (predicted, actual) in f["stages"].items():
                        print(f"    {label:24s} {predicted:7.2f} predicted {actual:7.2f} actual")
            ratio = difference(*folders, f["noise"])
            print(
                "    difference of the maps:"
                f" {'no map asked for' if ratio is None else f'{ratio:.3f} of the noise'}"
            )
            print(
                f"    {'; '.join(f['decided']) or 'nothing coarsened'}; left out:"
                f" {', '.join(f['left_out']) or 'nothing'}"
            )
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
