"""From the command to the maps: what a first and a second `zonda run mustang2_cluster` take, stage
by stage.

    python benchmarks/startup.py    # first run with empty caches, then the best of three further runs
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

PIPELINE = "mustang2_cluster"


def stages(folder: str, pipeline: str) -> dict[str, Any]:
    """Run the command in this process; (wall, CPU of this process) by stage."""
    start, begun = (
        float(os.environ["ZONDA_STARTED"]),
        0.0,
    )  # wall clock of the command; CPU counts from nothing
    rows: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    last = [start, begun]

    def mark(stage: str) -> None:
        now = [time.time(), time.process_time()]
        rows[stage][0] += now[0] - last[0]
        rows[stage][1] += now[1] - last[1]
        last[:] = now

    from zonda.core import cli

    def after(module: Any, name: str, stage: str, before: str = "") -> None:
        usual = getattr(module, name)

        def call(*arguments: Any, **named: Any) -> Any:
            if before:
                mark(before)
            try:
                return usual(*arguments, **named)
            finally:
                mark(stage)

        setattr(module, name, call)

    from zonda.core.cli import run

    after(run, "load", "read the pipeline file")
    mark("Python and the command line")
    from zonda.core import pipeline as framework
    from zonda.core.output import Output
    from zonda.core.pipeline import Pipeline
    from zonda.core.plan import planner

    mark("import zonda, numpy, numba, pydantic")
    after(planner, "for_run", "plan")
    usual = framework.execute

    def observe(*arguments: Any) -> None:
        mark("point the telescope, lay out the map")
        usual(*arguments)
        mark("observe")

    framework.execute = observe
    timed = Pipeline._timed

    def finish(self: Any, timer: Any, operator: Any, stage: str, *arguments: Any) -> None:
        timed(self, timer, operator, stage, *arguments)
        if stage == "finalize":
            mark(type(operator).__name__ if isinstance(operator, Output) else "finish the maps")

    Pipeline._timed = finish  # type: ignore[method-assign]
    status = cli.main(["run", pipeline, "--output", folder])
    mark("the rest")
    if status:
        raise SystemExit(status)
    return {"stages": rows}


def child(folder: Path, caches: Path, pipeline: str) -> dict[str, Any]:
    """One run in a process of its own."""
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(caches / "numba"),
        "ZONDA_CACHE_DIR": str(caches / "zonda"),
    }
    result = folder / "result.json"
    begun, used = time.time(), os.times()
    environment["ZONDA_STARTED"] = repr(begun)
    environment.pop(
        "PYTHONDONTWRITEBYTECODE", None
    )  # as of a package that pip has installed: it makes the bytecode
    command = [
        sys.executable,
        __file__,
        "--child",
        str(folder),
        "--pipeline",
        pipeline,
    ]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    wall, now = time.time() - begun, os.times()
    cpu = now.children_user + now.children_system - used.children_user - used.children_system
    return {**json.loads(result.read_text()), "wall": wall, "cpu": cpu}


def table(title: str, run: dict[str, Any]) -> str:
    """One run as Markdown."""
    lines = [f"| {title} | wall s | CPU s |", "|---|---:|---:|"]
    for stage, (wall, cpu) in run["stages"].items():
        if wall >= 0.005:
            lines.append(f"| {stage} | {wall:.2f} | {cpu:.2f} |")
    lines.append(
        f"| **the command, all processes** | **{run['wall']:.2f}** | **{run['cpu']:.2f}** |"
    )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pipeline", default=PIPELINE)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        found = stages(options.child, options.pipeline)
        Path(options.child, "result.json").write_text(json.dumps(found))
        return
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "out")
        folder.mkdir()
        first = child(folder, Path(place, "caches"), options.pipeline)
        runs = [
            child(folder, Path(place, "caches"), options.pipeline) for _ in range(options.repeats)
        ]
        second = min(runs, key=lambda run: run["wall"])
        print(table("First run, nothing compiled", first), table("Second run", second), sep="\n\n")
        compiling = first["wall"] - second["wall"]
        print(f"\nCompilation took {compiling:.1f} s of the first run.")


if __name__ == "__main__":
    main()
