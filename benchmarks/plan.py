"""What planning does in ten scenes, and what it saves: CPU seconds with and without a plan.

    python benchmarks/plan.py                       # all scenes: the table of docs/plan.md
    python benchmarks/plan.py stare deep_field      # some
    python benchmarks/plan.py --forms deep_field    # the CPU time that each coarser form saves alone

CPU seconds are those of whole processes, `zonda run --no-prune` and `zonda run --prune`, imports and
planning included, the best of `--repeat`; a first run, not counted, compiles. The difference of the
maps is relative to their noise. `--forms` runs the steps in one process, in turn with the run in
full, and compares the least times of the step that a form changes: savings as they stand beside the
forms in planning classes (`zonda.core.plan.bounds.Saving`).
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent / "plan"
SCENES = {
    "mustang2_cluster": ("mustang2_cluster", ()),
    "atlast_reduced": ("atlast_reduced", ()),
    "atlast_full": ("atlast_full", ("PointingDaisy.scan_duration=2 s",)),
    "planet": (HERE / "planet.yaml", ()),
    "stare": (HERE / "stare.yaml", ()),
    "survey_night": (HERE / "survey_night.yaml", ()),
    "deep_field": (HERE / "deep_field.yaml", ()),
    "submm": (HERE / "submm.yaml", ()),
    "wide_field": (HERE / "wide_field.yaml", ()),
    "polarized": (HERE / "polarized.yaml", ()),
}
SHORT = {"atlast_reduced": "15 s", "atlast_full": "0.1 s", "survey_night": "40 s",
         "deep_field": "15 s", "planet": "15 s", "stare": "15 s", "submm": "6 s",
         "mustang2_cluster": "8.6 min", "polarized": "60 s"}  # fmt: skip
"""Length of the scan in which forms are compared; what grows with the samples is scaled."""

GROWING = ("exec", "measure", "collect")


def loaded(scene, more=()):
    import zonda

    file, settings = SCENES[scene]
    return zonda.load(str(file), overrides=[*settings, *more])


def cpu(scene, option, folder):
    """CPU seconds of a run in a process of its own."""
    file, settings = SCENES[scene]
    changes = [text for change in settings for text in ("--set", change)]
    command = [sys.executable, "-W", "ignore", "-m", "zonda", "run", str(file), *changes]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [*command, option, "--threads", "1", "--output", str(folder)],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{scene} failed with {option}")
    return used.ru_utime + used.ru_stime


def difference(one, other):
    """Largest rms of the difference of two maps over the rms of the noise, where they are deep."""
    import numpy as np
    from astropy.io import fits

    found = []
    for path in sorted(one.glob("map*.fits")):
        with fits.open(path) as a, fits.open(other / path.name) as b:
            if "HITS" not in a or "NOISE" not in a:
                continue
            hits = a["HITS"].data
            deep = hits >= np.quantile(hits[hits > 0], 0.5)
            delta, noise = (a[0].data - b[0].data)[..., deep], a["NOISE"].data[..., deep]
            found.append(float(np.sqrt(np.nanmean(delta**2) / np.nanmean(noise**2))))
    return f"{max(found):.1g}" if found else "-"


def row(scene, repeat):
    """A row of the table."""
    import zonda
    from zonda.core.plan.planner import PLANNED_FROM
    from zonda.core.plan.pointing import samples_of

    file = loaded(scene)
    made = zonda.plan(file, threads=1)
    samples = samples_of(file.pipeline(), file.scene())
    left_out = made.summary.omitted(file)
    coarse, dropped = [], [f"`{name}` (structure)" for name in left_out]
    for d in made.decided:
        if d.chosen:
            (dropped if d.choice.decision == "dropped" else coarse).append(
                f"{d.effect.name}: {d.choice.what}"
            )
    acting = [o.label for o in file.pipeline().operators if o.label in made.summary.operators]
    with tempfile.TemporaryDirectory() as temporary:
        folders = {option: Path(temporary) / option for option in ("--no-prune", "--prune")}
        cpu(scene, "--no-prune", folders["--no-prune"])
        best = {
            option: min(cpu(scene, option, folder) for _ in range(repeat))
            for option, folder in folders.items()
        }
        apart = difference(*folders.values())
    full, planned = best.values()
    unasked = "planned" if samples >= PLANNED_FROM else "in full"
    return (
        f"| `{scene}` | {samples:.1e} | {unasked} | {len(acting)} of {len(file.steps)} |"
        f" {'; '.join(dropped) or '-'} | {'; '.join(coarse) or '-'} | {full:.1f} | {planned:.1f} |"
        f" {apart} |"
    )


def forms(scene, repeat):
    """What each coarser form saves, in percent of the steps' CPU time in the scene."""
    import warnings

    warnings.simplefilter("ignore")
    import zonda
    from zonda.core.output import Output

    whole = loaded(scene)
    pointing = next(s.key for s in whole.steps if "boresight" in s.operator.provides)
    more = (f"{pointing}.scan_duration={SHORT[scene]}", f"{pointing}.scans=1")
    file = loaded(scene, more if scene in SHORT else ())
    steps = tuple(s for s in file.steps if not isinstance(s.operator, Output))
    file = dataclasses.replace(file, steps=steps)
    made = zonda.plan(file, threads=1, prune_all=False)
    from zonda.core.plan.pointing import samples_of

    factor = samples_of(whole.pipeline(), whole.scene()) / samples_of(file.pipeline(), file.scene())
    variants = {"": made.apply(file)}
    operators = {}
    for d in made.decided:
        for k, choice in enumerate(d.effect.choices[1:], 1):
            name = f"{d.name}: {choice.what}"
            changed = dataclasses.replace(d, chosen=k)
            variants[name] = made.deciding(changed).apply(file)
            operators[name] = d.operator
    least = {name: {} for name in variants}
    for turn in range(repeat + 1):
        for name, variant in variants.items():
            with tempfile.TemporaryDirectory() as folder:
                data = variant.pipeline().run(variant.scene(), output=folder, threads=1)
            for label, stage, used in data.provenance["timings"] if turn else ():
                weighed = used * (factor if stage in GROWING else 1.0)
                key = label.split("@")[0], label, stage
                least[name][key] = min(least[name].get(key, 1e9), weighed)
    total = sum(least[""].values())
    print(f"{scene}: {total:.1f} CPU s in full")
    for name, operator in operators.items():
        mine = [key for key in least[""] if operator in (key[0], "pipeline")]
        saved = sum(least[""][key] - least[name].get(key, 0.0) for key in mine)
        print(f"    {name:70s} {100 * saved / total:5.1f} %", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", choices=[*SCENES, []], help="default: all")
    parser.add_argument("--forms", action="store_true", help="each coarser form by itself")
    parser.add_argument("--repeat", type=int, default=1, help="runs of which the best counts")
    options = parser.parse_args()
    from zonda.core.machine import one_blas_thread

    one_blas_thread()
    if not options.forms:
        print(
            "| scene | samples | `zonda run` | steps | dropped | coarser | CPU s | planned | maps |"
        )
        print("|---|---:|---|---:|---|---|---:|---:|---:|")
    for scene in options.scenes or SCENES:
        if options.forms:
            forms(scene, max(options.repeat, 5))
        else:
            print(row(scene, options.repeat), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
