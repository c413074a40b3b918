"""The CPU and libraries that each task ran with: results have the same bits only on one kind of
machine.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

from ..machine import arithmetic
from .campaign_file import Say

WITHOUT_INFLUENCE = frozenset({"processor", "python"})
"""What is recorded, and changes no bit: the model's name (its instructions count), and Python,
which computes nothing.
"""

EFFECT = "maps of the two may differ in the last bits, by about 1e-7 K"


@cache
def here() -> str:
    """This process's machine and libraries, as JSON."""
    return json.dumps(arithmetic(), sort_keys=True)


def read(text: str) -> dict[str, str]:
    """A machine from its JSON; empty where that is none."""
    try:
        found = json.loads(text)
    except ValueError:
        return {}
    return {str(k): str(v) for k, v in found.items()} if isinstance(found, dict) else {}


def kind(text: str) -> frozenset[tuple[str, str]]:
    """Properties that bits depend on; empty: unknown."""
    return frozenset((k, v) for k, v in read(text).items() if k not in WITHOUT_INFLUENCE)


def differences(one: str, other: str) -> str:
    """Differences of two machines in words: ``numpy 2.3.1 (2.4.6 there), ...``; of instructions,
    those that one of the two lacks.
    """
    a = read(one)
    b = read(other)
    found = []
    for key in sorted((a.keys() | b.keys()) - WITHOUT_INFLUENCE):
        mine = a.get(key, "none")
        theirs = b.get(key, "none")
        if mine != theirs and key.endswith("instructions"):
            own = set(mine.split())
            others = set(theirs.split())
            words = [
                f"{sign} {' '.join(names[:3])}{' ...' * (len(names) > 3)}"
                for sign, names in (
                    ("with", sorted(own - others)),
                    ("without", sorted(others - own)),
                )
                if names
            ]
            found.append(f"{key} {', '.join(words)}")
        elif mine != theirs:
            found.append(f"{key} {mine} ({theirs} there)")
    return ", ".join(found)


def short(text: str) -> str:
    """One line: the processor as the compiler calls it, and libraries."""
    found = read(text)
    names = ("zonda", "numpy", "numba", "scipy", "astropy", "pyerfa")
    libraries = ", ".join(f"{name} {found[name]}" for name in names if name in found)
    return f"{found.get('cpu', 'unknown')} ({found.get('processor', 'unknown')}), {libraries}"


class Watch:
    """Compares the machine of each task with that of the first one, and reports every other kind
    once.

    Parameters
    ----------
    known
        Machines of the tasks that are done, by number.
    strict
        Whether tasks of another kind of machine are refused.
    """

    def __init__(self, known: Mapping[int, str], strict: bool, folder: Path, say: Say) -> None:
        self._strict = False
        self._folder = folder
        self.say = say
        self._first = ""
        self._told: set[frozenset[tuple[str, str]]] = set()
        for number in sorted(known):
            self.meet(known[number], f"task {number}")
        self._strict = strict

    def meet(self, machine: str, who: str) -> str:
        """Why a task is refused; empty where it is not. ``who``: which task, where."""
        this = kind(machine)
        self._first = self._first or (machine if this else "")
        if not this or this == kind(self._first):
            return ""
        what = (
            f"{who} ran on another kind of machine or with other libraries than the first:"
            f" {differences(machine, self._first)}"
        )
        if self._strict:
            return f"{what}; same_machine refuses it"
        if this not in self._told:
            self._told.add(this)
            self.say(
                f"{what}; {EFFECT} (zonda status {self._folder}; campaign.same_machine refuses it)"
            )
        return ""


def kinds(machines: Iterable[str]) -> list[tuple[str, int]]:
    """One machine of each kind, the commonest first, and how many tasks ran on that kind."""
    known = [machine for machine in machines if kind(machine)]
    first = {kind(machine): machine for machine in reversed(known)}
    return [(first[this], count) for this, count in Counter(map(kind, known)).most_common()]
