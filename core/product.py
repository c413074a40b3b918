"""Partial products: what a step adds up from observation to observation, until `Operator.finalize`
makes products of it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, ClassVar, Self

from .discovery import API_VERSION
from .errors import PipelineError


class Product(ABC):
    """Something that observations add to: sums in pixels, spectra, lists of files.

    `Operator.collect` hands one observation's share to `Data.add`, `Operator.finalize` takes the
    sum with `Data.take`. A campaign adds up the shares of its tasks without knowing the operator:
    what crosses from one process to another are `arrays`, and `identity`, by which the other
    process finds the class: it has imported the modules of all steps.
    """

    zonda_api: ClassVar[int] = API_VERSION
    kinds: ClassVar[dict[str, type[Product]]] = {}
    """Imported classes of products, by `identity`."""

    in_files: ClassVar[bool] = False
    """Its arrays may be in files, memory-mapped, where those of a campaign do not fit in memory."""

    signals: tuple[str, ...] = ()
    """Streams of the signals that it holds (`core.signal`), the complete one first; empty: it is of
    no signal in particular.
    """

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        cls.kinds[cls.identity()] = cls

    @classmethod
    def identity(cls) -> str:
        """Place of this class for another process: ``module:class``."""
        return f"{cls.__module__}:{cls.__qualname__}"

    @abstractmethod
    def __iadd__(self, other: Self) -> Self:
        """Add what later observations made. Raises PipelineError where the two cannot be added
        up.
        """

    @abstractmethod
    def arrays(self) -> Mapping[str, Any]:
        """Its content as plain values (numbers, texts, lists and mappings of these) and numpy
        arrays.
        """

    @classmethod
    @abstractmethod
    def of(cls, arrays: Mapping[str, Any]) -> Self:
        """Restore a product from `arrays`."""

    def subtract(self, stream: str, parts: Sequence[str]) -> None:
        """Add what belongs to the signal ``stream``: that of ``signal`` minus those of ``parts``,
        all of which are in `signals`.

        Called for products of linear map makers only (`core.mapmaker`). Raises PipelineError where
        the class does not have it.
        """
        raise PipelineError(
            f"a {type(self).__name__} cannot subtract signals from one another, which a linear map"
            " maker needs",
            place=stream,
            cure=(
                f"write {type(self).__name__}.subtract, or leave linear = True out of its map maker"
            ),
        )


class Record(Product):
    """A product that is a dataclass: what crosses are its fields."""

    def arrays(self) -> Mapping[str, Any]:
        """Its fields."""
        own = fields(self)  # type: ignore[arg-type]
        return {field.name: getattr(self, field.name) for field in own}

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> Self:
        """See `Product.of`."""
        return cls(**arrays)
