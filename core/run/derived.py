"""Companion runs that need not be simulated: what they would make follows from the main run and from others.

With the complete data's modes, flags, weights and air (``modes: full``) a pipeline of linear steps is a linear map L of the
components. For a run of the components C and other runs of P_1, P_2 ..., which together are all the rest,

    L(C) = L(all) - L(P_1) - L(P_2) - ...                                                                        (1)

The partial products (`Operator.pack`) of the runs on the right give those of the run on the left (`Operator.subtract`). Sums in
fixed point are subtracted exactly; the samples themselves are rounded in the runs on the right, not in that on the left: the
products differ from those of a simulated run by the rounding of the streams (float32: 6e-8 of the complete signal in a sample).
Of two runs that make up the main run, the one of more steps is derived.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

from ..data import Data
from ..operator import Operator
from .same_air import TRANSMISSION
from .selection import Selection

MOST_PARTS = 4
"""Runs that may be taken from the main run: each adds its rounding."""

Packed = Mapping[str, Mapping[str, Any]]
"""By label: what `Operator.pack` gave."""


def derivable(selection: Selection, runs: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Of these companion runs the ones that can be derived, and which ones the main run loses for them."""
    if not all(o.linear for o in selection.steps("") if "signal" in o.provides):
        return {}
    every = selection.components("")
    made = {name: selection.components(name) for name in runs if _fits(selection, name)}
    found: dict[str, tuple[str, ...]] = {}
    taken: set[str] = set()
    for name in sorted(made, key=lambda n: -len(made[n])):
        if name in taken or not all(o.can_subtract for o in selection.steps(name)):
            continue
        rest = every - made[name]
        others = [other for other in made if other != name and other not in found and made[other] <= rest]
        for parts in (p for n in range(1, MOST_PARTS + 1) for p in combinations(others, n)):
            if sum(len(made[p]) for p in parts) == len(rest) and frozenset().union(*(made[p] for p in parts)) == rest:
                found[name] = parts
                taken.update(parts)
                break
    return found


def _fits(selection: Selection, name: str) -> bool:
    """Whether a run is a term of equation (1)."""
    run, kept = selection.runs[name], selection.components(name)
    names_air = TRANSMISSION in [*(run.only or ()), *(run.without or ())]
    return run.modes == "full" and run.filters == "all" and not names_air and bool(kept) and kept != selection.components("")


def derivation(parts: Sequence[str]) -> str:
    """How a run is derived, e.g. ``the main run minus noiseless``."""
    return f"the main run minus {' and '.join(parts)}"


def parts_of(derived: Mapping[str, tuple[str, ...]]) -> set[str]:
    """Runs from which others are derived."""
    return {"", *(p for parts in derived.values() for p in parts)} if derived else set()


def subtract(selection: Selection, run: str, whole: Packed, parts: Sequence[Packed]) -> dict[str, Mapping[str, Any]] | None:
    """The partial products of a run by equation (1), by label; None where an operator finds that it does not hold."""
    found: dict[str, Mapping[str, Any]] = {}
    for operator in selection.steps(run):
        label = operator.label
        if label not in whole:
            continue
        made = operator.subtract(whole[label], [part[label] for part in parts]) if all(label in p for p in parts) else None
        if made is None:
            return None
        found[label] = made
    return found


class Derivation:
    """Derives runs once those are made of which they follow.

    Parameters
    ----------
    derived
        By run: the runs that are taken from the main run (`derivable`).
    """

    def __init__(self, selection: Selection, derived: Mapping[str, tuple[str, ...]]) -> None:
        self._selection, self._derived = selection, derived
        self._parts = parts_of(derived)
        self._kept: dict[str, Packed] = {}

    def keep(self, run: str, data: Data) -> None:
        """Copy the partial products of the run in progress, of the operators that can subtract them, if others follow from it."""
        if run not in self._parts:
            return
        found = {}
        for operator in self._selection.steps(run):
            if type(operator).subtract is not Operator.subtract:
                before = dict(data.products)
                if (packed := operator.pack(data, True)) is not None:
                    found[operator.label] = packed
                data.products.update((name, product) for name, product in before.items() if name not in data.products)
        self._kept[run] = found

    def derive(self, run: str, data: Data, kept_out: frozenset[str]) -> bool:
        """Make the partial products of a run from those of others; False where it must be simulated.

        ``kept_out``: labels of the steps that left out single samples of the main run. One that cannot tell what others did with
        them (no `Operator.subtract`) is not linear.
        """
        if run not in self._derived:
            return False
        parts, steps = self._derived[run], self._selection.steps(run)
        unlike = [o for o in steps if o.label in kept_out and type(o).subtract is Operator.subtract]
        found = None if unlike else subtract(self._selection, run, self._kept[""], [self._kept[p] for p in parts])
        if found is None:
            data.tally.state(run, "simulated", f"{derivation(parts)} would not do: their samples differ")
            return False
        for operator in steps:
            if operator.label in found:
                operator.merge(data, found[operator.label])
        data.tally.state(run, "derived as", derivation(parts))
        return True
