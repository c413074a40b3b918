"""What a campaign costs beside its observations: seconds per task, and memory against the number of
tasks done.

    python benchmarks/campaign.py                       # 1000 tiny observations, two worker
    processes python benchmarks/campaign.py --tasks 200 --engine serial --plot memory.png

The observations are 19 detectors x 100 samples, so that nearly all of the time is the campaign's
own: sending tasks, their state, partial products. Resident memory of the main process and of the
largest worker is noted at every task.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path

from zonda.core.campaign.campaign_file import Job
from zonda.core.campaign.folder import Record
from zonda.core.cli import main as zonda
from zonda.core.hooks import hookimpl, manager

YAML = """\
site: green_bank
instrument: {{name: cam, telescope: {{name: dish, diameter: 100 m}}, band: {{name: b, low: 80 GHz, high: 100 GHz}}, detectors: 19,
  field_of_view: 2 arcmin, fwhm: 9 arcsec, main_beam_efficiency: 0.3, illumination_efficiency: 0.8, net: 1 mK s(1/2),
  sample_rate: 50 Hz}}
time: 2024-11-25T07:00
target: 05h00m00s +20d00m00s
campaign: {{realizations: {tasks}}}
operators:
  - PointingDaisy: {{radius: 1 arcmin, speed: 50 arcsec/s, scan_duration: 2 s}}
  - WhiteNoise
  - Efficiency
  - BinMap: {{pixel: 4 arcsec}}
  - SaveMap
"""


def memory(process, key):
    """Resident memory of a process, bytes: now (VmRSS), or at its peak (VmHWM)."""
    status = Path(f"/proc/{process}/status").read_text().splitlines()
    return 1024 * int(next(line for line in status if line.startswith(key)).split()[1])


class Watch:
    """Notes time and memory at every task: of the main process, and the peak of the largest worker
    (of the main process where there is none).
    """

    def __init__(self):
        self.rows = []

    @hookimpl
    def zonda_campaign_progress(self, done):
        workers = [child.pid for child in multiprocessing.active_children()] or ["self"]
        peaks = [memory(worker, "VmHWM") for worker in workers]
        self.rows.append((time.monotonic(), memory("self", "VmRSS"), max(peaks)))


def main(arguments):
    parser = argparse.ArgumentParser()
    parser.add_argument("--tasks", type=int, default=1000)
    parser.add_argument("--engine", default="processes")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args(arguments)
    watch = Watch()
    manager().register(watch)
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "tiny.yaml", Path(folder) / "out"
        path.write_text(YAML.format(tasks=given.tasks))
        options = ["--workers", str(given.workers)] if given.engine == "processes" else []
        begin, cpu = time.monotonic(), time.process_time()
        status = zonda(["run", str(path), "--output", str(out), "--engine", given.engine, *options])
        wall, cpu = time.monotonic() - begin, time.process_time() - cpu
        if status:
            return status
        inside = [row.seconds for row in Record(Job.read(out), out).rows()]
    rows = watch.rows
    skip = min(len(rows) // 10, 50)  # while workers start and compile
    n, span = len(rows) - skip - 1, rows[-1][0] - rows[skip][0]
    print(
        f"{len(rows)} tasks in {wall:.1f} s with planning and combining, {cpu:.1f} s of CPU time of"
        " the main process"
    )
    print(
        f"{1e3 * span / n:.1f} ms a task, of which {1e3 * sum(inside[skip + 1 :]) / n:.1f} ms in"
        " the task itself on each worker"
    )
    for k in [*range(skip, len(rows), max(1, len(rows) // 10)), len(rows) - 1]:
        main_now, worker = rows[k][1] / 1e6, max(r[2] for r in rows[: k + 1]) / 1e6
        print(f"{k + 1:>6} tasks  main {main_now:6.1f} MB  worker at most {worker:6.1f} MB")
    if given.plot:
        plot(rows, given.plot)
    return 0


def plot(rows, path):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    ax = figure.add_subplot()
    done = range(1, len(rows) + 1)
    ax.plot(done, [r[1] / 1e6 for r in rows], label="main process")
    ax.plot(done, [r[2] / 1e6 for r in rows], ".", markersize=2, label="worker, largest so far")
    ax.set_xlabel("tasks done")
    ax.set_ylabel("resident memory [MB]")
    ax.set_ylim(0)
    ax.legend(frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
