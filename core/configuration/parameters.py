"""Base class of everything a user configures: a frozen, checked set of parameters with units."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping
from contextlib import suppress
from itertools import chain
from types import FunctionType
from typing import TYPE_CHECKING, Any

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    PydanticUserError,
    ValidationError,
)
from pydantic.fields import FieldInfo

from ..errors import ZondaError
from ..tables import html_table
from .describe import described, document, own_doc, remember_place, signature
from .diagnostics import ConfigurationError, Diagnostic, refusal
from .explain import explain
from .yaml_places import Document, Mark, Path, Source, Span

LONGEST = 60
"""Characters of a value that are shown."""


class ParameterError(ConfigurationError, ValueError):
    """Parameters of an operator, a scene, an instrument ... that cannot be used, each with its
    cause and cure.

    Attributes
    ----------
    diagnostics
        One per mistake.
    """

    def render(self, colour: bool = False) -> str:
        """Each mistake with its cure, indented."""
        rows = []
        for found in self.diagnostics:
            cures = [text for text in (found.label, *found.help.splitlines()) if text]
            rows += [found.message, *(f"  = {text}" for text in cures)]
        return "\n".join(rows)


def mistakes_of(
    error: ValidationError,
    model: type[BaseModel],
    given: Mapping[str, Any],
) -> ParameterError:
    """``error``, which a call ``model(**given)`` met, as what a user reads."""
    document = _as_document(model.__name__, given)
    found = explain(error, model, document, (), model.__name__, python=True)
    return ParameterError(found, f"{model.__name__}(...)")


def positional(model: type[BaseModel], values: tuple[Any, ...]) -> ParameterError:
    """A call with values that have no names. The example is the first parameter; of a quantity one
    that takes it, the model's own before inherited ones.
    """
    fields = list(model.model_fields)
    bases = [base.model_fields for base in model.__mro__ if hasattr(base, "model_fields")]
    own = sorted(fields, key=lambda name: sum(name in base for base in bases))
    quantity = str(values[0])[:1].isdigit()
    taking = (name for name in own if quantity and _takes(model, name, values[0]))
    example = next((name for name in chain(taking, fields) if name != "name"), "name")
    label = f"name {'it' if len(values) == 1 else 'each'}, as in {example}={_short(values[0])}"
    message = f"{model.__name__} takes its parameters by their names"
    return _one(message, label, f"{model.__name__} takes: {', '.join(fields)}")


def _takes(model: type[BaseModel], name: str, value: Any) -> bool:
    try:
        model.model_validate({name: value})
    except ValidationError as err:
        return all(one["loc"][:1] != (name,) for one in err.errors())
    return True


def changed(model: type[BaseModel], name: str) -> ParameterError:
    """An attribute that somebody tried to change."""
    cure = f"make another: {model.__name__}({name}=..., ...)"
    return _one(f"a {model.__name__} is not changed once it is made", "", cure)


def _one(message: str, label: str, cure: str) -> ParameterError:
    return ParameterError([Diagnostic(message, Span(Source("", "")), label, cure)], "")


def _as_document(name: str, given: Mapping[str, Any]) -> Document:
    """The arguments of a call as a document; places are numbered in the order of the call."""
    marks: dict[Path, Mark] = {}
    source = Source(f"{name}(...)", "")

    def mark(value: Any, path: Path) -> None:
        place = len(marks)
        marks[path] = Mark(Span(source, place, 0, place))
        if isinstance(value, Mapping | list | tuple):
            pairs = value.items() if isinstance(value, Mapping) else enumerate(value)
            for key, inner in pairs:
                mark(inner, (*path, key))

    mark(given, ())
    return Document(dict(given), marks, [])


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..."


def without_a_type(
    name: str,
    bases: tuple[type, ...],
    namespace: Mapping[str, Any],
    error: Exception,
) -> ZondaError:
    """A class ``name`` of parameters, one of whose attributes pydantic cannot take."""
    typed = namespace.get("__annotations__", {})
    kinds = (FunctionType, property, classmethod, staticmethod, type)
    plain = {
        k: v
        for k, v in namespace.items()
        if not k.startswith("_") and k not in (*typed, "model_config") and not isinstance(v, kinds)
    }
    fields = {field for base in bases for field in getattr(base, "model_fields", {})}
    methods = {k for k in plain if any(callable(getattr(base, k, None)) for base in bases)}
    constants = {k for base in bases for k in getattr(base, "__class_vars__", ())}
    for attribute, value in plain.items():
        if attribute in constants:
            continue
        text = f"{attribute} = {value!r:.40}"
        if attribute in methods:
            return ZondaError(
                f"{text}: {attribute} is a method",
                place=name,
                cure=f"write def {attribute}(self, ...): ...",
            )
        if attribute == "name" and attribute in fields:
            cure = (
                "leave it out, and give a step its label where it is made:"
                f" {name}(name={value!r:.40})"
            )
            return ZondaError(
                f"{text}: the label of a step is no constant of its class",
                place=name,
                cure=cure,
            )
        kind = type(value).__name__ if value is not None else "Any"
        if isinstance(value, FieldInfo):
            written = f"quantity({value.default!r:.40})"
            cure = f"write {attribute}: TYPE = {written} with a type, e.g. zonda.Seconds"
            return ZondaError(f"{attribute} = {written} has no type", place=name, cure=cure)
        cure = (
            f"write {attribute}: {kind} = {value!r:.40} for a parameter, {attribute}:"
            f" ClassVar[{kind}] = ... for a constant"
        )
        return ZondaError(f"{text} has no type", place=name, cure=cure)
    return ZondaError(
        f"its parameters cannot be used: {str(error).splitlines()[0]}",
        place=name,
        cure="give each the type of a number, a text or a list, or one of zonda's (zonda.Seconds)",
    )


def quantity(default: str, **limits: Any) -> Any:
    """Default of a field with a unit: ``radius: Angle = quantity("4 arcmin", gt=0)``.

    Typed Any because the text becomes a float when the class is validated. Limits are in SI.
    """
    return Field(default, **limits)


def named(names: Any, value: Any) -> Any:
    """The component that a registered name stands for (``names``: a `core.registry.Registry`); a
    value that is no text is returned as it is.

    Raises PydanticCustomError, which is shown at the value's place.
    """
    if not isinstance(value, str):
        return value
    try:
        return names.create(value)
    except ZondaError as err:
        raise refusal(err) from None


if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass as _Shown
else:

    class _Shown(type(BaseModel)):
        """Metaclass that shows classes of parameters to `help()` and tab completion with their
        parameters, without pydantic's own names.

        All is worked out when somebody asks.
        """

        def __new__(
            mcls, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **more: Any
        ) -> Any:
            """Raises ZondaError for what is neither a parameter nor a constant."""
            try:
                return super().__new__(mcls, name, bases, namespace, **more)
            except PydanticUserError as err:
                raise without_a_type(name, bases, namespace, err) from None

        @property
        def __doc__(cls) -> str:
            return document(cls)

        @property
        def __signature__(cls) -> inspect.Signature:
            return signature(cls)

        @__signature__.setter
        def __signature__(cls, value: Any) -> None:
            """pydantic sets its own, whose types nobody can read."""

        @property
        def __mro__(cls) -> tuple[type, ...]:
            """The true one; `help()` is shown it without pydantic's class."""
            order = super().__mro__
            asked_by = sys._getframe(1).f_back  # pydoc, by way of inspect.getmro
            shown = asked_by is not None and asked_by.f_globals.get("__name__") == "pydoc"
            return tuple(c for c in order if c is not BaseModel) if shown else order

        def __dir__(cls) -> list[str]:
            return [
                name
                for name in sorted(super().__dir__())
                if name not in _PYDANTICS and not name.startswith("__")
            ]


