"""Built-in sites, from data/sites.csv: each name and alias in the table is an attribute of this
module, for an entry point.

>>> from zonda.plugins import sites
>>> sites.chajnantor.altitude
5064.0
"""

from __future__ import annotations

import csv
from functools import lru_cache
from pathlib import Path

from zonda.core.site import Site

TABLE = Path(__file__).parent / "data" / "sites.csv"


@lru_cache(maxsize=1)
def table() -> dict[str, dict[str, str]]:
    """Rows of the table by name and by alias."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        return {
            name: row
            for row in csv.DictReader(file)
            for name in (row["name"], *row["aliases"].split())
        }


def __getattr__(name: str) -> Site:
    row = table().get(name)
    if row is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return Site(
        name=row["name"],
        description=row["description"],
        latitude=f"{row['latitude_deg']} deg",
        longitude=f"{row['longitude_deg']} deg",
        altitude=f"{row['altitude_m']} m",
        climatology=row["climatology"] or None,
        provenance=row["provenance"],
    )


def __dir__() -> list[str]:
    return sorted(table())
