"""The memory of a process, divided among operators, streams and blocks, bands, and scans prepared
ahead.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..assembly.chain import Chain
from ..errors import PipelineError
from ..machine import available_memory, resident_memory
from ..mapmaker import joins, makes_products
from ..plan.planning import planning_of
from .prefetch import Ahead
from .schedule import Schedule, does_the_same, schedule
from .settings import Settings, megabytes
from .views import Band, View

BASE = 230_000_000
"""Bytes of the interpreter, libraries and compiled code."""


KEPT = "kept streams"
OTHERS = "maps of other bands"
FEWER = "keep fewer streams, of fewer or shorter scans"


def divide(
    bands: Sequence[Band],
    settings: Settings,
    ahead: Ahead,
) -> list[tuple[Sequence[Band], Settings]]:
    """Bands that are executed together, and the settings with their memory.

    All are executed together if a step joins them, or if their detectors look through the same
    pixels and streams are kept where they would be kept for a band alone. Else each has what the
    products of the others leave.

    Parameters
    ----------
    ahead
        Is turned off where there is no room for a scan that is prepared while another is executed.
    """
    groups = _groups(bands, settings, ahead)
    least, threads = min(own.threads for _, own in groups), settings.threads
    for these, own in groups:
        for band in these:
            band.data.threads = own.threads
    if least < threads and settings.fresh:
        text = f"{least} of {threads} threads work: more do not fit in the memory budget"
        warnings.warn(f"{settings.place}: {text}", stacklevel=5)
    return groups


def _groups(
    bands: Sequence[Band],
    settings: Settings,
    ahead: Ahead,
) -> list[tuple[Sequence[Band], Settings]]:
    """Groups of bands for `divide`, with their settings; nothing is warned of."""
    views = [band.longest for band in bands]
    every = [o for band in bands for o in band.data.observations]
    size = np.dtype(settings.dtype).itemsize
    kept = size * len(bands[0].chain.keep) * sum(o.n_detectors * o.n_samples for o in every)
    if len(bands) > 1 and any(map(joins, bands[0].chain.steps)):
        return [(bands, _shared(views, settings, ahead, kept))]
    held = [memory_of([view], products=True) for view in views]
    alone = [
        _shared([view], settings, ahead, kept, sum(held) - mine)
        for view, mine in zip(views, held, strict=True)
    ]
    if Schedule(views, settings).at_once > 1:
        with suppress(PipelineError):  # not all of them fit at once
            together = _shared(views, settings, ahead, kept)
            single = [schedule([view], own) for view, own in zip(views, alone, strict=True)]
            if does_the_same(views, together, single):
                return [(bands, together)]
    return [([band], own) for band, own in zip(bands, alone, strict=True)]


def _shared(
    views: Sequence[View],
    settings: Settings,
    ahead: Ahead,
    kept: int,
    others: int = 0,
) -> Settings:
    """Divide the memory of bands that are executed together; ``kept``, ``others``: as in
    `divided`.
    """
    if settings.asked and settings.process is None:
        free = available_memory()
        if kept > free:
            text = f"the kept streams would take {_size(kept)}, {_size(free)} are free"
            raise PipelineError(text, place=settings.place, cure=FEWER)
        return settings
    found = divided(views, settings, kept, others)
    if settings.asked:
        found = replace(found, memory=min(settings.memory, found.memory))
    if ahead.on:
        less = with_scan_ahead(views, found)
        ahead.on, found = less is not None, less or found
    return found


def divided(views: Sequence[View], settings: Settings, kept: int = 0, others: int = 0) -> Settings:
    """Divide the memory of a process: the settings with that of streams and blocks, and with fewer
    threads where the blocks of all do not fit.

    Results depend on neither.

    Parameters
    ----------
    views
        The longest scan, with the bands that are executed together.
    settings
        ``process``: bytes that the process may hold; None: what it holds and half of the free
        memory.
    kept, others
        Bytes of streams that the user keeps, and of the products of other bands.

    Raises
    ------
    PipelineError
        Where the least that a run needs is more than its budget, or more than the machine has: what
        needs it, and what would make it fit.
    """
    budget = settings.process or resident_memory() + available_memory() // 2
    parts = {"zonda and its libraries": max(resident_memory(), BASE) if settings.fresh else BASE}
    parts |= {KEPT: kept, OTHERS: others}
    for view in views:
        for o in view.chain.steps:
            parts[o.label] = parts.get(o.label, 0) + planning_of(o).memory(view.observation)
    fixed = sum(parts.values())
    left = replace(settings, memory=max(budget - fixed, 1))
    found = schedule(views, left)
    if fixed + found.least > budget and left.threads > 1:
        threads = min(left.threads - 1, (budget - fixed) * left.threads // found.least)
        left = replace(left, threads=max(1, threads))
        found = schedule(views, left)
    if fixed + found.least > budget:
        _refuse(views[0].chain, parts, found.least, budget, left)
    return replace(left, process=budget)


def memory_of(views: Sequence[View], products: bool = False) -> int:
    """Bytes that the steps hold for a scan with some bands, besides streams and blocks;
    ``products``: what they add up over all scans alone.
    """
    return sum(
        planning_of(o).memory(view.observation)
        for view in views
        for o in view.chain.steps
        if makes_products(o) or not products
    )


def with_scan_ahead(views: Sequence[View], settings: Settings) -> Settings | None:
    """The settings without what a scan holds that is prepared while another is executed; None where
    there is no room for it.
    """
    size = memory_of(views) - memory_of(views, products=True)
    less = replace(settings, memory=settings.memory - size)
    same = less.memory > 0 and does_the_same(views, less, [schedule(views, settings)])
    return less if same else None


def least_memory(views: Sequence[View], settings: Settings) -> int:
    """Bytes with which a process runs a scan with these bands on one thread, libraries included."""
    one, products = replace(settings, threads=1), memory_of(views, products=True)
    joined = any(map(joins, views[0].chain.steps))
    need = max(
        memory_of(group) + products - memory_of(group, products=True) + schedule(group, one).least
        for group in ([views] if joined else [[view] for view in views])
    )
    return megabytes(BASE + need) * 1_000_000


def _refuse(
    chain: Chain,
    parts: Mapping[str, int],
    blocks: int,
    budget: int,
    settings: Settings,
) -> None:
    threads = settings.threads
    need, free = sum(parts.values()) + blocks, available_memory() + resident_memory()
    rows = sorted(
        [*parts.items(), (f"blocks on {threads} thread{'s' if threads > 1 else ''}", blocks)],
        key=lambda row: -row[1],
    )
    largest = ", ".join(f"{who} {_size(size)}" for who, size in rows[:4] if size > 0.01 * need)
    cures = [f"use --memory {megabytes(need)}MB"] if need * 1.05 <= free else []
    smaller = {KEPT: FEWER} | {o.label: planning_of(o).smaller for o in chain.steps}
    own = need - parts["zonda and its libraries"]  # the process may hold more of other work
    cures += [
        f"{label}: {how}" for label, how in smaller.items() if how and parts[label] > 0.1 * own
    ]
    if blocks > 0.1 * need and parts["zonda and its libraries"] < budget:
        cures.append("split the scan into shorter ones")
    beyond = f", more than this machine has ({_size(free)})" if need > free else ""
    raise PipelineError(
        f"the run would hold {_size(need)}{beyond}: {largest}; its memory budget is"
        f" {_size(budget)}",
        place=settings.place,
        cure="; or ".join(cures or ["use a machine with more memory"]),
    )


def _size(size: float) -> str:
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"
