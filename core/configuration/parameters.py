"""Base class of everything a user configures: a frozen, checked set of parameters with units."""

from __future__ import annotations

import ast
import inspect
import linecache
import re
import sys
import textwrap
import tokenize
from contextlib import suppress
from itertools import pairwise, takewhile
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler, ValidationError
from pydantic.fields import FieldInfo

from ..errors import ZondaError


def quantity(default: str, **limits: Any) -> Any:
    """Default of a field with a unit: ``radius: Angle = quantity("4 arcmin", gt=0)``.

    Typed Any because the text becomes a float when the class is validated. Limits are in SI.
    """
    return Field(default, **limits)


def named(names: Any, value: Any) -> Any:
    """What a registered name stands for (``names``: a `core.registry.Registry`); what is no text is returned as it is.

    Raises PydanticCustomError, which is shown at the value's place.
    """
    if not isinstance(value, str):
        return value
    try:
        return names.create(value)
    except ZondaError as err:
        from .diagnostics import refusal

        raise refusal(err) from None


if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass as _Shown
else:

    class _Shown(type(BaseModel)):
        """How classes of parameters look to `help()` and to tab completion: their parameters, without pydantic's own names.

        All is worked out when somebody asks.
        """

        @property
        def __doc__(cls) -> str:
            from .describe import document

            return document(cls)

        @property
        def __signature__(cls) -> inspect.Signature:
            from .describe import signature

            return signature(cls)

        @__signature__.setter
        def __signature__(cls, value: Any) -> None:
            """pydantic sets its own, whose types nobody can read."""

        def __dir__(cls) -> list[str]:
            return [name for name in sorted(super().__dir__()) if name not in _PYDANTICS and not name.startswith("__pydantic")]


_PYDANTICS = {name for name in dir(BaseModel) if name not in dir(object)} | {
    "_abc_impl",
    "__class_vars__",
    "__private_attributes__",
}
"""Names that pydantic gives every class."""


class Parameters(BaseModel, metaclass=_Shown):
    """A frozen, validated parameter set. Attribute docstrings become schema descriptions and error messages."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)

    if not TYPE_CHECKING:  # a type checker sees the fields

        def __init__(self, /, *values: Any, **given: Any) -> None:
            """Raises `ParameterError`, a ZondaError, with every mistake in the parameters."""
            __tracebackhide__ = True
            if values:
                from .calls import positional

                raise positional(type(self), values)
            try:
                super().__init__(**given)
            except ValidationError as err:
                from .calls import mistakes_of

                raise mistakes_of(err, type(self), given) from None

        __init__.__pydantic_base_init__ = True  # what is validated as a field is not made by it: contexts and places are kept

        def __setattr__(self, name: str, value: Any) -> None:
            try:
                super().__setattr__(name, value)
            except ValidationError:
                from .calls import changed

                raise changed(type(self), name) from None

    def __repr__(self) -> str:
        """The call that makes an equal one: what was given, in units that people use."""
        return f"{type(self).__name__}({', '.join(f'{name}={text}' for name, text in self._arguments().items())})"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        from ..data import html_table

        given = self._arguments()
        dumped = self.model_dump(mode="json")
        rest = [
            (name, dumped[name]) for name in type(self).model_fields if name not in given and dumped.get(name) not in (None, "")
        ]
        return html_table(type(self).__name__, [*given.items(), *((name, f"{value} (default)") for name, value in rest)])

    def __dir__(self) -> list[str]:
        return [name for name in sorted(super().__dir__()) if name not in _PYDANTICS and not name.startswith("__pydantic")]

    def _arguments(self) -> dict[str, str]:
        """What was given, by name, as Python text."""
        dumped = self.model_dump(mode="json", include=self.model_fields_set)
        names = [name for name in type(self).model_fields if name in self.model_fields_set]
        return {name: _written(getattr(self, name), dumped.get(name)) for name in names}

    def _as_argument(self) -> str:
        """Python text that a field which holds this takes."""
        return repr(self.model_dump(mode="json", include=self.model_fields_set))

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        frame = sys._getframe(1)
        while frame.f_back is not None and frame.f_globals.get("__name__") != cls.__module__:
            frame = frame.f_back  # through pydantic's metaclass, to where the class statement stands
        _places[cls] = (frame.f_code.co_filename, frame.f_lineno, frame.f_globals)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        from .describe import own_doc

        made = handler(schema)
        resolved = handler.resolve_ref_schema(made)
        properties = resolved.get("properties", {})
        if "description" in resolved:
            resolved["description"] = own_doc(cls)
        for name, field in described(cls).items():
            if name in properties and field.description:
                properties[name].setdefault("description", field.description)
        return made


def named_or_written(component: Any, names: Any) -> str:
    """The name under which ``component`` is registered in ``names``, quoted; where it is not, the call that makes it."""
    with suppress(ZondaError):
        if component.name in names and names.create(component.name) == component:
            return repr(component.name)
    return repr(component)


def _written(value: Any, dumped: Any) -> str:
    if isinstance(value, Parameters):
        return value._as_argument()
    return repr(value if dumped is None else dumped)


_places: dict[type, tuple[str, int, dict[str, Any]]] = {}
"""Where the class statements stand: file, line, globals of the module."""
_documented: dict[type, dict[str, str]] = {}


def described(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of ``model``, with their docstrings as descriptions.

    These are read from the source when somebody asks, not when the class is made (pydantic's ``use_attribute_docstrings``):
    that takes a third of a second for the classes of a run, which asks for none.
    """
    for name, field in model.model_fields.items():
        if field.description is None:
            nearest = next((own for cls in model.__mro__ if name in (own := _docstrings(cls))), {})
            field.description = nearest.get(name) or None
    return model.model_fields


