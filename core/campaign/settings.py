"""``campaign:`` of a pipeline file, and the entries of its axes: what each observes, with which
random numbers, and what it is co-added with.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from ..configuration.parameters import Parameters
from ..configuration.time import Instant
from ..errors import InputError

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
        Axes that are not co-added, with their values: entries with the same ones are added up.
    """

    values: dict[str, Any]
    settings: tuple[str, ...]
    seed: int
    time: Instant
    combination: tuple[tuple[str, Any], ...]


def entries(
    campaign: Campaign,
    seed: int,
    time_of: Callable[[tuple[str, ...]], Instant],
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
        anew = _drawn_anew(campaign, values)
        for night, moment in _nights(campaign.nights, first):
            for realization in range(campaign.realizations):
                place = dict(values)
                if campaign.nights is not None:
                    place["night"] = night
                if campaign.realizations > 1:
                    place["realization"] = realization
                combination = tuple((k, v) for k, v in place.items() if not _combined(campaign, k))
                alike = _plain(tuple((k, v) for k, v in combination if k not in anew)), base
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
    """Seed of the ``number``-th of the entries that are co-added and have the same ``seed``: the
    first one keeps it.

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
        low = 0
        high = (nights.count or 1) * nights.every
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


def _combined(campaign: Campaign, axis: str) -> bool:
    """True if an axis is co-added. ``observation`` stands for all keys of the list of
    observations, and each of them for it.
    """
    if campaign.combine == "all":
        return True
    listed = {"observation", *(k for entry in campaign.observations for k in entry)}
    return bool(listed & set(campaign.combine)) if axis in listed else axis in campaign.combine


def _drawn_anew(campaign: Campaign, values: dict[str, Any]) -> set[str]:
    """Axes along which random numbers differ even if they are not co-added: observations at
    another time or of another target.

    A seed that is given stays as it is; `observation` counts what its keys say.
    """
    found = {"realization", "observation"}
    if not campaign.paired:
        found |= {"night"} if "seed" in values else {"night", "time", "target"}
    return found


def _plain(combination: tuple[tuple[str, Any], ...]) -> Any:
    return tuple((k, json.dumps(v, sort_keys=True)) for k, v in combination)


Engine = Literal["serial", "processes", "mpi", "dask"]

MOST_TASKS = 1_000_000
"""Larger campaigns are refused: their list of tasks would not fit."""


class Nights(Parameters):
    """The same hour angle on several nights: `time` moved by whole turns of the Earth."""

    count: int | None = Field(None, ge=1, le=100_000)
    """Number of nights, the first at `time`."""
    start: Instant | None = None
    """Take every night whose observation begins at this instant or later ..."""
    stop: Instant | None = None
    """... and before this one."""
    every: int = Field(1, ge=1, le=100_000)
    """Take every so many nights."""

    @model_validator(mode="before")
    @classmethod
    def _count_alone(cls, value: Any) -> Any:
        return {"count": value} if isinstance(value, int) and not isinstance(value, bool) else value

    @model_validator(mode="after")
    def _one_way(self) -> Nights:
        if (self.count is None) == (self.start is None) or (self.start is None) != (
            self.stop is None
        ):
            raise ValueError("give a number of nights, or start and stop")
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise ValueError("stop must come after start")
        return self


class Tls(Parameters):
    """Certificates for a Dask scheduler, as Dask's own configuration calls them."""

    ca_file: str
    """Certificate of the authority that signed the others (PEM)."""
    cert: str
    """This side's certificate (PEM)."""
    key: str
    """Its key (PEM)."""


class Campaign(Parameters):
    """Many observations of one pipeline, worked through as tasks on any engine. Keys are those of
    `--set`.
    """

    KEYS_BELONG_IN: ClassVar[str] = "grid"
    """The key under which a key of the pipeline belongs that was written beside these."""

    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    """Every combination of these values, e.g. {site: [atacama, mauna_kea], PointingDaisy.radius: [2
    arcmin, 4 arcmin]}.
    """
    observations: list[Annotated[dict[str, Any], Field(min_length=1)]] = Field(default_factory=list)
    """One after the other, e.g. [{time: 2024-11-25T07:00}, {time: 2024-11-26T07:00, target: 06h
    +20d}].
    """
    schedule: str | None = None
    """File of an observing schedule (TOAST's): the `schedule` of the pipeline's pointing step,
    whose rows are the scans.
    """
    nights: Nights | None = None
    """Repeat each on several nights at the same hour angle: a number, or {start: 2024-11-25, stop:
    2024-12-25}.
    """
    realizations: int = Field(1, ge=1, le=100_000)
    """Repeat each with other random numbers."""
    combine: Literal["all"] | list[str] = "all"
    """What is co-added: all, or these axes (keys of grid and observations, `observation`, `night`,
    `realization`): one set of products for each combination of the others."""
    paired: bool = False
    """Entries that are not co-added see the same noise and atmosphere on other nights, at other
    times and of other targets too. Otherwise those of the same night, time and target alone do,
    which differ in a parameter."""
    task: Literal["scan", "entry"] = "scan"
    """A task is one scan, or all scans of one entry (fewer and longer tasks; the products are the
    same bits).
    """
    engine: Engine = "processes"
    """What works on the tasks."""
    workers: int | None = Field(None, ge=1, le=100_000)
    """Worker processes of `processes`; where absent, one for each CPU."""
    scheduler: str | None = Field(None, min_length=1)
    """Address of a Dask scheduler, e.g. tcp://host:8786 or tls://host:8786, or the path of its
    scheduler file.
    """
    tls: Tls | None = None
    """Certificates for Dask; where absent, Dask's own configuration counts."""
    retries: int = Field(2, ge=0, le=100)
    """How often a task that failed is tried again."""
    keep_tasks: bool = False
    """Keep the tasks' partial products when they are combined."""

    figures: bool = False
    """Make one table of the figures that are measured of each set of products, `sweep.ecsv`; a
    `sweep` does.
    """

    same_machine: bool = False
    """Refuse tasks of another kind of machine (other instructions of the CPU) than the first one's,
    or of other libraries: their bits may differ. Otherwise they are reported."""

    @model_validator(mode="after")
    def _axes(self) -> Campaign:
        nights = self.nights.count or 1 if self.nights else 1
        number = (
            math.prod(map(len, self.grid.values()))
            * max(1, len(self.observations))
            * nights
            * self.realizations
        )
        if number > MOST_TASKS:
            raise ValueError(
                f"a campaign of {number} entries; make its axes shorter: at most {MOST_TASKS}"
            )
        both = sorted(set(self.grid) & {key for entry in self.observations for key in entry})
        if both:
            raise ValueError(
                f"{both[0]} stands in grid and in observations; it can only be in one of them"
            )
        if self.combine != "all":
            unknown = [axis for axis in self.combine if axis not in self.axes]
            if unknown:
                have = ", ".join(self.axes)
                raise ValueError(
                    f"combine names {unknown[0]!r}, which is no axis of this campaign; its axes:"
                    f" {have}"
                )
        if self.scheduler is not None and self.engine != "dask":
            raise ValueError("scheduler is for engine: dask")
        if self.tls is not None and self.scheduler is None:
            raise ValueError("tls is for the scheduler of engine: dask; name it")
        return self

    @property
    def axes(self) -> list[str]:
        """Axes that `combine` may name, the slowest first."""
        keys = list(dict.fromkeys(key for entry in self.observations for key in entry))
        first = ["observation", *keys] if self.observations else []
        return [
            *first,
            *self.grid,
            *(["night"] if self.nights else []),
            *(["realization"] if self.realizations > 1 else []),
        ]


class Sweep(Parameters):
    """One pipeline at several values of its keys, and a table of the figures that it measures at
    each.
    """

    over: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    """Every combination of these values, e.g. {HighpassFilter.frequency: [0.04 Hz, 0.08 Hz]}; keys
    are those of `--set`.
    """
    points: list[Annotated[dict[str, Any], Field(min_length=1)]] = Field(default_factory=list)
    """Values that change together, one point after the other. With `over` too, each of them crosses
    it.
    """
    seeds: int = Field(1, ge=1, le=100_000)
    """Realizations of each point, with the same random numbers at all points."""
    engine: Engine = "processes"
    """The engine that executes the runs."""
    workers: int | None = Field(None, ge=1, le=100_000)
    """Worker processes of `processes`; where absent, one for each CPU."""

    @model_validator(mode="after")
    def _something(self) -> Sweep:
        if not self.over and not self.points and self.seeds == 1:
            raise ValueError("give over, points or seeds")
        return self

    KEYS_BELONG_IN: ClassVar[str] = "over"
    """The key under which a key of the pipeline belongs that was written beside these."""
    CALLED: ClassVar[dict[str, str]] = {
        "over": "grid",
        "points": "observations",
        "seeds": "realizations",
    }
    """The keys of a campaign that mean the same."""
