"""JSON schema of pipeline files, for completion in editors."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from pydantic import BaseModel
from pydantic.errors import PydanticInvalidForJsonSchema
from pydantic.json_schema import JsonSchemaMode, models_json_schema

from .. import registry
from ..band import PER_BAND
from ..campaign.section import CampaignHeader
from ..components import Registry
from ..errors import ZondaError
from ..operator import Operator
from ..scene import Scene
from ..variants import LIKE
from .describe import own_doc
from .loaded import KEYS

_MODE: JsonSchemaMode = "validation"


def json_schema() -> dict[str, Any]:
    """Schema (draft 2020-12) of pipeline files: one property per installed operator; broken plugins
    are left out.
    """
    classes: dict[str, type[Operator]] = {}
    for found in registry.operators.candidates():
        twice = sum(other.name == found.name for other in registry.operators.candidates()) > 1
        try:
            operator = registry.operators.load(found)
            operator.model_json_schema()
        except (ZondaError, PydanticInvalidForJsonSchema):
            continue
        classes[found.qualified if twice else found.name] = operator
    weather = _weather()
    top: type[BaseModel] = CampaignHeader
    wanted: list[type[BaseModel]] = [
        top,
        Scene,
        *dict.fromkeys([*classes.values(), *weather.values()]),
    ]
    models = [(model, _MODE) for model in wanted]
    references, definitions = models_json_schema(models, ref_template="#/$defs/{model}")
    defs = definitions.get("$defs", {})
    header, scene = (
        defs.pop(references[model, _MODE]["$ref"].rpartition("/")[2]) for model in (top, Scene)
    )
    properties = header["properties"] | scene["properties"]
    for kind, names in (("site", registry.sites), ("instrument", registry.instruments)):
        properties[kind] = _name_or(properties[kind], names)
    sources = [
        {"type": "string", "enum": list(weather)},
        *(references[model, _MODE] for model in weather.values()),
    ]
    properties["weather"] = {
        "anyOf": [*sources, {"type": "null"}],
        "description": properties["weather"]["description"],
    }
    for definition in defs.values():
        if definition.get("title") == "Instrument":
            definition["properties"]["band"] = _name_or(
                definition["properties"]["band"],
                registry.bands,
            )
            several = definition["properties"]["bands"]
            several["items"] = _name_or(several["items"], registry.bands)
            definition["required"] = [
                key
                for key in definition["required"]
                if key not in ("band", "field_of_view", *PER_BAND)
            ]
            properties["instrument"]["anyOf"].append(_variant(definition))
    steps = _step(classes, references)
    properties["operators"] = {
        "type": "array",
        "minItems": 1,
        "description": "Steps, in order.",
        "items": steps,
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "zonda pipeline",
        "type": "object",
        "properties": {key: properties[key] for key in KEYS},
        "patternProperties": {"^x-": {"description": "Anything: a place for anchors."}},
        "additionalProperties": False,
        "required": [*scene.get("required", []), "operators"],
        "$defs": defs,
    }


def _weather() -> dict[str, type[BaseModel]]:
    """The weather sources by name; broken plugins are left out."""
    found: dict[str, type[BaseModel]] = {}
    for name in registry.weather_sources:
        with suppress(ZondaError):
            found[name] = registry.weather_sources.get(name)
    return found


def _variant(instrument: dict[str, Any]) -> dict[str, Any]:
    """A registered instrument with some of its fields changed; what a telescope takes is left to
    `zonda check`.
    """
    name = {
        "type": "string",
        "examples": list(registry.instruments),
        "description": "Registered instrument that is varied.",
    }
    fields = instrument["properties"] | {
        "telescope": {"type": "object", "description": "What differs of the telescope."}
    }
    return {
        "type": "object",
        "properties": {LIKE: name} | fields,
        "required": [LIKE],
        "additionalProperties": False,
    }


def _step(classes: dict[str, type[Operator]], references: Any) -> dict[str, Any]:
    properties = {
        name: {
            "anyOf": [references[model, _MODE], {"type": "null"}],
            "description": own_doc(model).split("\n")[0],
        }
        for name, model in classes.items()
    }
    whole = {
        "type": "object",
        "properties": properties,
        "minProperties": 1,
        "maxProperties": 1,
        "additionalProperties": False,
    }
    return {"anyOf": [whole, {"enum": list(classes)}]}


def _name_or(schema: dict[str, Any], names: Registry) -> dict[str, Any]:
    text = {"type": "string", "examples": list(names)}
    described = {"description": schema["description"]} if "description" in schema else {}
    return {"anyOf": [text, {k: v for k, v in schema.items() if k != "description"}], **described}
