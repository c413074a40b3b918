"""What `help()`, signatures and the reference say of parameters."""

from __future__ import annotations

import inspect
import pydoc
from typing import Annotated, Any

import pytest
from pydantic import TypeAdapter

import zonda
from zonda.core.configuration.describe import choices, kind, own_doc, unit_of
from zonda.core.registry import operators


@pytest.mark.parametrize(
    ("cls", "parameter", "words"),
    [
        ("BinMap", "pixel", "an angle such as '2 arcsec'"),
        ("BinMap", "frame", "'icrs' or 'galactic'"),
        ("BinMap", "projection", "'TAN' or 'CAR'"),
        (
            "BinMap",
            "half_difference",
            "'scans', 'detectors', 'halves', 'directions' or 'radii', or True or False",
        ),
        ("SkyMap", "file", "the path of a file"),
        ("SkyMap", "map", "an array"),
        ("SkyMap", "wcs", "an astropy WCS"),
        ("SkyMap", "beam", "'gaussian' or 'none'"),
        ("SkyMap", "centre", "'target', or a position such as '05h00m00s +20d00m00s'"),
        ("PointingDaisy", "offsets", "'none' or 'box', or a list"),
        ("PointingDaisy", "scans", "a whole number"),
        (
            "AtmosphereLayers",
            "outputs",
            "'pwv', 'opacity' or 'path_delay', or a list",
        ),
        ("Scene", "site", "a Site"),
        ("Scene", "time", "a time such as '2024-11-25T07:00:00Z'"),
    ],
)
def test_what_a_parameter_takes(cls: str, parameter: str, words: str) -> None:
    field = getattr(zonda, cls).model_fields[parameter]
    assert kind(field) == words


@pytest.mark.parametrize("name", [*operators, "Scene", "Site", "Instrument", "Telescope", "Band"])
def test_help_shows_every_parameter_and_nothing_of_pydantics(name: str) -> None:
    cls: Any = getattr(zonda, name)
    text = pydoc.plain(pydoc.render_doc(cls))
    assert own_doc(cls).splitlines()[0] in text
    for parameter, field in cls.model_fields.items():
        (line,) = [
            row for row in text.splitlines() if row.startswith(f" |  {field.alias or parameter} : ")
        ]
        assert line.endswith("; required") if field.is_required() else "; default " in line
        assert all(repr(choice) in line for choice in choices(field))
        assert "see below" not in line
    for jargon in ("pydantic", "model_dump", "model_validate", "__", "Annotated[", "FieldInfo"):
        assert jargon not in text


def test_the_example_of_a_parameter_is_one_of_its_values() -> None:
    """Each parameter with a unit has an example within its limits and of its own size; not a
    telescope or an altitude of 1.8 mm.
    """
    seen = {}
    for name in [*operators, "Scene", "Site", "Instrument", "Telescope", "Band"]:
        for parameter, field in getattr(zonda, name).model_fields.items():
            if (unit := unit_of(field)) is None:
                continue
            seen[name, parameter] = unit.example
            scalar = "list" not in str(field.annotation) and "tuple" not in str(field.annotation)
            whole, part = Annotated[field.annotation, "", *field.metadata], Annotated[float, unit]
            kept: Any = whole if scalar else part
            assert isinstance(TypeAdapter(kept).validate_python(unit.example), float)
    assert len(seen) > 100
    assert seen["Telescope", "diameter"] == "12 m"
    assert seen["Site", "altitude"] == "2600 m"
    assert seen["BinMap", "pixel"] == "2 arcsec"
    with pytest.raises(zonda.ZondaError, match=r"write a length such as '12 m'(.|\n)*e.g. 6 m"):
        zonda.Telescope(name="dish", diameter=6)
    with pytest.raises(zonda.ZondaError, match="add diameter='12 m'"):
        zonda.Telescope(name="dish")


def test_the_signature_is_what_a_user_writes() -> None:
    signature = inspect.signature(zonda.PointingDaisy)
    assert signature.parameters["radius"].default == "4 arcmin"
    assert (
        inspect.signature(zonda.PointingRecorded).parameters["file"].default
        is inspect.Parameter.empty
    )
    assert "Annotated" not in str(signature)


def test_completion_offers_parameters_without_pydantics_names() -> None:
    names = dir(zonda.BinMap(pixel="2 arcsec"))
    assert {"pixel", "frame", "exec"} <= set(names)
    assert not [name for name in names if name.startswith("model_")]


def test_the_schema_has_the_docstring_alone() -> None:
    description = zonda.BinMap.model_json_schema()["description"]
    assert description == own_doc(zonda.BinMap)
    assert "Parameters\n----------" not in description
