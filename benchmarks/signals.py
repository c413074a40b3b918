"""What further signals cost: `python benchmarks/signals.py [PIPELINE] [--set KEY=VALUE] [--threads
N] [--repeat N]`.

CPU and wall seconds of the scans (least of the repetitions, compiled before), without spectra,
files, plots and report, for the complete signal alone and with others beside it, in turn; peak
memory of a process of its own. It uses nothing that 0.1.0 lacks: to compare two versions, run the
same file by turns with the Python of each.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
import warnings

SKY, REST = {"only": ["sky"], "modes": "full"}, {"without": ["sky"], "modes": "full"}
CASES = {
    "the complete signal alone": {},
    "with noiseless and source_free": {"noiseless": SKY, "source_free": REST},
    "with noiseless, own modes": {"noiseless": {"only": ["sky"]}},
    "with noiseless and an unfiltered sky": {
        "noiseless": SKY,
        "raw": {"only": ["sky"], "filters": "none"},
    },
}
LEFT_OUT = {
    "SaveMap",
    "SaveTOD",
    "Plots",
    "Report",
    "PowerSpectrum",
    "TimeStreams",
    "TransferFunction",
}


def one(case: str, options: argparse.Namespace) -> None:
    """Print the figures of one case as JSON."""
    from zonda.core.configuration.pipeline_file import load
    from zonda.core.pipeline import Pipeline

    warnings.simplefilter("ignore")
    file = load(options.pipeline, tuple(options.set))
    steps = [o for o in file.operators if type(o).__name__ not in LEFT_OUT]
    pipeline = Pipeline(steps, runs=CASES[case], precision=file.header.precision)
    times = []
    for _ in range(1 + options.repeat):
        cpu, wall = time.process_time(), time.perf_counter()
        pipeline.run(file.scene(), threads=options.threads, memory=8 * 10**9)
        times.append((time.process_time() - cpu, time.perf_counter() - wall))
    cpu, wall = (min(column) for column in zip(*times[1:], strict=True))
    print(json.dumps([cpu, wall, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3]))


def main() -> None:
    """A row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pipeline", nargs="?", default="mustang2_cluster")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--case", choices=CASES, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        one(options.case, options)
        return
    for case in CASES:
        command = [sys.executable, __file__, *sys.argv[1:], "--case", case]
        cpu, wall, memory = json.loads(
            subprocess.run(command, capture_output=True, text=True, check=True).stdout
        )
        print(f"{case:38} {cpu:6.2f} s CPU {wall:6.2f} s wall {memory:6.0f} MB")


if __name__ == "__main__":
    main()
