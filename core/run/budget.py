"""The memory of a process, divided among operators, streams and blocks, bands, and scans prepared
ahead.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from ..errors import PipelineError
from ..machine import available_memory, resident_memory
from ..mapmaker import joins, makes_products
from ..observation import Observation
from ..plan.planning import planning_of
from .bands import Band, looks_alike
from .prefetch import Ahead
from .schedule import Chain, schedule, spares
from .settings import Settings

BASE = 230_000_000
"""Bytes of the interpreter, libraries and compiled code."""


KEPT = "kept streams"
OTHERS = "maps of other bands"
FEWER = "keep fewer streams, of fewer or shorter scans"


@dataclass(frozen=True)
class Budget:
    """The memory that a run was given, to be divided.

    Attributes
    ----------
    memory
        Bytes for streams and blocks that were asked for; None: what the ceiling leaves.
    fresh
        False in a worker (`divided`).
    place
        The pipeline's name, for errors.
    """

    memory: int | None
    fresh: bool
    place: str


class Division(NamedTuple):
    """Settings of each band; whether all are executed ``together``, and ``blockwise``: there is
    room for a block of each at a time.
    """

    settings: list[Settings]
    together: bool = False
    blockwise: bool = True


def divide(
    bands: Sequence[Band], settings: Settings, budget: Budget, ahead: Ahead, together: bool
) -> Division:
    """Divide the memory of a run among its bands.

    Each band has what the products of the others leave. Bands that a step joins hold their
    streams side by side, and once more together. Others that look through the same pixels share
    equally, if each does the same with its streams as it would alone.

    Parameters
    ----------
    ahead
        Is turned off where there is no room for a scan that is prepared while another is executed.
    together
        False: bands follow each other, unless a step joins them.
    """
    n, joined = len(bands), len(bands) > 1 and any(map(joins, bands[0].chain.steps))
    every = [o for band in bands for o in band.data.observations]
    kept = 8 * len(bands[0].chain.keep) * sum(o.n_detectors * o.n_samples for o in every)
    held = [held_of(band.chain, band.longest, joined) for band in bands]
    alone = [
        _alone(band, settings, budget, ahead, (kept, sum(held) - mine))
        for band, mine in zip(bands, held, strict=True)
    ]
    if joined:
        least = [
            min(schedule(band.chain, band.longest, own).least, own.memory)
            for band, own in zip(bands, alone, strict=True)
        ]
        shares = [max(own.memory // (2 * n), low) for own, low in zip(alone, least, strict=True)]
    elif n > 1 and together and looks_alike(bands):
        more = [
            (2 if ahead.on else 1)
            * (held_of(b.chain, b.longest, True) - held_of(b.chain, b.longest))
            for b in bands
        ]
        found = [
            share_in_step(band.chain, band.longest, own, n, sum(more) - mine)
            for band, own, mine in zip(bands, alone, more, strict=True)
        ]
        shares = [one.memory for one in found if one is not None]
    else:
        shares = []
    if len(shares) < n:
        return Division(alone)
    each = [replace(own, memory=share, spare=[]) for own, share in zip(alone, shares, strict=True)]
    return Division(each, True, sum(shares) <= alone[0].memory)


def _alone(
    band: Band, settings: Settings, budget: Budget, ahead: Ahead, beside: tuple[int, int]
) -> Settings:
    """Divide the memory of one band; ``beside``: kept streams, and products of other bands."""
    chain, data = band.chain, band.data
    if budget.memory is not None and settings.process is None:
        check_kept_memory(beside[0], available_memory(), budget.place)
        return settings
    most = settings.memory
    settings = divided(chain, band.longest, settings, budget.place, budget.fresh, *beside)
    if budget.memory is not None:
        settings = replace(settings, memory=min(settings.memory, most))
    if ahead.on:
        less = with_scan_ahead(chain, band.longest, settings)
        ahead.on, settings = less is not None, less or settings
    if settings.threads < data.threads and budget.fresh:
        text = (
            f"{settings.threads} of {data.threads} threads work: more do not fit in the memory"
            " budget"
        )
        warnings.warn(f"{budget.place}: {text}", stacklevel=5)
    data.threads = settings.threads
    return settings


def longest_of(observations: Sequence[Observation]) -> Observation:
    """The observation of most samples."""
    return max(observations, key=lambda o: o.n_detectors * o.n_samples)


def divided(
    chain: Chain,
    observation: Observation,
    settings: Settings,
    place: str,
    fresh: bool = True,
    kept: int = 0,
    others: int = 0,
) -> Settings:
    """Divide the memory of a process: the settings with that of streams and blocks, and with fewer
    threads where the blocks of all do not fit.

    Results depend on neither.

    Parameters
    ----------
    observation
        The longest.
    settings
        ``process``: bytes that the process may hold; None: what it holds and half of the free
        memory.
    place
        The pipeline's name, for errors.
    fresh
        False in a worker, which still holds what tasks before this one have left: that is no part
        of the forecast.
    kept, others
        Bytes of streams that the user keeps, and of the products of other bands.

    Raises
    ------
    PipelineError
        Where the least that a run needs is more than its budget, or more than the machine has: what
        needs it, and what would make it fit.
    """
    budget = settings.process or resident_memory() + available_memory() // 2
    parts = {"zonda and its libraries": max(resident_memory(), BASE) if fresh else BASE}
    parts |= {KEPT: kept, OTHERS: others}
    parts.update((o.label, planning_of(o).memory(observation)) for o in chain.steps)
    fixed = sum(parts.values())
    left = replace(settings, memory=max(budget - fixed, 1))
    found = schedule(chain, observation, left)
    if fixed + found.least > budget and left.threads > 1:
        left = replace(
            left,
            threads=max(1, min(left.threads - 1, (budget - fixed) * left.threads // found.least)),
        )
        found = schedule(chain, observation, left)
    if fixed + found.least > budget:
        _refuse(chain, parts, found.least, budget, left.threads, place)
    return replace(left, process=budget)


def products_of(chain: Chain, observation: Observation) -> int:
    """Bytes of what steps add up over all scans."""
    return sum(planning_of(o).memory(observation) for o in chain.steps if makes_products(o))


def held_of(chain: Chain, observation: Observation, in_step: bool = False) -> int:
    """Bytes that a band holds while another acts: `products_of`; ``in_step`` with that one,
    whatever its steps hold.
    """
    return (
        sum(planning_of(o).memory(observation) for o in chain.steps)
        if in_step
        else products_of(chain, observation)
    )


def with_scan_ahead(chain: Chain, observation: Observation, settings: Settings) -> Settings | None:
    """The settings without what a scan holds that is prepared while another is executed; None where
    there is no room for it.
    """
    size = sum(planning_of(o).memory(observation) for o in chain.steps if not makes_products(o))
    if not spares(chain, observation, settings, size):
        return None
    return replace(settings, memory=settings.memory - size)


def share_in_step(
    chain: Chain, observation: Observation, settings: Settings, bands: int, beside: int
) -> Settings | None:
    """The settings of one of several ``bands`` that work on a scan at the same time (`scan`).

    None where no step saves time so, or less would be kept in memory than where it works alone.
    ``beside``: bytes that the steps of the others hold.
    """
    if not any(planning_of(o).shares_blocks(observation) for o in chain.steps):
        return None
    memory = (settings.memory - beside) // bands
    if not spares(chain, observation, settings, settings.memory - memory):
        return None
    return replace(settings, memory=memory)


def check_kept_memory(size: int, free: int, place: str) -> None:
    """Refuse to keep streams of ``size`` bytes where less memory is ``free``. Raises
    PipelineError.
    """
    if size > free:
        raise PipelineError(
            f"the kept streams would take {_size(size)}, {_size(free)} are free",
            place=place,
            cure=FEWER,
        )


def least_memory(
    chain: Chain, observation: Observation, settings: Settings, others: int = 0
) -> int:
    """Bytes with which a process runs these steps over an observation on one thread, libraries
    included; ``others``: of the products of other bands.
    """
    held = sum(planning_of(o).memory(observation) for o in chain.steps) + others
    return _with_margin(
        BASE + held + schedule(chain, observation, replace(settings, threads=1)).least
    )


def _with_margin(size: int) -> int:
    """A size that is to be asked for: what the libraries take differs a little from run to run."""
    return -(-size * 21 // 20_000_000) * 1_000_000


def _refuse(
    chain: Chain, parts: Mapping[str, int], blocks: int, budget: int, threads: int, place: str
) -> None:
    need, free = sum(parts.values()) + blocks, available_memory() + resident_memory()
    rows = sorted(
        [*parts.items(), (f"blocks on {threads} thread{'s' if threads > 1 else ''}", blocks)],
        key=lambda row: -row[1],
    )
    largest = ", ".join(f"{who} {_size(size)}" for who, size in rows[:4] if size > 0.01 * need)
    cures = [f"use --memory {_with_margin(need) // 1_000_000}MB"] if need * 1.05 <= free else []
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
        place=place,
        cure="; or ".join(cures or ["use a machine with more memory"]),
    )


def _size(size: float) -> str:
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"
