"""``campaign:`` of a pipeline file: what it holds, and what is wrong with its axes, each mistake at
its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..configuration import overrides
from ..configuration.diagnostics import Diagnostic
from ..configuration.loaded import KEYS, Header
from ..configuration.steps import Mistakes
from ..registry import declared, makers, operators, operators_that
from .settings import MOST_TASKS, Campaign, Sweep, setting

if TYPE_CHECKING:
    from ..configuration.yaml_places import Document
    from ..operator import Operator


class CampaignHeader(Header):
    """Top level of a pipeline file that has a campaign."""

    campaign: Campaign | None = None
    """Many observations of this pipeline as tasks: a grid or a list of sites, times, seeds or
    steps' parameters, nights, realizations; and the engine that works on them."""
    sweep: Sweep | None = None
    """The pipeline at several values of its keys, and a table of the figures that it measures at
    each. Not beside `campaign`.
    """


def rewrite_campaign(document: Document) -> list[Diagnostic]:
    """Move ``campaign.schedule`` to the pointing step that takes one; return the mistakes."""
    value = document.value["campaign"]
    path = ("campaign", "schedule")
    if not isinstance(value, dict) or value.get("schedule") is None:
        return []
    given = document.sub(path)
    at = document.mark(path).start
    del value["schedule"]
    step = next(
        (
            name
            for name in _names(document)
            if name in operators and _takes_schedule(operators.get(name))
        ),
        None,
    )
    if step is None:
        have = " or ".join(operators_that(_takes_schedule)) or "a step that does"
        return [
            Diagnostic(
                "no step takes the schedule",
                at,
                "",
                f"put {have} in the place of the pointing step",
            )
        ]
    found = overrides.put(document, f"{step}.schedule", given, at, KEYS)
    if value.get("nights") is not None:
        text = "nights would repeat the same scans: the rows of a schedule have times of their own"
        cure = "write every night into the schedule, or use realizations for other random numbers"
        found.append(Diagnostic(text, document.mark(("campaign", "nights")).start, "", cure))
    return found


def too_large(value: Any) -> bool:
    """True if ``campaign:`` as written comes to more entries than allowed, whatever else is wrong
    with it.
    """
    grid, given, nights = (value.get(key) for key in ("grid", "observations", "nights"))
    sizes = (
        [len(values) for values in grid.values() if isinstance(values, list)]
        if isinstance(grid, dict)
        else []
    )
    sizes.append(len(given) if isinstance(given, list) else 1)
    counts = [
        nights.get("count") if isinstance(nights, dict) else nights,
        value.get("realizations"),
    ]
    return (
        math.prod(max(1, n) for n in [*sizes, *(n for n in counts if isinstance(n, int))])
        > MOST_TASKS
    )


def mistakes(
    document: Document,
    value: Campaign,
    known: list[Diagnostic],
    check: Callable[[Document], list[Diagnostic]],
) -> list[Diagnostic]:
    """Mistakes of a document with a campaign. The axes are checked only in a file without other
    mistakes.

    Parameters
    ----------
    known
        Mistakes that were found; those of an axis are placed there.
    check
        Lists the mistakes of a document without the campaign.
    """
    found = [_at_axis(mistake, document, value) for mistake in known] or _mistakes(
        document,
        value,
        check,
    )
    if not found and value.figures and not _measures(document):
        steps = " or ".join(f"- {name}: {{metrics: [...]}}" for name in makers("figures"))
        at = document.mark(("campaign", "figures")).start
        found = [
            Diagnostic(
                "no step measures figures for the table",
                at,
                "",
                f"add {steps or 'a step that does'}",
            )
        ]
    return found


