"""Plans that are kept in the user's cache: a run of the same file with the same program is not
planned again.

What a run takes from a plan is kept in the user's cache folder under a hash of all that the plan
depends on: the resolved file, the options, the input files (place, times, size), every file of the
program, the versions of what it uses, and the processor. Nothing is remembered where other
distributions provide operators, models or tables, whose insides are not known here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from ..configuration.files import paths_in
from ..configuration.pipeline_file import PipelineFile
from ..discovery import HOST, discover, normalized
from ..machine import available_memory, available_threads
from ..storage import user_cache
from ..versions import fingerprint, versions
from .summary import PlanSummary

KIND = "plan"
SUMMARY = TypeAdapter(PlanSummary)
FOREIGN = ("operators", "mapmakers", "noise_models", "spectra", "weather_sources")
"""Groups of entry points whose components decide what a plan says."""


def summary(
    file: PipelineFile,
    *,
    keep: Sequence[str] = (),
    drop: Sequence[str] = (),
    prune_all: bool = True,
    threads: int | None = None,
    memory: int | None = None,
) -> PlanSummary:
    """The summary of `plan`, from the cache where it is there. Arguments and errors as of
    `plan`.
    """
    options = {
        "keep": list(keep),
        "drop": list(drop),
        "prune_all": prune_all,
        "threads": threads or available_threads(),
    }
    key = _key(file, options)
    ceilings = [memory] if memory else _about(available_memory())
    for ceiling in ceilings if key else ():
        with suppress(ValidationError):
            return SUMMARY.validate_python(
                user_cache.recall(KIND, {**(key or {}), "memory": ceiling})
            )
    from .bands import plan

    fresh = plan(
        file, keep=keep, drop=drop, prune_all=prune_all, threads=threads, memory=memory
    ).summary
    if key:
        user_cache.remember(
            KIND, {**key, "memory": ceilings[0]}, SUMMARY.dump_python(fresh, mode="json")
        )
    return fresh


def _about(memory: int) -> list[str]:
    """Free memory to a power of two, and the other that is as near: it says where streams fit, no
    more, and it fluctuates.
    """
    power = math.log2(memory)
    return [
        f"about 2^{k}"
        for k in sorted({round(power - 0.4), round(power + 0.4)}, key=lambda k: abs(k - power))
    ]


def _key(file: PipelineFile, options: Mapping[str, Any]) -> dict[str, Any] | None:
    """All that the plan depends on; None: not known."""
    if any(
        normalized(found.distribution) != HOST
        for group in FOREIGN
        for found in discover(f"zonda.{group}")
    ):
        return None
    if any(type(o).__module__.partition(".")[0] != HOST for o in file.operators):
        return None
    try:
        files = [
            (str(p), *_state(p)) for p in sorted(set(paths_in([file.scene(), *file.operators])))
        ]
    except OSError:
        return None  # the plan will say what is wrong with it
    return {
        "file": file.resolved_yaml(),
        "options": options,
        "inputs": files,
        "program": fingerprint(),
        "versions": versions(),
        "processor": user_cache.processor(),
    }


def _state(path: Path) -> tuple[int, ...]:
    """What changes with a file's content: its times, the second of which nobody sets (``cp -p``,
    ``touch -r``), and its size.
    """
    state = path.stat()
    return state.st_mtime_ns, state.st_ctime_ns, state.st_ino, state.st_size
