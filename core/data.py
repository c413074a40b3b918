"""What flows: the scene, its observations, the blocks that operators work on, and the products."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from .block import STREAMS, Block
from .errors import PipelineError
from .notebook import html_table
from .observation import Observation
from .product import Product
from .stream import Stream, in_order
from .tally import Tally, percent

if TYPE_CHECKING:
    from .scene import Scene

__all__ = ["STREAMS", "Block", "Data", "Observation", "Stream", "Tally", "html_table", "in_order", "percent"]


@dataclass
class Data:
    """The scene, its observations, and what came out of them.

    ``products`` maps names to whatever operators made (maps, spectra, file paths); products of another signal than the
    complete one (see `core.signal`) carry its name and a slash: ``noiseless/map``.
    """

    scene: Scene
    observations: list[Observation] = field(default_factory=list)
    products: dict[str, Any] = field(default_factory=dict)
    tally: Tally = field(default_factory=Tally)
    provenance: dict[str, Any] = field(default_factory=dict)
    output: Any = None
    """Folder (Path) that products are written to; None: nothing is written."""
    threads: int = 1
    """Threads that the run may use."""

    partial: dict[str, Product] = field(default_factory=dict)
    """What steps have added up so far, by label."""
    layouts: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    """By label: what all observations have in common (the grid of a map), as plain values and arrays; ``fixed: True`` says
    that further observations cannot change it. `Operator.observe` makes it, or extends what earlier parts of a campaign made."""
    laid_out: bool = False
    """The layouts are those of all parts of a campaign: `Operator.observe` takes them as they are."""

    def add(self, label: str, product: Product) -> None:
        """Add an observation's share to the partial product of a step."""
        whole = self.partial.setdefault(label, product)
        if type(whole) is not type(product):
            cure = "a step adds up products of one class"
            raise PipelineError(f"added a {type(product).__name__} to a {type(whole).__name__}", place=label, cure=cure)
        if whole is not product:
            whole += product
            self.partial[label] = whole

    def take(self, label: str) -> Any:
        """The partial product of a step, None where it has none; it is not held here any longer."""
        return self.partial.pop(label, None)

    def __repr__(self) -> str:
        return f"<Data: {len(self.observations)} observations, products {sorted(self.products)}>"

    def _repr_html_(self) -> str:
        return html_table(
            "Data",
            [(o.name, f"{o.n_detectors} x {o.n_samples}") for o in self.observations]
            + [("products", ", ".join(sorted(self.products)))],
        )
