"""From a campaign's axes to its entries: what each observes, with which random numbers, and what it
is co-added with.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from ..configuration.time import Instant
from ..errors import InputError
from .settings import MOST_TASKS, Campaign, Nights

TURN = 86400.0 / 1.00273781191135448
"""Length of one turn of the Earth against the stars, s: 86400 / (d ERA / d UT1) (IAU 2000,
Capitaine et al. 2000), after which a target fixed on the sky is at the same hour angle."""


@dataclass(frozen=True)
class Entry:
    """One entry of a campaign.

    Attributes
    ----------
    values
        Its place on every axis, as the file gives it: the grid's and the observations' keys,
        ``observation``, ``night`` and ``realization`` (counted from 0).
    settings
        Those that change the pipeline file, as ``--set`` takes them (``key=value``); not the seed.
    seed, time
        Root of its random numbers; start.
    combination
        Axes over which nothing is co-added, with their values: entries with the same are co-added.
    """

    values: dict[str, Any]
    settings: tuple[str, ...]
    seed: int
    time: Instant
    combination: tuple[tuple[str, Any], ...]


def entries(
    campaign: Campaign, seed: int, time_of: Callable[[tuple[str, ...]], Instant]
) -> list[Entry]:
    """Entries of the campaign, the first axis slowest.

    Parameters
    ----------
    seed
        The pipeline's own.
    time_of
        Start of the pipeline with these settings.

    Raises
    ------
    InputError
        For more than `MOST_TASKS` entries, or nights of which there are none.
    """
    found: list[Entry] = []
    used: dict[tuple[tuple[tuple[str, Any], ...], int], int] = {}
    for values in _points(campaign):
        own = {k: v for k, v in values.items() if k not in ("observation", "seed")}
        settings = tuple(setting(k, v) for k, v in own.items())
        first = time_of(settings)
        base = int(values.get("seed", seed))
        for night, moment in _nights(campaign.nights, first):
            for realization in range(campaign.realizations):
                place = dict(values)
                if campaign.nights is not None:
                    place["night"] = night
                if campaign.realizations > 1:
                    place["realization"] = realization
                combination = tuple(
                    (k, v) for k, v in place.items() if not _combined(campaign, k, values)
                )
                alike = (
                    _plain(
                        tuple(
                            item
                            for item in combination
                            if item[0] not in _drawn_anew(campaign, values)
                        )
                    ),
                    base,
                )
                same = used.get(alike, 0)
                used[alike] = same + 1
                found.append(Entry(place, settings, separate(base, same), moment, combination))
                if len(found) > MOST_TASKS:
                    raise InputError(
                        f"a campaign of more than {MOST_TASKS} entries",
                        cure="make its axes shorter",
                    )
    return found


def separate(seed: int, number: int) -> int:
    """Seed of the ``number``-th of those that are co-added and have the same ``seed``: its own is
    the first one's.

    The others have 63 bits of a hash of both (`core.numerics.random.stream_key`): seed + 1 would be
    another user's seed.
    """
    if not number:
        return seed
    from ..numerics.random import stream_key

    low, high = (int(word) for word in stream_key(seed, "campaign", number))
    return (high << 32 | low) & (2**63 - 1)


def setting(key: str, value: Any) -> str:
    """``key=value`` with the value as YAML on one line."""
    return f"{key}={json.dumps(value)}"


def _points(campaign: Campaign) -> Iterator[dict[str, Any]]:
    """Values of grid and observations."""
    listed: list[dict[str, Any]] = [
        {"observation": k, **entry} for k, entry in enumerate(campaign.observations)
    ] or [{}]
    for entry in listed:
        for point in itertools.product(*campaign.grid.values()):
            yield {**entry, **dict(zip(campaign.grid, point, strict=True))}


def _nights(nights: Nights | None, first: Instant) -> Iterator[tuple[int, Instant]]:
    """(number of turns of the Earth since ``first``, instant)."""
    if nights is None:
        yield 0, first
        return
    if nights.start is None or nights.stop is None:
        low, high = 0, (nights.count or 1) * nights.every
    else:
        low = math.ceil(nights.start.seconds_since(first) / TURN)
        high = math.ceil(nights.stop.seconds_since(first) / TURN)
        if high <= low:
            raise InputError(
                f"no observation begins between {nights.start} and {nights.stop}",
                place="campaign.nights",
                cure=f"observations begin {first} or whole turns of the Earth before or after it",
            )
    for k in range(low, high, nights.every):
        yield k, first.shifted(k * TURN)


def _combined(campaign: Campaign, axis: str, values: dict[str, Any]) -> bool:
    """``observation`` stands for all keys of the list, and each of them for it."""
    if campaign.combine == "all":
        return True
    listed = {"observation", *(k for entry in campaign.observations for k in entry)}
    return bool(listed & set(campaign.combine)) if axis in listed else axis in campaign.combine


def _drawn_anew(campaign: Campaign, values: dict[str, Any]) -> set[str]:
    """The axes along which random numbers are others whether or not it is co-added over them: other
    observations, made at another time or of another target. A seed that is given stays as it is;
    `observation` counts what its keys say."""
    found = {"realization", "observation"}
    if not campaign.paired:
        found |= {"night"} if "seed" in values else {"night", "time", "target"}
    return found


def _plain(combination: tuple[tuple[str, Any], ...]) -> Any:
    return tuple((k, json.dumps(v, sort_keys=True)) for k, v in combination)
