"""Products that draw themselves: `Plots` and `Report` show them without knowing their step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable


@dataclass(frozen=True)
class Sketch:
    """Picture that is drawn but not printed: ``name`` without suffix, a title, what it shows, one
    of its matplotlib Axes.
    """

    name: str
    title: str
    caption: str
    ax: Any


@runtime_checkable
class Drawable(Protocol):
    """Product with pictures of its own."""

    def sketches(self, name: str) -> list[Sketch]:
        """Pictures whose names begin with ``name``, on matplotlib figures that belong to nobody
        else (not to pyplot).
        """
