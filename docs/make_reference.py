"""Write docs/operators.md from the docstrings of the classes: python docs/make_reference.py (a test
compares the two).
"""

from __future__ import annotations

import json
import typing
from pathlib import Path

from zonda.core.configuration.describe import choices, described, members, own_doc, types_in
from zonda.core.configuration.units import Unit
from zonda.core.instrument import Band, CameraBand, Instrument, Telescope
from zonda.core.plan.planning import planning_class
from zonda.core.registry import declared, noise_models, operators
from zonda.core.site import Site

PAGE = Path(__file__).with_name("operators.md")
FOLDERS = {
    "pointing": "Pointing",
    "sky": "Sky",
    "atmosphere": "Atmosphere",
    "noise": "Noise",
    "optics": "Optics",
    "detectors": "Detectors",
    "filters": "Filters",
    "maps": "Maps",
    "diagnostics": "Diagnostics",
    "io": "Files",
    "interop": "Other packages",
}
SCENE = {
    Site: "site",
    Instrument: "instrument",
    Telescope: "instrument.telescope",
    Band: "instrument.band",
    CameraBand: "instrument.bands",
}


def folder_of(cls: type) -> str:
    """``filters`` of zonda.operators.filters.highpass, ``interop`` of
    zonda.interop.toast_operator.
    """
    parts = cls.__module__.split(".")
    return parts[2] if parts[1] == "operators" else parts[1]


def page() -> str:
    """The whole page."""
    classes = [operators.get(c.name) for c in operators.candidates() if c.distribution == "zonda"]
    lines = [
        "# Reference of the operators",
        "",
        (
            "All operators, [noise models](#noise-models), [sites and"
            " instruments](#sites-and-instruments) with their parameters."
        ),
        (
            "`docs/make_reference.py` makes this page from the docstrings. Where the default is"
            " *none*, the value is taken from the"
        ),
        "instrument, the site or the scene, as the text says.",
    ]
    for folder, title in FOLDERS.items():
        lines += ["", f"## {title}"]
        for cls in sorted((c for c in classes if folder_of(c) == folder), key=lambda c: c.__name__):
            lines += ["", f"### {cls.__name__}", "", own_doc(cls), ""]
            needs, gives = (
                ", ".join(f"`{n}`" for n in sorted(names)) or "nothing"
                for names in (declared(cls, "requires"), declared(cls, "provides"))
            )
            lines += [f"Requires {needs}; provides {gives}.", "", *table(cls, but="name")]
            for knob in planning_class(cls).knobs or getattr(cls, "knobs", ()):
                ladder = ", ".join(f"`{value}`" for value in knob.ladder)
                lines += [
                    "",
                    (
                        f"Knob ([accuracy](accuracy.md)): `{knob.parameter}`, {ladder}:"
                        f" {knob.approximates}."
                    ),
                ]
    lines += [
        "",
        "## Noise models",
        "",
        "Values of `WhiteNoise.model`: a name, or `{name: background_limited, modes: 1}`.",
    ]
    for found in sorted(
        (c for c in noise_models.candidates() if c.distribution == "zonda"), key=lambda c: c.name
    ):
        cls = noise_models.get(found.name)
        lines += ["", f"### {found.name}", "", own_doc(cls), "", *table(cls, but="name")]
    lines += [
        "",
        "## Sites and instruments",
        "",
        (
            "Keys of `site:` and `instrument:` in a pipeline file ([pipelines.md](pipelines.md)),"
            " which"
        ),
    ]
    lines += ["are also the arguments of the classes in Python ([plugins.md](plugins.md))."]
    for cls, key in SCENE.items():
        lines += ["", f"### {cls.__name__}", "", f"`{key}`. {own_doc(cls)}", "", *table(cls)]
    return "\n".join(lines) + "\n"


def table(cls: typing.Any, but: str = "") -> list[str]:
    """One row per parameter of a class."""
    lines = ["| parameter | default | |", "|---|---|---|"]
    for name, field in described(cls).items():
        if name != but:
            text = " ".join((field.description or "").split()).replace("|", "\\|")
            text = " ".join(filter(None, (text, written_choices(field))))
            lines.append(f"| `{field.alias or name}` | {default(field)} | {text} |")
    return lines


def written_choices(field: typing.Any) -> str:
    """The choices as Markdown, empty where there are none."""
    chosen = [
        f"`{value}`" if isinstance(value, str) else f"`{json.dumps(value)}`"
        for value in choices(field)
    ]
    if not chosen:
        return ""
    others = [
        m
        for m in members(field)
        if m is not type(None) and typing.get_origin(m) is not typing.Literal
    ]
    named = f"one of {', '.join(chosen)}" if len(chosen) > 1 else chosen[0]
    if any(typing.get_origin(t) is typing.Literal for other in others for t in types_in(other)):
        named, others = f"one or several of {', '.join(chosen)}", []
    return (
        f"Or {named}."
        if others
        else f"{named[0].upper()}{named[1:]}{'.' if len(chosen) > 1 else ' only.'}"
    )


def default(field: typing.Any) -> str:
    """A field's default as it would stand in YAML."""
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None or value == "":
        return "*none*"
    has_unit = any(isinstance(m, Unit) for m in field.metadata)
    return (
        f"`{value}`"
        if has_unit or isinstance(value, str)
        else f"`{json.dumps(value, default=str)}`"
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
