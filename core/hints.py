"""Suggestions for names of the wrong kind: a telescope given as a site, a site given as an
instrument.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from .components import Registry, fold
from .errors import ZondaError


def for_site(sites: Registry, instruments: Registry, name: str) -> tuple[str, str]:
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


def for_instrument(sites: Registry, instruments: Registry, name: str) -> tuple[str, str]:
    """(label, cure) for an unknown instrument that is the name of another thing, as `for_site`."""
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
