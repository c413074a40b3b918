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
from typing import TYPE_CHECKING, Any

from .same_air import TRANSMISSION

if TYPE_CHECKING:
    from .pipeline import Pipeline

MOST_PARTS = 4
"""Runs that may be taken from the main run: each adds its rounding."""

Packed = Mapping[str, Mapping[str, Any]]
"""By label: what `Operator.pack` gave."""


def derivable(pipeline: Pipeline, runs: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Of these companion runs the ones that can be derived, and which ones the main run loses for them."""
    if not all(o.linear for o in pipeline._selected("") if "signal" in o.provides):
        return {}
    every = pipeline.components("")
    made = {name: pipeline.components(name) for name in runs if _fits(pipeline, name)}
    found: dict[str, tuple[str, ...]] = {}
    taken: set[str] = set()
    for name in sorted(made, key=lambda n: -len(made[n])):
        if name in taken or not all(o.can_subtract for o in pipeline._selected(name)):
            continue
        rest = every - made[name]
        others = [other for other in made if other != name and other not in found and made[other] <= rest]
        for parts in (p for n in range(1, MOST_PARTS + 1) for p in combinations(others, n)):
            if sum(len(made[p]) for p in parts) == len(rest) and frozenset().union(*(made[p] for p in parts)) == rest:
                found[name] = parts
                taken.update(parts)
                break
    return found


def _fits(pipeline: Pipeline, name: str) -> bool:
    """Whether a run is a term of equation (1)."""
    run, kept = pipeline.runs[name], pipeline.components(name)
    names_air = TRANSMISSION in [*(run.only or ()), *(run.without or ())]
    return run.modes == "full" and run.filters == "all" and not names_air and bool(kept) and kept != pipeline.components("")


def derivation(parts: Sequence[str]) -> str:
    """How a run is derived, e.g. ``the main run minus noiseless``."""
    return f"the main run minus {' and '.join(parts)}"


def subtract(pipeline: Pipeline, run: str, whole: Packed, parts: Sequence[Packed]) -> dict[str, Mapping[str, Any]] | None:
    """The partial products of a run by equation (1), by label; None where an operator finds that it does not hold."""
    found: dict[str, Mapping[str, Any]] = {}
    for operator in pipeline._selected(run):
        label = operator.label
        if label not in whole:
            continue
        made = operator.subtract(whole[label], [part[label] for part in parts]) if all(label in p for p in parts) else None
        if made is None:
            return None
        found[label] = made
    return found
