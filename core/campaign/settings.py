"""``campaign:`` of a pipeline file."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from ..configuration.parameters import Parameters
from ..configuration.time import Instant

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
