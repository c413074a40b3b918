"""Labels: what steps are called in messages, products and random streams."""

from __future__ import annotations

from pydantic import PrivateAttr

from .configuration.parameters import Parameters


class Labelled(Parameters):
    """Something with parameters and a label of its own in a pipeline."""

    name: str | None = None
    """Label of this step in messages, products and random streams; the class name where absent."""

    _label: str = PrivateAttr("")

    @property
    def label(self) -> str:
        """Unique name of this step in its pipeline (the pipeline numbers namesakes: ``WhiteNoise``, ``WhiteNoise.2``)."""
        return self._label or self.name or type(self).__name__
