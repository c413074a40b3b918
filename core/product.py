"""Partial products: what a step adds up from observation to observation, until `Operator.finalize` makes products of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, ClassVar, Self


class Product(ABC):
    """Something that observations add to: sums in pixels, spectra, lists of files.

    `Operator.collect` hands one observation's share to `Data.add`, `Operator.finalize` takes the sum with `Data.take`. A campaign
    adds up the shares of its tasks without knowing the operator: what crosses from one process to another are `arrays`. Its
    class is then found by its name in the registry (entry-point group ``zonda.products``).
    """

    zonda_api: ClassVar[int] = 1

    @abstractmethod
    def __iadd__(self, other: Self) -> Self:
        """Add what later observations made. Raises PipelineError where the two cannot be added up."""

    @abstractmethod
    def arrays(self) -> Mapping[str, Any]:
        """All of it as plain values (numbers, texts, lists and mappings of these) and numpy arrays."""

    @classmethod
    @abstractmethod
    def of(cls, arrays: Mapping[str, Any]) -> Self:
        """What `arrays` gave, put together again."""

    def subtract(self, name: str, parts: Sequence[str]) -> None:
        """Make that of the signal ``name``: that of ``signal`` minus those of the signals ``parts``, all of which are in it.

        Only asked of products of map makers (`core.mapmaker`) that are linear.
        """
        raise NotImplementedError


class Record(Product):
    """A product that is a dataclass: what crosses are its fields."""

    def arrays(self) -> Mapping[str, Any]:
        """Its fields."""
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> Self:
        """See `Product.of`."""
        return cls(**arrays)
