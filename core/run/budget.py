"""What a process may hold, divided among operators, streams and blocks, and scans prepared
ahead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..errors import PipelineError
from ..machine import available_memory, resident_memory
from ..mapmaker import makes_products
from ..observation import Observation
from ..plan.planning import planning_of
from .schedule import Chain, schedule, spares
from .settings import Settings

BASE = 230_000_000
"""Bytes of the interpreter, libraries and compiled code."""


KEPT = "kept streams"
OTHERS = "maps of other bands"
FEWER = "keep fewer streams, of fewer or shorter scans"


def longest_of(observations: Sequence[Observation]) -> Observation:
    """The observation of most samples."""
    return max(observations, key=lambda o: o.n_detectors * o.n_samples)


def divided(
    chain: Chain, observation: Observation, settings: Settings, place: str, fresh: bool = True
) -> Settings:
    """The settings with the memory of streams and blocks, and with fewer threads where the blocks
    of all do not fit.

    Results depend on neither.

    Parameters
    ----------
    observation
        The longest.
    settings
        ``asked``: bytes that the process may hold.
    place
        The pipeline's name, for errors.
    fresh
        False in a worker, which still holds what tasks before this one have left: that is no part
        of the forecast.

    Raises
    ------
    PipelineError
        Where the least that a run needs is more than its budget, or more than the machine has: what
        needs it, and what would make it fit.
    """
    budget = settings.asked or resident_memory() + available_memory() // 2
    parts = {"zonda and its libraries": max(resident_memory(), BASE) if fresh else BASE}
    parts |= {KEPT: settings.kept, OTHERS: settings.others}
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
    products = products_of(chain, observation) + settings.others
    return replace(left, least=found.least, ceiling=budget - products, asked=budget)


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
    ceiling = None if settings.ceiling is None else settings.ceiling - size
    return replace(settings, memory=settings.memory - size, ceiling=ceiling)


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
    return replace(settings, memory=memory, bands=bands, spare=[])


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


def least_memory(chain: Chain, observation: Observation, settings: Settings) -> int:
    """Bytes with which a process runs these steps over an observation on one thread, libraries
    included.
    """
    held = sum(planning_of(o).memory(observation) for o in chain.steps) + settings.others
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
    cures += [
        f"{label}: {how}" for label, how in smaller.items() if how and parts[label] > 0.1 * need
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
