"""What a second thread gains, beside what two processes gain that do nothing but read and write
memory.

    python benchmarks/threads.py             # M2 and AT-slice
    python benchmarks/threads.py M2 --repeat 5 --profile

One round times, one after the other: the memory stream in one process and in two at once, and the
chain with one thread and with two. Gains are of rates (work per wall second); a machine whose cores
share a memory bus, or that others use too, bounds both. The medians of the rounds are printed.
``--profile``: for each stretch of the chain, wall seconds and threads at work.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import sys
import time
from queue import Empty
from typing import Any

from stages import CASES, pipeline_of, scene_of

PATIENCE = 600
"""Seconds after which a process that has not answered counts as dead."""

STREAM = 1 << 23
"""Numbers in each of the three arrays of the memory stream: 64 MB, beyond any cache."""


def stream(start: Any, done: Any, passes: int) -> None:
    """a = b + 1.5 c over arrays that no cache holds."""
    import numpy as np

    a, b, c = (np.ones(STREAM) for _ in range(3))
    start.wait()
    begin = time.perf_counter()
    for _ in range(passes):
        np.multiply(c, 1.5, out=a)
        np.add(a, b, out=a)
    done.put(time.perf_counter() - begin)


def stream_seconds(processes: int, passes: int = 10) -> float:
    """Wall seconds until the slowest of ``processes`` is done, each with its own stream."""
    context = multiprocessing.get_context("spawn")
    start, done = context.Barrier(processes), context.Queue()
    workers = [context.Process(target=stream, args=(start, done, passes)) for _ in range(processes)]
    for worker in workers:
        worker.start()
    try:
        return max(done.get(timeout=PATIENCE) for _ in workers)
    except Empty:
        raise RuntimeError(
            f"a process has died: exit codes {[worker.exitcode for worker in workers]}"
        ) from None
    finally:
        for worker in workers:
            worker.terminate()
            worker.join()


def chain_seconds(name: str, threads: int) -> float:
    """Wall seconds of one run."""
    chain, scene = pipeline_of(name), scene_of(name)
    begin = time.perf_counter()
    chain.run(scene, threads=threads)
    return time.perf_counter() - begin


def profile(name: str) -> None:
    """Print where one run with two threads uses one alone."""
    from zonda.core.run.execution import Execution

    rows: list[tuple[str, float, float]] = []

    def watched(method: str) -> Any:
        plain = getattr(Execution, method)

        def timed(self: Any, *arguments: Any, **more: Any) -> Any:
            wall, cpu = time.perf_counter(), time.process_time()
            try:
                return plain(self, *arguments, **more)
            finally:
                what = next((a for a in arguments if isinstance(a, str)), "")
                rows.append(
                    (
                        f"{method.strip('_')} {what}",
                        time.perf_counter() - wall,
                        time.process_time() - cpu,
                    )
                )

        return plain, timed

    kept = {}
    for method in ("prepare", "_measure", "_act"):
        kept[method], timed = watched(method)
        setattr(Execution, method, timed)
    wall, cpu = time.perf_counter(), time.process_time()
    pipeline_of(name).run(scene_of(name), threads=2)
    rows.append(("whole run", time.perf_counter() - wall, time.process_time() - cpu))
    for method, plain in kept.items():
        setattr(Execution, method, plain)
    for what, wall, cpu in rows:
        print(f"    {what[:88]:88s} {wall:8.3f} s wall  {cpu / wall:5.2f} threads at work")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("case", nargs="*", help=f"of {', '.join(CASES)}; default: M2 and AT-slice")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    for name in options.case or ["M2", "AT-slice"]:
        pipeline_of(name, short=True).run(scene_of(name), threads=2)  # imports, compilation
        rounds = []
        for _ in range(options.repeat):
            rounds.append(
                (
                    stream_seconds(1),
                    stream_seconds(2),
                    chain_seconds(name, 1),
                    chain_seconds(name, 2),
                )
            )
        one, two, single, double = (
            statistics.median(column) for column in zip(*rounds, strict=True)
        )
        memory, gain = 2 * one / two, single / double
        print(
            f"{name}: two processes of a memory stream gain {memory:.2f}x; two threads of the chain"
            f" {gain:.2f}x",
            end="",
        )
        print(
            f" ({single:.2f} s to {double:.2f} s wall), {gain / memory:.0%} of it; medians of"
            f" {options.repeat}"
        )
        if options.profile:
            profile(name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