def _docstrings(cls: type) -> dict[str, str]:
    """The docstring of each attribute that the class itself annotates, empty where it has none."""
    if cls not in _places:
        return {}
    if cls not in _documented:
        file, line, module = _places[cls]
        _documented[cls] = _of_class(linecache.getlines(file, module)[line - 1 :], cls.__name__)
    return _documented[cls]


def _of_class(lines: list[str], name: str) -> dict[str, str]:
    """As `_docstrings`, from lines that begin with the class statement or its decorators."""
    for block in (_by_indentation, inspect.getblock):  # the second reads tokens: slow, and never wrong
        try:
            statement = ast.parse(textwrap.dedent("".join(block(lines)))).body[0]
        except (SyntaxError, IndexError, ValueError, tokenize.TokenError):  # the file has changed meanwhile
            continue
        if isinstance(statement, ast.ClassDef) and statement.name == name:
            found = {}
            for one, after in pairwise([*statement.body, ast.Pass()]):
                if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
                    text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else None
                    found[one.target.id] = inspect.cleandoc(text) if isinstance(text, str) else ""
            return found
    return {}


def _by_indentation(lines: list[str]) -> list[str]:
    """The class statement and what is indented more, but for the methods behind the last annotation.

    It may end too early, within brackets or texts.
    """
    indent = len(lines[0]) - len(lines[0].lstrip())
    head = len(list(takewhile(lambda line: not line.lstrip().startswith("class "), lines))) + 1
    body = list(takewhile(lambda line: not line.strip() or len(line) - len(line.lstrip()) > indent, lines[head:]))
    inner = next((line[: len(line) - len(line.lstrip())] for line in body if line.strip()), "")
    last = max((k for k, line in enumerate(body) if re.match(rf"{inner}[A-Za-z_]\w* *:", line)), default=0)
    methods = next((k for k in range(last, len(body)) if re.match(rf"{inner}(@|def |async |class )", body[k])), len(body))
    return [*lines[:head], *body[:methods]]
