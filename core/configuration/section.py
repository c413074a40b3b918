"""A key of pipeline files whose meaning lives above configuration: entry-point group
``zonda.sections``, by the key.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from .diagnostics import Diagnostic

if TYPE_CHECKING:
    from .yaml_places import Document


class Section:
    """What the checks of a pipeline file ask about one of its keys; never instantiated."""

    header: ClassVar[type[Any]]
    """The `Header` of a file that has the key."""

    @staticmethod
    def too_large(value: Any) -> bool:
        """Whether the mapping, as it was written, is larger than allowed: nothing else is checked
        then.
        """
        return False

    @staticmethod
    def rewrite(document: Document) -> list[Diagnostic]:
        """Replace the key, which is there, by others that mean the same; what is wrong with it."""
        return []

    @staticmethod
    def mistakes(
        document: Document,
        value: Any,
        known: list[Diagnostic],
        check: Callable[[Document], list[Diagnostic]],
    ) -> list[Diagnostic]:
        """All mistakes of a document: ``known`` ones, perhaps reworded, and those in the section's
        ``value``.

        ``check`` lists the mistakes of a document without the section.
        """
        return known