_PYDANTICS = {name for name in dir(BaseModel) if name not in dir(object)} | {
    "_abc_impl",
    "__class_vars__",
    "__private_attributes__",
}
"""Names that pydantic gives every class."""


class Parameters(BaseModel, metaclass=_Shown):
    """A frozen, validated parameter set. Attribute docstrings become schema descriptions and error
    messages.
    """

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        validate_default=True,
        allow_inf_nan=False,
    )

    if not TYPE_CHECKING:  # a type checker sees the fields

        def __init__(self, /, *values: Any, **given: Any) -> None:
            """Raises `ParameterError`, a ZondaError, with every mistake in the parameters."""
            __tracebackhide__ = True
            if values:
                raise positional(type(self), values)
            try:
                super().__init__(**given)
            except ValidationError as err:
                raise mistakes_of(err, type(self), given) from None
            except PydanticUserError as err:  # a type of an annotation does not exist
                raise without_a_type(type(self).__name__, (), {}, err) from None

        __init__.__pydantic_base_init__ = (
            True  # what is validated as a field is not made by it: contexts and places are kept
        )

        def __setattr__(self, name: str, value: Any) -> None:
            try:
                super().__setattr__(name, value)
            except ValidationError:
                raise changed(type(self), name) from None

    def __repr__(self) -> str:
        """The call that makes an equal one: what was given, in units that people use."""
        given = ", ".join(f"{name}={text}" for name, text in self._arguments().items())
        return f"{type(self).__name__}({given})"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        given = self._arguments()
        dumped = self.model_dump(mode="json")
        rest = [
            (name, dumped[name])
            for name in type(self).model_fields
            if name not in given and dumped.get(name) not in (None, "")
        ]
        return html_table(
            type(self).__name__,
            [*given.items(), *((name, f"{value} (default)") for name, value in rest)],
        )

    def __dir__(self) -> list[str]:
        return [
            name
            for name in sorted(super().__dir__())
            if name not in _PYDANTICS and not name.startswith("__pydantic")
        ]

    def _arguments(self) -> dict[str, str]:
        """Given arguments by name, as Python text."""
        dumped = self.model_dump(mode="json", include=self.model_fields_set)
        keys = {
            name: field.alias or name
            for name, field in type(self).model_fields.items()
            if name in self.model_fields_set
        }
        return {key: _written(getattr(self, name), dumped.get(key)) for name, key in keys.items()}

    def _as_argument(self) -> str:
        """Python text that a field which holds this takes."""
        return repr(self.model_dump(mode="json", include=self.model_fields_set))

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        remember_place(cls)

    @classmethod
    def __get_pydantic_json_schema__(
        cls,
        schema: Any,
        handler: GetJsonSchemaHandler,
    ) -> dict[str, Any]:
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
    """The name under which ``component`` is registered in ``names``, quoted; where it is not, the
    call that makes it.
    """
    with suppress(ZondaError):
        if component.name in names and names.create(component.name) == component:
            return repr(component.name)
    return repr(component)


def _written(value: Any, dumped: Any) -> str:
    if isinstance(value, Parameters):
        return value._as_argument()
    return repr(value if dumped is None else dumped)
