"""Docstrings of classes of parameters and of their fields, read from the source when somebody
asks.
"""

from __future__ import annotations

import ast
import inspect
import linecache
import sys
import textwrap
import tokenize
from itertools import pairwise
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

_places: dict[type, tuple[str, int, dict[str, Any]]] = {}
"""Places of class statements: file, line, globals of the module."""
_documented: dict[type, dict[str, str]] = {}


def remember_place(cls: type) -> None:
    """Remember where the class statement of ``cls`` stands; called while the class is made."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__") != cls.__module__:
        frame = frame.f_back  # through pydantic's metaclass, to where the class statement stands
    _places[cls] = (frame.f_code.co_filename, frame.f_lineno, frame.f_globals)


def own_doc(cls: type) -> str:
    """The docstring as it stands in the class."""
    return inspect.cleandoc(
        next(
            (
                own
                for c in cls.__mro__
                if (own := c.__dict__.get("__doc__")) and isinstance(own, str)
            ),
            "",
        )
    )


def described(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of ``model``, with their docstrings as descriptions.

    These are read from the source when somebody asks, not when the class is made (pydantic's
    ``use_attribute_docstrings``): that takes a third of a second for the classes of a run, which
    asks for none.
    """
    for name, field in model.model_fields.items():
        if field.description is None:
            nearest = next((own for cls in model.__mro__ if name in (own := _docstrings(cls))), {})
            field.description = nearest.get(name) or None
    return model.model_fields


def source_is_known(model: type) -> bool:
    """True if the source of the class and of its bases can be read, which is not so for what was
    typed at the prompt of `python`.
    """
    places = [_places[cls] for cls in model.__mro__ if cls in _places]
    return all(linecache.getlines(file, module) for file, _, module in places)


def _docstrings(cls: type) -> dict[str, str]:
    """The docstring of each attribute that the class itself annotates, empty where it has none."""
    if cls not in _places:
        return {}
    if cls not in _documented:
        file, line, module = _places[cls]
        _documented[cls] = _of_class(linecache.getlines(file, module)[line - 1 :], cls.__name__)
    return _documented[cls]


def _of_class(lines: list[str], name: str) -> dict[str, str]:
    """Docstrings of fields, from lines that begin with the class statement or its decorators."""
    try:
        statement = ast.parse(textwrap.dedent("".join(inspect.getblock(lines)))).body[0]
    except (
        SyntaxError,
        IndexError,
        ValueError,
        tokenize.TokenError,
    ):  # the file has changed meanwhile
        return {}
    if not isinstance(statement, ast.ClassDef) or statement.name != name:
        return {}
    found = {}
    for one, after in pairwise([*statement.body, ast.Pass()]):
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
            text = (
                after.value.value
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                else None
            )
            found[one.target.id] = inspect.cleandoc(text) if isinstance(text, str) else ""
    return found
