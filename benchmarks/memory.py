"""Memory: what a run was predicted to hold and what it held, over scenes and budgets; and a long
scan against time.

    python benchmarks/memory.py                    # table: scenes x budgets, each in a process of
    its own python benchmarks/memory.py --long 10          # one continuous scan of 10 hours; writes
    docs/memory.png python benchmarks/memory.py --full 4 --memory 6  # 4 s of `atlast_full` in 6 GB:
    rate, and the total for 516 s

Resident memory is that of the whole process, libraries included, as the kernel counts it.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import threading
import time
from importlib.resources import files
from pathlib import Path

SCENES = {
    "M2, 516 s": {"instrument": "mustang2", "scan_duration": "516 s"},
    "M2, 1 h": {"instrument": "mustang2", "scan_duration": "1 h"},
    "M2, 2 h, svd": {
        "instrument": "mustang2",
        "scan_duration": "2 h",
        "method": "svd",
    },  # its stream must be whole: on disk
    "ACT-like, 60 s": {"instrument": "act", "scan_duration": "60 s"},
    # a tile of all detectors is larger than what is copied of it at a time
    "SO LAT, 60 s, svd": {
        "instrument": "so_lat",
        "scan_duration": "60 s",
        "method": "svd",
        "pixel": "1 arcmin",
    },
}
BUDGETS = (0.6, 0.8, 1.2, 4.0)


class Sampler:
    """Resident memory against time, every ``interval`` seconds."""

    def __init__(self, interval: float = 0.5) -> None:
        self.rows: list[tuple[float, float]] = []
        self._interval, self._stop, self._begin = interval, threading.Event(), time.perf_counter()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        from zonda.core.machine import resident_memory

        while not self._stop.is_set():
            self.rows.append((time.perf_counter() - self._begin, resident_memory() / 1e9))
            self._stop.wait(self._interval)

    def stop(self) -> list[tuple[float, float]]:
        self._stop.set()
        self._thread.join()
        return self.rows


def peak_memory():
    """GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def chain(scan_duration, method="mean", pixel="2 arcsec"):
    import zonda

    cluster = (
        files("zonda.pipelines") / "data" / "merging_cluster.fits"
    )  # in an installed package and in this tree
    return zonda.Pipeline(
        [
            zonda.PointingDaisy(
                radius="4 arcmin", speed="50 arcsec/s", scan_duration=scan_duration
            ),
            zonda.SkyMap(file=cluster, centre="target"),
            zonda.AtmosphereLayers(pwv_rms="0.5 %"),
            zonda.WhiteNoise(),
            zonda.PinkNoise(),
            zonda.Efficiency(),
            zonda.HighpassFilter(frequency="0.08 Hz"),
            zonda.CommonModeFilter(method=method),
            zonda.BinMap(pixel=pixel, half_difference=False),
        ]
    )


def scene(instrument):
    import zonda

    return zonda.Scene(
        site="green_bank", instrument=instrument, time="2024-11-25T01:00", target="05h +20d", seed=1
    )


def one(name, budget, threads):
    """Predicted and actual memory of one case, as JSON."""
    import zonda.core.run.budget
    from zonda.core.errors import PipelineError
    from zonda.core.run.budget import divided
    from zonda.core.run.schedule import schedule

    case = dict(SCENES[name])
    where = scene(case.pop("instrument"))
    pipeline = chain(**case)
    told = {}

    def listen(views, settings, *more):
        found = divided(views, settings, *more)
        blocks = schedule(views, found)
        told["predicted"] = (settings.process - found.memory + blocks.bytes) / 1e9
        told["elsewhere"] = ", ".join(blocks.elsewhere)
        return found

    zonda.core.run.budget.divided = listen
    try:
        data = pipeline.run(where, threads=threads, ceiling=int(budget * 1e9))
    except PipelineError as error:
        print(json.dumps({"refused": str(error).splitlines()[0]}))
        return
    n = sum(o.n_detectors * o.n_samples for o in data.observations)
    print(json.dumps({**told, "actual": peak_memory(), "samples": n}))


