"""Registries of the components that plugins provide, one per kind.

>>> import zonda
>>> @zonda.register                                         # doctest: +SKIP
... class Glitches(zonda.Operator): ...
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, Literal

from . import discovery
from .components import Registry
from .components import RegistryError as RegistryError
from .components import fold as fold
from .errors import ZondaError

operators = Registry(
    "operator",
    "zonda.operators zonda.mapmakers",
    "zonda.core.operator:Operator",
    classes=True,
    exact=True,
)
instruments = Registry("instrument", "zonda.instruments", "zonda.core.instrument:Instrument")
sites = Registry("site", "zonda.sites", "zonda.core.site:Site")
bands = Registry("band", "zonda.bands", "zonda.core.instrument:Band")
layouts = Registry(
    "layout",
    "zonda.layouts",
    classes=True,
)  # functions of a number of pixels: core.layouts.Layout
noise_models = Registry("noise model", "zonda.noise_models")
spectra = Registry("spectra", "zonda.spectra")
checks = Registry("checks", "zonda.checks", "zonda.core.checks:Family")
metrics = Registry(
    "metric",
    "zonda.metrics",
    classes=True,
)  # classes, or functions of `Data`: core.accuracy.metrics
weather_sources = Registry(
    "weather source",
    "zonda.weather_sources",
    "zonda.core.weather:WeatherSource",
    classes=True,
)

planning = Registry("planning", "zonda.planning", classes=True, exact=True)
"""Planning classes (`core.plan.planning.Planning`) by the name of the operator's class."""


def _hint_for_site(name: str) -> tuple[str, str]:
    """(label, cure) for an unknown site that is the name of another thing; empty where it is
    not.
    """
    for known, instrument in _made(instruments):
        telescope = instrument.telescope
        if fold(name) in (fold(known), fold(telescope.name)) and telescope.site:
            what = (
                f"'{known}' is an instrument; its telescope {telescope.name}"
                if fold(name) == fold(known)
                else telescope.name
            )
            return f"did you mean '{telescope.site}'?", f"{what} stands at {telescope.site}"
    return _described(sites, name)


def _hint_for_instrument(name: str) -> tuple[str, str]:
    """(label, cure) for an unknown instrument that is the name of another thing, or empty."""
    made = list(_made(instruments))
    mounted = sorted(known for known, i in made if fold(i.telescope.name) == fold(name))
    if mounted:
        return (
            f"did you mean '{mounted[0]}'?",
            f"{name} is a telescope; instruments on it: {', '.join(mounted)}",
        )
    site = sites.registered(name)
    if site in sites:
        there = sorted(
            known
            for known, i in made
            if i.telescope.site and sites.get(i.telescope.site) == sites.get(site)
        )
        return (
            f"'{site}' is a site",
            f"instruments that stand there: {', '.join(there)}" if there else "",
        )
    return _described(instruments, name)


def _described(names: Registry, name: str) -> tuple[str, str]:
    """The component whose description has the word ``name``."""
    for known, component in _made(names):
        if fold(name) in [
            fold(word) for word in re.split(r"[^\w-]+", component.description) if len(word) > 2
        ]:
            return f"did you mean '{known}'?", f"{known}: {component.description}"
    return "", ""


def _made(names: Registry) -> Iterator[tuple[str, Any]]:
    """Each name and its component; those of broken plugins are left out."""
    for name in names:
        with suppress(ZondaError):
            yield name, names.create(name)


sites.hint = _hint_for_site
instruments.hint = _hint_for_instrument

register = operators.register
"""Decorator: register an operator for this process, in scripts and notebooks. Packages use entry
points.
"""

registries = (
    operators,
    instruments,
    layouts,
    sites,
    bands,
    noise_models,
    weather_sources,
    spectra,
    checks,
    metrics,
    planning,
)


def operators_that(test: Callable[[Any], bool]) -> list[str]:
    """Installed operators whose class passes ``test``. Imports them all: for messages only."""
    found = []
    for name in operators:
        with suppress(RegistryError):  # a broken plugin is another message's
            if test(operators.get(name)):
                found.append(name)
    return found


def declared(kind: Any, what: Literal["requires", "provides", "optional"]) -> frozenset[str]:
    """Names that an operator's class states as ``what``, for tools that have no operator.

    A property is that of an operator with the default parameters, empty if that fails; ``provides``
    includes `Operator.on_request`.
    """
    names = getattr(kind, what)
    if isinstance(names, property):
        names = frozenset()
        with suppress(Exception):  # a parameter has no default, or a plugin is broken
            names = getattr(kind.model_construct(), what)
    more = kind.on_request if what == "provides" else frozenset()
    return frozenset(names) | more


def makers(what: str) -> list[str]:
    """Installed operators that provide ``what`` and do not need it themselves."""

    def makes(step: Any) -> bool:
        needed = declared(step, "requires") | declared(step, "optional")
        return what in declared(step, "provides") - needed

    return operators_that(makes)


def refresh() -> None:
    """Read the entry points of all kinds anew, e.g. after ``pip install`` in a notebook."""
    discovery.refresh()
    for registry in registries:
        registry.refresh()
