"""Docstrings of parameters, read from the source when they are asked for."""

from __future__ import annotations

import inspect
import linecache
from typing import ClassVar

import pytest
from pydantic import BaseModel, ConfigDict, Field
from pydantic._internal._docs_extraction import extract_docstrings_from_cls

from zonda.core import registry
from zonda.core.configuration.describe import _of_class, described
from zonda.core.configuration.parameters import Parameters


class Plain(Parameters):
    """Base."""

    one: int = 1
    """The first;
    on two lines."""
    two: int = Field(2, description="Said here.")
    """Not this."""
    three: int = 3


# fmt: off
class Odd(
    Plain,
):
    """Brackets that close at the margin, a text that begins there."""

    TEXT: ClassVar[str] = """
and goes on at the margin
"""
    two: int = 20
    four: int = 4
    """The fourth."""

    def five(self) -> str:
        """No field."""
        six: str = ""
        """Not one either."""
        return six
# fmt: on


def texts(model: type[BaseModel]) -> dict[str, str | None]:
    return {name: field.description for name, field in described(model).items()}


def test_docstrings_are_those_of_the_nearest_class_that_has_the_field() -> None:
    assert texts(Plain) == {"one": "The first;\non two lines.", "two": "Said here.", "three": None}
    assert texts(Odd) == {
        "one": "The first;\non two lines.",
        "two": None,
        "three": None,
        "four": "The fourth.",
    }


def test_two_classes_of_one_name_have_their_own() -> None:
    def first() -> type[Parameters]:
        class Local(Parameters):
            a: int = 1
            """Of the first."""

        return Local

    def second() -> type[Parameters]:
        class Local(Parameters):
            a: int = 1
            """Of the second."""

        return Local

    assert texts(first()) == {"a": "Of the first."}
    assert texts(second()) == {"a": "Of the second."}


def test_a_class_of_a_notebook_cell_is_read_and_one_without_source_has_none() -> None:
    text = (
        "from zonda.core.configuration.parameters import Parameters\nclass Cell(Parameters):\n   "
        ' a: int = 1\n    """Here."""\n'
    )
    linecache.cache["<cell>"] = (len(text), None, text.splitlines(True), "<cell>")
    for name, wanted in (("<cell>", "Here."), ("<nowhere>", None)):
        module: dict[str, type[Parameters]] = {}
        exec(compile(text, name, "exec"), {"__name__": "cell"}, module)
        assert texts(module["Cell"]) == {"a": wanted}


@pytest.mark.parametrize(
    "lines",
    [
        ["class A(Parameters):\n", "    x: int = (\n"],
        ["class A(Parameters):\n", '    """\n'],
        ["x = 1\n"],
        ["class A: '\0'\n"],
        [],
    ],
)
def test_a_file_that_was_changed_after_it_was_read_has_none(lines: list[str]) -> None:
    assert _of_class(lines, "A") == {}


@pytest.mark.parametrize("kind", [registry.operators, registry.weather_sources])
def test_they_are_what_pydantic_finds(kind: registry.Registry) -> None:
    for name in kind:
        model = kind.get(name)
        wanted: dict[str, str] = {}
        for cls in reversed(model.__mro__):
            if issubclass(cls, Parameters) and cls is not Parameters:
                own = extract_docstrings_from_cls(cls, use_inspect=True)
                wanted |= {field: own.get(field, "") for field in inspect.get_annotations(cls)}
        assert texts(model) == {field: wanted[field] for field in model.model_fields}


def test_schema_has_them() -> None:
    class Outer(Parameters):
        inner: Plain | None = None
        """A nested one."""
        model_config = ConfigDict(title="Outside")

    schema = Outer.model_json_schema()
    assert schema["properties"]["inner"]["description"] == "A nested one."
    assert (
        schema["$defs"]["Plain"]["properties"]["one"]["description"] == "The first;\non two lines."
    )
