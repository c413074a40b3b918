"""Signals: what all components of a scene make together, and what subsets of them make, filtered
and mapped side by side.

The calibrated sum of all components is the stream ``signal``; that of a subset, named ``noiseless``
in a pipeline file, is ``signal/noiseless``, and its map is ``noiseless/map``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from pydantic import Field, model_validator

from .configuration.parameters import Parameters

MAIN = "signal"
"""The stream of all components."""

TRANSMISSION = "transmission"
"""The relative fluctuation of e^-tau: a factor on the sky, not a part of the sum."""

Entrance = Literal["above the atmosphere", "at the detector", "calibrated"]


class Component(str):
    """The name of a stream that becomes part of the signal; an operator that adds something to the
    data provides one.

    ``enters`` says where: ``above the atmosphere`` (as the sky does, seen through its
    transmission), ``at the detector`` (as noise does, before calibration), or ``calibrated`` (in
    K_RJ on the calibrated sky, added last). Raises ValueError for any other.
    """

    enters: Entrance

    def __new__(cls, name: str, enters: Entrance = "at the detector") -> Component:
        if enters not in get_args(Entrance):
            places = ", ".join(map(repr, get_args(Entrance)))
            raise ValueError(f"component {name!r} cannot enter {enters!r}: choose from {places}")
        made = super().__new__(cls, name)
        made.enters = enters
        return made


BUILT_IN = frozenset(
    {
        Component("sky", "above the atmosphere"),
        Component("atmosphere", "at the detector"),
        Component(TRANSMISSION, "above the atmosphere"),
        Component("white", "at the detector"),
        Component("pink", "at the detector"),
    }
)
"""Streams that become part of the signal whatever operator makes them."""


class Signal(Parameters):
    """A signal of its own: the scene's, with some components absent."""

    only: list[str] | None = Field(None, min_length=1)
    """Components to keep (e.g. [sky]: the noiseless map); all others are absent."""
    without: list[str] | None = Field(None, min_length=1)
    """Components that are absent (e.g. [sky]: the source-free map)."""
    modes: Literal["own", "full"] = "own"
    """Singular modes of filters: those of this signal (`own`), or those of the complete data
    (`full`: with their modes and the same transmission of the atmosphere all is linear, and what is
    left of each part adds up to the complete map)."""
    filters: Literal["all", "none"] = "all"
    """`none`: map it as it was formed, without any step that changes the signal."""

    @model_validator(mode="after")
    def _one_of_two(self) -> Signal:
        if (self.only is None) == (self.without is None):
            raise ValueError("give either only or without")
        return self

    def keeps(self, provides: frozenset[str]) -> bool:
        """True if a stream that a step provides is part of it."""
        if self.only is not None:
            return bool(provides & set(self.only))
        return not provides & set(self.without or ())

    @property
    def is_quiet(self) -> bool:
        """True if surely no noise of detectors is in it."""
        return self.only is not None and set(self.only) <= {"sky", "atmosphere", TRANSMISSION}

    @property
    def is_source(self) -> bool:
        """True if it keeps neither the atmosphere nor zonda's noise."""
        return self.only is not None and not {"atmosphere", "white", "pink"} & set(self.only)


@dataclass(frozen=True)
class Formed:
    """A signal as the executor forms it.

    Attributes
    ----------
    stream
        ``signal``, ``signal/noiseless`` ...
    components
        What it is the sum of; with ``transmission`` where the sky is seen through the fluctuating
        transmission.
    model
        It takes the singular modes of ``signal`` (`Signal.modes`).
    filtered
        Filters act on it.
    own
        Labels of the filters that measure it by itself although it has a ``model``: the first that
        is not linear, and all behind.
    """

    stream: str
    components: frozenset[Component]
    model: bool = False
    filtered: bool = True
    own: frozenset[str] = frozenset()

    def takes_model(self, label: str) -> bool:
        """True if filters use for this signal what they measure in the complete one."""
        return self.model and self.stream != MAIN and label not in self.own

    @property
    def name(self) -> str:
        """``noiseless``; empty for the complete signal."""
        return self.stream.partition("/")[2]


def needed_name(signal: Signal) -> str:
    """The name of a signal that an output asks for and no author has named, such as
    ``_sky_unfiltered``.
    """
    parts = [*(signal.only or ["without", *(signal.without or ())])]
    parts += ["unfiltered"] * (signal.filters == "none") + ["full"] * (signal.modes == "full")
    return "_" + "_".join(parts)


def can_be_named(name: str) -> bool:
    """True if a pipeline's author may call a signal so; names that begin with an underscore are
    those of outputs.
    """
    return name.isidentifier() and not name.startswith("_")


def stream_of(name: str) -> str:
    """The stream of the signal ``name`` (empty: the complete one)."""
    return f"{MAIN}/{name}" if name else MAIN


def is_signal(stream: str) -> bool:
    """True for the name of a signal's stream."""
    return stream == MAIN or stream.startswith(f"{MAIN}/")


def is_stream(name: str) -> bool:
    """True if the name is that of a stream of a block alone: a component, or a signal.

    Its only use is to be read by a later step. Any other name may be a product as well.
    """
    return isinstance(name, Component) or name in BUILT_IN or is_signal(name)


def product_name(stream: str, product: str) -> str:
    """The name of a product of a signal's stream: ``map``, ``noiseless/map``."""
    name = stream.partition("/")[2]
    return f"{name}/{product}" if name else product
