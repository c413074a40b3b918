"""The memory of a process, divided among operators, streams and blocks, bands, and scans prepared
ahead.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..errors import PipelineError
from ..machine import available_memory, resident_memory
from ..mapmaker import joins, makes_products
from ..operator import Operator
from ..output import Output
from ..plan.planning import planning_of
from .schedule import Schedule, does_the_same, schedule
from .settings import Ahead, Settings, megabytes
from .streams import Files
from .views import Band, View

BASE = 240_000_000
"""Bytes of the interpreter, libraries, compiled code, and what the allocator keeps."""

LIBRARIES = "zonda and its libraries"
PRODUCTS = "products"
ON_DISK = "pages of streams on disk"
BLOCKS = "blocks on 1 thread"
KEPT = "kept streams"
OTHERS = "maps of other bands"
FEWER = "keep fewer streams, of fewer or shorter scans"


def files_of(budget: int) -> Files:
    """Files for products that take more than a quarter of what a process may hold, libraries
    apart: streams take half, and products are copied when they are finished.
    """
    return Files(max(budget - BASE, 0) // 4)


def at_end(views: Sequence[View], outputs: Sequence[Operator]) -> dict[str, int]:
    """Bytes after the last scan, by what holds them: the products while they are finished, band
    after band, or finished ones with the outputs that act on them, whichever is more.
    """
    each = list[tuple[int, int, int]]()
    pixels = 0
    for view in views:
        makers = [planning_of(o) for o in view.chain.steps if makes_products(o)]
        pixels = max([pixels, *(maker.pixels for maker in makers)])
        sizes = [(m.memory(view.observation), *m.finished(view.observation)) for m in makers]
        each.append((sum(s[0] for s in sizes), sum(s[1] for s in sizes), sum(s[2] for s in sizes)))
    work = 0
    kept = 0
    before = sum(sums for sums, _, _ in each)
    for sums, finishing, product in each:
        work = max(work, kept + before - sums + finishing)
        kept = kept + product
        before = before - sums
    acting = {o.label: planning_of(o) for o in outputs}
    parts = {label: planning.memory(views[0].observation) for label, planning in acting.items()}
    if acting:
        most = max(acting, key=lambda label: acting[label].per_pixel)
        parts[most] += acting[most].per_pixel * pixels
    parts |= {PRODUCTS: kept}
    return parts if sum(parts.values()) > work else {PRODUCTS: work}


def check_end(bands: Sequence[Band], operators: Sequence[Operator], settings: Settings) -> None:
    """Refuse a run (PipelineError) whose products would not fit when they are finished and written;
    ``operators``: all steps.
    """
    if settings.asked and settings.process is None:
        return
    views = [band.longest for band in bands]
    outputs = [o for o in operators if isinstance(o, Output)]
    every = [o for view in views for o in view.chain.steps] + outputs
    budget = settings.process or resident_memory() + available_memory() // 2
    parts = {LIBRARIES: BASE} | at_end(views, outputs)
    if sum(parts.values()) > budget:
        raise _refused(every, parts, budget, settings)


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
    least = min(own.threads for _, own in groups)
    threads = settings.threads
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
    products = [memory_of([view], settings.threads, products=True) for view in views]
    alone = [
        _shared([view], settings, ahead, kept, sum(products) - mine)
        for view, mine in zip(views, products, strict=True)
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
    base = {LIBRARIES: max(resident_memory(), BASE) if settings.fresh else BASE}
    base |= {KEPT: kept, OTHERS: others}
    for threads in range(settings.threads, 0, -1):
        parts = base | _of_steps(views, threads)
        left = replace(settings, threads=threads, memory=max(budget - sum(parts.values()), 1))
        found = schedule(views, left)
        if found.spilled:
            parts = base | _of_steps(views, threads, found.spilled) | {ON_DISK: found.mapped}
            left = replace(left, memory=max(budget - sum(parts.values()), 1))
            found = schedule(views, left)
        if sum(parts.values()) + found.least <= budget:
            return replace(left, process=budget)
    raise _refused(views[0].chain.steps, parts | {BLOCKS: found.least}, budget, left)


def _of_steps(views: Sequence[View], threads: int, spilled: int = 0) -> dict[str, int]:
    """Bytes that steps hold, by label, of all bands."""
    parts: dict[str, int] = {}
    for view in views:
        for o in view.chain.steps:
            size = planning_of(o).held(view.observation, threads, spilled)
            parts[o.label] = parts.get(o.label, 0) + size
    return parts


def memory_of(views: Sequence[View], threads: int, products: bool = False) -> int:
    """Bytes that the steps hold for a scan with some bands, besides streams and blocks;
    ``products``: what they add up over all scans alone.
    """
    return sum(
        planning_of(o).held(view.observation, threads)
        for view in views
        for o in view.chain.steps
        if makes_products(o) or not products
    )


def with_scan_ahead(views: Sequence[View], settings: Settings) -> Settings | None:
    """The settings without what a scan holds that is prepared while another is executed; None where
    there is no room for it.
    """
    threads = settings.threads
    size = memory_of(views, threads) - memory_of(views, threads, products=True)
    less = replace(settings, memory=settings.memory - size)
    same = less.memory > 0 and does_the_same(views, less, [schedule(views, settings)])
    return less if same else None


def least_memory(
    views: Sequence[View],
    settings: Settings,
    operators: Sequence[Operator] = (),
) -> int:
    """Bytes with which a process runs a scan with these bands on one thread, libraries included;
    ``operators``: all steps.
    """
    one = replace(settings, threads=1)
    products = memory_of(views, 1, products=True)
    joined = any(map(joins, views[0].chain.steps))
    need = max(
        memory_of(group, 1)
        + products
        - memory_of(group, 1, products=True)
        + schedule(group, one).least
        for group in ([views] if joined else [[view] for view in views])
    )
    end = sum(at_end(views, [o for o in operators if isinstance(o, Output)]).values())
    return megabytes(BASE + max(need, end)) * 1_000_000


def _refused(
    steps: Sequence[Operator],
    parts: Mapping[str, int],
    budget: int,
    settings: Settings,
) -> PipelineError:
    need = sum(parts.values())
    free = available_memory() + resident_memory()
    rows = sorted(parts.items(), key=lambda row: -row[1])
    largest = ", ".join(f"{who} {_size(size)}" for who, size in rows[:4] if size > 0.01 * need)
    cures = [f"use --memory {megabytes(need)}MB"] if need * 1.05 <= free else []
    smaller = {KEPT: FEWER} | {o.label: planning_of(o).smaller for o in steps}
    own = need - parts[LIBRARIES]  # the process may hold more of other work
    products = {o.label: parts.get(PRODUCTS, 0) for o in steps if makes_products(o)}
    sizes = {**products, **parts}
    cures += [
        f"{label}: {how}"
        for label, how in smaller.items()
        if how and sizes.get(label, 0) > 0.1 * own
    ]
    if parts.get(BLOCKS, 0) > 0.1 * need and parts[LIBRARIES] < budget:
        cures.append("split the scan into shorter ones")
    beyond = f", more than this machine has ({_size(free)})" if need > free else ""
    return PipelineError(
        f"the run would hold {_size(need)}{beyond}: {largest}; its memory budget is"
        f" {_size(budget)}",
        place=settings.place,
        cure="; or ".join(cures or ["use a machine with more memory"]),
    )


def _size(size: float) -> str:
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"