def rewrite_sweep(document: Document) -> list[Diagnostic]:
    """Replace the key ``sweep`` by a campaign that co-adds nothing; return the mistakes.

    Mistakes in the axes are found by the campaign, at their places in the sweep.
    """
    value = document.value.pop("sweep")
    mistakes = Mistakes(document, None, [])
    if "campaign" in document.value:
        mistakes.wrong(
            "a pipeline has either a sweep or a campaign",
            document.mark(("sweep",)).start,
            "",
            "remove one of them",
        )
    elif mistakes.validate(Sweep, value, ("sweep",), "sweep") is not None:
        called = {key: Sweep.CALLED.get(key, key) for key in value}
        document.value["campaign"] = {called[key]: value[key] for key in value} | {
            "combine": [],
            "paired": True,
            "figures": True,
        }
        for path, mark in list(document.marks.items()):
            if path[0:1] == ("sweep",):
                document.marks[("campaign", *(called.get(k, k) for k in path[1:2]), *path[2:])] = (
                    mark
                )
    return mistakes.found


def _measures(document: Document) -> bool:
    """True if a step of a document without mistakes makes figures."""
    return any("figures" in declared(operators.get(name), "provides") for name in _names(document))


def _names(document: Document) -> list[str]:
    """The names of the steps that are written as they should be."""
    items = document.value.get("operators")
    each = [
        item if isinstance(item, str) else next(iter(item), "")
        for item in items or ()
        if isinstance(item, str | dict)
    ]
    return [str(name) for name in each]


def _takes_schedule(kind: type[Operator]) -> bool:
    """True if an operator's class makes scans of a schedule."""
    return "schedule" in kind.model_fields and "boresight" in declared(kind, "provides")


def _mistakes(
    document: Document,
    campaign: Campaign,
    check: Callable[[Document], list[Diagnostic]],
) -> list[Diagnostic]:
    """Mistakes in the keys and values of ``grid`` and ``observations``, each at its place in the
    file.

    ``check`` lists the mistakes of a document; each value is put where it would go and checked
    there.
    """
    found: list[Diagnostic] = []
    refused: set[str] = set()
    grid: list[list[tuple[str, tuple[Any, ...]]]] = [
        [(key, ("campaign", "grid", key, k))]
        for key, values in campaign.grid.items()
        for k in range(len(values))
    ]
    listed = [
        [(key, ("campaign", "observations", k, key)) for key in entry]
        for k, entry in enumerate(campaign.observations)
    ]
    for together in [*grid, *listed]:
        changed = document.copy()
        wrong = False
        for key, path in together:
            span = document.mark(path[:3] if path[1] == "grid" else path).start
            if key in refused:
                wrong = True
            elif key.split(".")[0] in REFUSED:
                found.append(
                    Diagnostic(
                        f"'{key}' cannot change from one entry to the next",
                        span,
                        "",
                        REFUSED_WHY,
                    )
                )
                refused.add(key)
            elif unknown := overrides.put(changed, key, document.sub(path), span, KEYS):
                found += unknown
                refused.add(key)
            wrong |= key in refused
        found += [] if wrong else check(changed)
    return found


def _at_axis(mistake: Diagnostic, document: Document, campaign: Campaign) -> Diagnostic:
    """A key that the pipeline lacks and an axis names: the mistake at the place of the axis; any
    other mistake as it is.
    """
    paths: dict[str, tuple[Any, ...]] = {key: ("campaign", "grid", key) for key in campaign.grid}
    for k, entry in enumerate(campaign.observations):
        paths = {key: ("campaign", "observations", k, key) for key in entry} | paths
    for key, path in paths.items():
        if mistake.message == f"the pipeline needs '{key}'":
            here = document.sub(path).value
            first = setting(
                key,
                here[0] if path[1] == "grid" and isinstance(here, list) else here,
            ).partition("=")[2]
            cure = (
                f"write '{key}: {first}' at the top level too: the file is checked with it, and"
                " each entry puts its own there"
            )
            return Diagnostic(
                f"the axis '{key}' changes what the pipeline does not have",
                document.mark(path).start,
                "",
                cure,
            )
    return mistake


REFUSED = (
    "version",
    "name",
    "description",
    "requires",
    "outputs",
    "campaign",
    "sweep",
    "runs",
    "operators",
)
REFUSED_WHY = (
    "an axis is a key of the scene (seed, site, instrument, time, target, weather), precision, or a"
    " step's parameter"
)
