"""Labels: what steps are called in messages, products and random streams."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import PrivateAttr

from .configuration.parameters import Parameters


def labels(steps: Iterable[Labelled]) -> list[str]:
    """Their labels in a pipeline, which numbers namesakes: ``WhiteNoise``, ``WhiteNoise.2``."""
    seen: dict[str, int] = {}
    found = []
    for step in steps:
        base = step.name or type(step).__name__
        seen[base] = seen.get(base, 0) + 1
        found.append(base if seen[base] == 1 else f"{base}.{seen[base]}")
    return found


class Labelled(Parameters):
    """Something with parameters and a label of its own in a pipeline."""

    name: str | None = None
    """Label of this step in messages, products and random streams; the class name where absent."""

    _label: str = PrivateAttr("")

    @property
    def label(self) -> str:
        """Unique name of this step in its pipeline (the pipeline numbers namesakes: ``WhiteNoise``,
        ``WhiteNoise.2``).
        """
        return self._label or self.name or type(self).__name__