def table(threads):
    print(f"{'scene':16s} {'budget':>8s} {'predicted':>10s} {'actual':>8s}  streams")
    for name in SCENES:
        for budget in BUDGETS:
            command = [
                sys.executable,
                __file__,
                "--one",
                name,
                "--memory",
                str(budget),
                "--threads",
                str(threads),
            ]
            out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            found = json.loads(out.splitlines()[-1])
            if "refused" in found:
                print(f"{name:16s} {budget:5.1f} GB  refused: {found['refused']}")
                continue
            over = "  OVER THE BUDGET" if found["actual"] > budget else ""
            print(
                f"{name:16s} {budget:5.1f} GB {found['predicted']:7.2f} GB {found['actual']:5.2f}"
                f" GB  {found['elsewhere'] or 'kept'}{over}",
                flush=True,
            )


def report(data, rows, cpu, wall):
    n = sum(o.n_detectors * o.n_samples for o in data.observations)
    for label, stage, seconds in data.provenance["timings"]:
        if seconds > 0.01 * cpu:
            print(f"  {label:18s} {stage:9s} {seconds:9.1f} s {seconds / n * 1e9:7.2f} ns/sample")
    for who, what, text in data.log:
        if who == "Execution":
            print(f"  {what}: {text}")
    print(
        f"  {n:.3e} samples, {cpu:.1f} s of CPU = {cpu / n * 1e9:.1f} ns/sample, {wall:.0f} s wall,"
        f" peak {peak_memory():.2f} GB"
    )
    third = rows[len(rows) // 3 :]
    print(
        f"  resident over the last two thirds: {min(r for _, r in third):.2f} to"
        f" {max(r for _, r in third):.2f} GB"
    )


def run(pipeline, where, threads, memory):
    sampler, cpu, wall = Sampler(), time.process_time(), time.perf_counter()
    data = pipeline.run(where, threads=threads, ceiling=int(memory * 1e9))
    rows = sampler.stop()
    report(data, rows, time.process_time() - cpu, time.perf_counter() - wall)
    return data, rows


def long(hours, threads, memory):
    print(f"MUSTANG-2, one scan of {hours:g} h at 100 Hz, budget {memory:g} GB, {threads} threads")
    data, rows = run(chain(f"{hours} h"), scene("mustang2"), threads, memory)
    draw(
        rows,
        memory,
        f"MUSTANG-2, {hours:g} h in one scan: {data.observations[0].n_samples * 223 / 1e8:.1f}e8"
        " samples",
    )


def draw(rows, memory, title):
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5.5, 2.6), layout="constrained")
    axes.plot(*zip(*rows, strict=True), lw=1)
    axes.axhline(memory, color="0.5", ls="--", lw=0.8)
    axes.text(0, memory, " --memory", va="bottom", size=8, color="0.4")
    axes.set(
        xlabel="wall time (s)", ylabel="resident memory (GB)", ylim=(0, 1.15 * memory), title=title
    )
    axes.title.set_size(9)
    path = Path(__file__).resolve().parents[1] / "docs" / "memory.png"
    figure.savefig(path, dpi=90)
    print(f"  {path}")


def full(seconds, threads, memory):
    from zonda.core.configuration.pipeline_file import load
    from zonda.core.plan.planner import plan

    file = load("atlast_full", (f"PointingDaisy.scan_duration={seconds} s",))
    file = plan(file, threads=threads, memory=int(memory * 1e9)).apply(file)
    steps = [o for o in file.operators if "map_file" not in o.provides]
    import zonda

    print(f"atlast_full, {seconds:g} s of 516 s, budget {memory:g} GB, {threads} threads")
    begin = time.process_time()
    data, _ = run(
        zonda.Pipeline(steps, precision=file.header.precision), file.scene(), threads, memory
    )
    n = sum(o.n_detectors * o.n_samples for o in data.observations)
    whole = (time.process_time() - begin) / n * 9.288e10
    print(f"  516 s would take {whole / 3600:.1f} h of CPU time")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--long", type=float, metavar="HOURS")
    parser.add_argument("--full", type=float, metavar="SECONDS")
    parser.add_argument("--memory", type=float, default=3.0, metavar="GB")
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        one(options.one, options.memory, options.threads)
    elif options.long:
        long(options.long, options.threads, options.memory)
    elif options.full:
        full(options.full, options.threads, options.memory)
    else:
        table(options.threads)
    return 0


if __name__ == "__main__":
    sys.exit(main())
