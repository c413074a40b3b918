"""Mistakes in a document, gathered on the way to the objects that it describes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from ..components import Registry
from ..errors import ZondaError
from .diagnostics import ConfigurationError, Diagnostic, refused
from .explain import explain
from .parameters import Parameters
from .yaml_places import Document, Span
from .yaml_places import Path as Place

P = TypeVar("P", bound=Parameters)


class Mistakes:
    """A document and what was found wrong with it.

    Parameters
    ----------
    folder
        Where relative paths in the document are looked for first.
    """

    def __init__(
        self, document: Document, folder: str | Path | None, found: list[Diagnostic]
    ) -> None:
        self.document, self.found = document, found
        self.context = {"folder": folder}

    def wrong(self, message: str, span: Span, label: str = "", help: str = "") -> None:
        """Note a mistake."""
        self.found.append(Diagnostic(message, span, label, help))

    def validate(
        self, model: type[P], value: Any, at: Place, who: str, keys: Iterable[str] = ()
    ) -> P | None:
        """Validated ``value`` at ``at``, or None if it is mistaken. ``who`` and ``keys`` are those
        of `explain`.
        """
        try:
            return model.model_validate(value, context=self.context)
        except ValidationError as err:
            self.found += explain(err, model, self.document, at, who, keys)
        except ZondaError as err:
            self.refused(err, self.document.mark(at).start)
        return None

    def refused(self, err: ZondaError, span: Span) -> None:
        """Note an error that says what is wrong at ``span``."""
        self.found.append(refused(err, span))

    def named(self, given: dict[str, Any], key: str, names: Registry, at: Place) -> bool:
        """Put what the name stands for in its place; False where there is no such thing."""
        if not isinstance(given.get(key), str):
            return True
        try:
            given[key] = names.create(given[key], self.context["folder"])
        except ConfigurationError as err:
            self.found += err.diagnostics
            return False
        except ZondaError as err:
            self.refused(err, self.document.mark(at).value)
            return False
        return True
