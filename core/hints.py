"""Suggestions for names of the wrong kind: a telescope given as a site, a site given as an instrument."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from . import registry
from .errors import ZondaError
from .registry import Registry, fold

if TYPE_CHECKING:
    from .scene import Scene

EARTH = 6371e3
"""Mean radius, m."""
NEAR = 1e3
"""m: what stands nearer than this stands at the same site."""


def known_elsewhere(names: Registry, name: str) -> tuple[str, str]:
    """(label, cure) for an unknown site or instrument that is the name of another thing; empty where it is not."""
    if names is registry.sites:
        return _of_a_site(name)
    if names is registry.instruments:
        return _of_an_instrument(name)
    return "", ""


def _of_a_site(name: str) -> tuple[str, str]:
    for known, instrument in _made(registry.instruments):
        telescope = instrument.telescope
        if fold(name) in (fold(known), fold(telescope.name)) and telescope.site:
            what = f"'{known}' is an instrument; its telescope {telescope.name}" if fold(name) == fold(known) else telescope.name
            return f"did you mean '{telescope.site}'?", f"{what} stands at {telescope.site}"
    return _described(registry.sites, name)


def _of_an_instrument(name: str) -> tuple[str, str]:
    made = list(_made(registry.instruments))
    mounted = sorted(known for known, i in made if fold(i.telescope.name) == fold(name))
    if mounted:
        return f"did you mean '{mounted[0]}'?", f"{name} is a telescope; instruments on it: {', '.join(mounted)}"
    site = registry.sites.registered(name)
    if site in registry.sites:
        there = sorted(
            known for known, i in made if i.telescope.site and registry.sites.get(i.telescope.site) == registry.sites.get(site)
        )
        return f"'{site}' is a site", f"instruments that stand there: {', '.join(there)}" if there else ""
    return _described(registry.instruments, name)


def _described(names: Registry, name: str) -> tuple[str, str]:
    """The component whose description has the word ``name``."""
    for known, component in _made(names):
        if fold(name) in [fold(word) for word in re.split(r"[^\w-]+", component.description) if len(word) > 2]:
            return f"did you mean '{known}'?", f"{known}: {component.description}"
    return "", ""


def _made(names: Registry) -> Iterator[tuple[str, Any]]:
    """Each name and its component; those of broken plugins are left out."""
    for name in names:
        with suppress(ZondaError):
            yield name, names.create(name)


def elsewhere(scene: Scene) -> str:
    """What to say of a telescope that the scene puts on another site than its own; empty where it does not."""
    telescope = scene.instrument.telescope
    try:
        home = registry.sites.create(telescope.site) if telescope.site else None
    except ZondaError:  # the site of a plugin that is not installed here
        home = None
    if home is None:
        return ""
    a, b = (np.array([s.latitude, s.longitude]) for s in (home, scene.site))
    half = np.sin((a - b) / 2) ** 2
    distance = 2 * EARTH * float(np.arcsin(np.sqrt(min(1.0, half[0] + np.cos(a[0]) * np.cos(b[0]) * half[1]))))
    if distance < NEAR:
        return ""
    return (
        f"{telescope.name} stands at {home.name}, {distance / 1e3:.0f} km away: here it looks through the air of "
        f"{scene.site.name}; write 'site: {telescope.site}' for its own"
    )
