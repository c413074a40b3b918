"""Memory before it is taken: what streams and blocks of an observation will need, and whether the budget allows it.

By the rules of `layout`, without running anything: where streams are kept, which blocks are cut.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..data import Observation, Stream
from ..errors import PipelineError
from ..machine import available_memory, resident_memory
from ..operator import Operator
from ..plan.planning import planning_of
from .blocks import Segment, cut
from .layout import Layout, read
from .settings import Settings
from .streams import Source, Stage
from .whole import may_have_means

BASE = 230_000_000
"""Bytes of the interpreter, libraries and compiled code."""


@dataclass(frozen=True)
class Forecast:
    """Bytes that streams and blocks will take at once; the least budget that would do; what is kept nowhere or on disk; how many
    times more the operators, by label, act whose streams are made again when they are read."""

    bytes: int
    least: int
    elsewhere: tuple[str, ...] = ()
    again: Mapping[str, int] = dataclasses.field(default_factory=dict)


def forecast(operators: Sequence[Operator], observation: Observation, settings: Settings) -> Forecast:
    """Of one run of these operators (no pointing steps, none that act at the end only) over one observation.

    Raises
    ------
    PipelineError
        Where a stream fits neither in memory nor on the disk and cannot be made again.
    """
    layout = Layout(observation, settings, read(operators), may_have_means(operators))
    segments: list[Segment] = cut(operators, observation)
    source, held, most, least, elsewhere, again = Source(), 0, 0, 0, list[str](), dict[str, int]()
    for number, segment in enumerate(segments):
        later = segments[number + 1 :]
        wanted = set().union(*(o.requires | o.optional for s in later for o in s.operators))
        stage = Stage(segment, source, layout.passed_on(segment, source, wanted))
        new = stage.wanted if segment.halo else stage.wanted - source.streams.keys()
        size = len(new) * layout.stream_size
        if later and new and not layout.keeps(stage, size, held, later):
            how, _ = layout.where(stage, sorted(new), size, held, later, None)
            elsewhere += [f"{name} {'spilled to disk' if how == 'spilled' else 'made again'}" for name in sorted(new)]
            if how == "again":
                readings = layout.readings(later)
                again.update({o.label: max(readings, again.get(o.label, 0)) for o in segment.operators if not o.product_only})
                source = Source({}, stage, stage.wanted)
                continue
            size = 0
        smallest = layout.least_blocks(stage)
        largest = max(layout.largest_blocks(stage, held + size), smallest)
        most, least = max(most, held + size + largest), max(least, smallest)
        held += size if later else 0
        nothing = np.empty((0, 0), settings.dtype)
        source = Source.of({name: Stream(name, observation, nothing, {}, 1) for name in stage.wanted}, {})
    return Forecast(most, least, tuple(elsewhere), again)


def spares(operators: Sequence[Operator], observation: Observation, settings: Settings, size: int) -> bool:
    """Whether streams and blocks do the same with ``size`` bytes less than ``settings.memory``."""
    less = dataclasses.replace(settings, memory=settings.memory - size)
    if less.memory <= 0:
        return False
    try:
        with_all, with_less = (forecast(operators, observation, s) for s in (settings, less))
    except PipelineError:  # a stream would go to a disk that has no room for it
        return False
    return with_less.elsewhere == with_all.elsewhere and with_less.least <= less.memory


def room(
    operators: Sequence[Operator],
    observations: Sequence[Observation],
    settings: Settings,
    budget: int,
    place: str,
    kept: int = 0,
    fresh: bool = True,
) -> tuple[int, int]:
    """Bytes that streams and blocks may take in a process that may hold ``budget``, and bytes of products still to come.

    ``kept``: bytes of products that other runs are derived from. Where the blocks of all threads do not fit, ``settings.threads``
    becomes less: results do not depend on it. ``fresh``: this process holds nothing yet but its libraries.

    Raises
    ------
    PipelineError
        Where the least that a run needs is more than its budget, or more than the machine has: what needs it, and what would
        make it fit.
    """
    longest = max(observations, key=lambda o: o.n_detectors * o.n_samples)
    parts = {"zonda and its libraries": max(resident_memory(), BASE) if fresh else BASE}
    parts.update((o.label, planning_of(o).memory(longest)) for o in operators)
    parts |= {"products to derive runs from": kept} if kept else {}
    fixed = sum(parts.values())
    left = dataclasses.replace(settings, memory=max(budget - fixed, 1))
    found = forecast(operators, longest, left)
    if fixed + found.least > budget and left.threads > 1:
        left.threads = max(1, min(left.threads - 1, (budget - fixed) * left.threads // found.least))
        found = forecast(operators, longest, left)
    if fixed + found.least > budget:
        _refuse(operators, parts, found.least, budget, left.threads, place)
    settings.threads, settings.least = left.threads, found.least
    return left.memory, kept + sum(parts[o.label] for o in operators if o.product_only)


def need(operators: Sequence[Operator], observations: Sequence[Observation], settings: Settings, kept: int = 0) -> int:
    """Least bytes with which a process runs these operators over the observations, on one thread, libraries included.

    ``kept`` as in `room`; ``settings.memory`` plays no part.
    """
    longest = max(observations, key=lambda o: o.n_detectors * o.n_samples)
    one = dataclasses.replace(settings, threads=1)
    return _with_margin(
        BASE + kept + sum(planning_of(o).memory(longest) for o in operators) + forecast(operators, longest, one).least
    )


def _with_margin(size: int) -> int:
    """A size that is to be asked for: what the libraries take differs a little from run to run."""
    return -(-size * 21 // 20_000_000) * 1_000_000


def _refuse(operators: Sequence[Operator], parts: Mapping[str, int], blocks: int, budget: int, threads: int, place: str) -> None:
    need, free = sum(parts.values()) + blocks, available_memory() + resident_memory()
    rows = sorted([*parts.items(), (f"blocks on {threads} thread{'s' if threads > 1 else ''}", blocks)], key=lambda row: -row[1])
    largest = ", ".join(f"{who} {_size(size)}" for who, size in rows[:4] if size > 0.01 * need)
    cures = [f"use --memory {_with_margin(need) // 1_000_000}MB"] if need * 1.05 <= free else []
    cures += [f"{o.label}: {planning_of(o).smaller}" for o in operators if planning_of(o).smaller and parts[o.label] > 0.1 * need]
    if blocks > 0.1 * need and parts["zonda and its libraries"] < budget:
        cures.append("split the scan into shorter ones")
    beyond = f", more than this machine has ({_size(free)})" if need > free else ""
    raise PipelineError(
        f"the run would hold {_size(need)}{beyond}: {largest}; its memory budget is {_size(budget)}",
        place=place,
        cure="; or ".join(cures or ["use a machine with more memory"]),
    )


def _size(size: float) -> str:
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"
