"""One self-contained page that shows what a run made and says how."""

from __future__ import annotations

import base64
import re
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from zonda.core.configuration.describe import described, own_doc
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.figures import Figures
from zonda.core.maps.beams import expected_fwhm
from zonda.core.numerics.angles import ARCSEC, angle_text
from zonda.core.output import Output, output_folder
from zonda.core.pages import render
from zonda.core.storage.files import write_text
from zonda.core.types import AnyFloats

from .plot_operators import DRAWN, Picture, Plots, pictures
from .report_results import (
    class_of,
    flux_density,
    has_white_noise,
    readable,
    results,
    sexagesimal,
    spread,
)

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target
    from zonda.core.data import Observation
    from zonda.core.instrument import Instrument

LONG = 12
"""Rows of a table that are shown; the rest of a longer one is folded away. Half as many of files,
in one cell.
"""
_WIDE = 1200
"""Pictures wider than this many pixels take a whole row."""


class Report(Output):
    """HTML report, ``report.html``: pictures, what was simulated, seed and versions, counts and
    approximations.

    The page needs no other file and no network. Put it last, so that it knows of the files before
    it.

    Raises `OutputError` when there is no output folder, it cannot be written, or the disk is full.
    """

    optional: ClassVar[frozenset[str]] = DRAWN | {"pictures", "map_file", "tod_file", "figures"}
    provides: ClassVar[frozenset[str]] = frozenset({"report"})

    central_diameter: Angle | None = Field(None, gt=0)
    """Diameter of the circle about the map's centre in which the noise is stated; where absent 1
    arcmin, or five beams or pixels where these are wider."""

    def observe(self, data: Data) -> None:
        """Refuse a missing or unwritable output folder before anything is simulated."""
        output_folder(data, self.label)

    def finalize(self, data: Data) -> None:
        folder = output_folder(data, self.label)
        shown = data.products.get("pictures")
        if shown is None:
            style = Plots().model_copy(update={"central_diameter": self.central_diameter})
            shown = list(pictures(data, style))
        data.products["report"] = write_text(
            folder / "report.html", page(data, shown, self.central_diameter)
        )


TITLES = {
    "results": "Results",
    "figures": "Figures",
    "pictures": "Pictures",
    "scene": "Scene",
    "scans": "Scans",
    "steps": "Steps",
    "tally": "Counted and approximated",
    "plan": "Plan",
    "time": "Computing time",
    "provenance": "Provenance",
}
"""Sections of the page in their order; one without content is left out."""


def page(data: Data, shown: Sequence[Picture], central_diameter: float | None) -> str:
    """The whole page. All text is escaped by the template."""
    provenance, scene = data.provenance, data.scene
    version = str(provenance.get("versions", {}).get("zonda", ""))
    line = (
        f"{scene.instrument.name} on {scene.instrument.telescope.name} at {scene.site.name},"
        f" {scene.time}, seed {scene.seed}"
    )
    sections = {
        "results": results(data, central_diameter),
        "figures": _figures(data),
        "pictures": _pictures(shown, [band.name for band in scene.instrument.bands]),
        "scene": _scene(data),
        "scans": _scans(data),
        "steps": _steps(data),
        "tally": _tally(data),
        "plan": list(provenance.get("plan", [])),
        "time": _timings(data),
        "provenance": _provenance(data),
    }
    return render(
        __package__,
        "report.html",
        title=str(provenance.get("name") or "zonda run"),
        description=str(provenance.get("description") or ""),
        line=f"{line}, zonda {version}" if version else line,
        version=version,
        titles=TITLES,
        sections=sections,
        long=LONG,
        written=[p.name for key in ("map_file", "tod_file") for p in data.products.get(key, [])],
        resolved=str(provenance.get("resolved_yaml", "")),
    )


def _pictures(shown: Sequence[Picture], bands: Sequence[str]) -> list[dict[str, Any]]:
    found = []
    for picture in shown:
        band = next((b for b in bands if picture.name.endswith(f"_{b}")), "")
        named = band in picture.title
        found.append(
            {
                "title": picture.title if named else f"{picture.title} ({band})",
                "caption": picture.caption,
                "image": base64.b64encode(picture.png).decode(),
                "wide": int.from_bytes(picture.png[16:20], "big") > _WIDE,
            }
        )
    return found


def _figures(data: Data) -> list[tuple[str, ...]]:
    """Name, value, standard error and meaning of each figure of `MeasureFigures`."""
    every = (product for product in data.products.values() if isinstance(product, Figures))
    return [
        (
            f.name,
            f"{f.value:.5g} {f.unit}".strip(),
            f"{f.error:.2g}" if np.isfinite(f.error) else "",
            f.description,
        )
        for figures in every
        for f in figures
    ]


def _scene(data: Data) -> list[tuple[str, Any]]:
    scene = data.scene
    instrument, site, telescope = scene.instrument, scene.site, scene.instrument.telescope
    cameras, target = instrument.cameras, scene.target
    number = " + ".join(str(camera.detectors) for camera in cameras.values())
    place = f"{np.degrees(site.latitude):.4f}°, {np.degrees(site.longitude):.4f}°"
    field = f"detectors in a field of {angle_text(instrument.field_of_view)}"
    campaign = data.provenance.get("campaign")
    note = "this table and the plan are of its first entry, figures of its last, counts of all"
    rows: list[tuple[str, Any]] = [
        *([("Campaign", f"{campaign}; {note}")] if campaign else []),
        ("Site", f"{site.name}: {place}, {site.altitude:.0f} m"),
        ("Telescope", f"{telescope.name}, {telescope.diameter:.4g} m"),
        ("Instrument", f"{instrument.name}: {number} {field}"),
    ]
    for camera in cameras.values():
        rows += _band(camera, data, several=len(cameras) > 1)
    if data.observations:
        rows.append(("Read-out", f"{data.observations[0].sample_rate:.6g} Hz"))
    rows += [
        ("Target", "given by the pointing step" if target is None else _target(target)),
        ("Start", scene.time),
        ("Seed", scene.seed),
    ]
    sources = {"Site": site.provenance, "Instrument": instrument.provenance}
    for camera in cameras.values():
        name = f"Band {camera.band.name}" if len(cameras) > 1 else "Band"
        sources[name] = camera.band.provenance
    rows += [(f"{kind}: source of the numbers", text) for kind, text in sources.items() if text]
    return rows


def _band(camera: Instrument, data: Data, *, several: bool) -> list[tuple[str, Any]]:
    """A band, with what its detectors are like in the first scan."""
    band, tell = camera.band, f" {camera.band.name}" if several else ""
    low, high, centre = (f / 1e9 for f in (band.frequency[0], band.frequency[-1], band.centre))
    edges = f"{low:.4g} to {high:.4g} GHz about {centre:.4g} GHz"
    rows: list[tuple[str, Any]] = [("Band", f"{band.name}: {edges}")]
    scans = [o for o in data.observations if o.instrument == camera]
    if scans:
        plane = scans[0].focalplane
        jansky = flux_density(1.0, expected_fwhm(plane.fwhm, plane.net), band)
        rows += [
            ("Beam (FWHM)", spread(plane.fwhm / ARCSEC, "″")),
            ("1 K_RJ at a point source's peak", jansky),
            ("Main-beam efficiency ζ", spread(plane.main_beam_efficiency)),
            ("Illumination efficiency ε", spread(plane.illumination_efficiency)),
            ("NET on the sky", _net(scans, data)),
        ]
    return [(f"{name}{tell}", text) for name, text in rows]


def _net(scans: Sequence[Observation], data: Data) -> str:
    """NET of all detectors in all scans (they differ where noise follows from the load); of a
    campaign, in the first scan.
    """
    known = scans[:1] if "campaign" in data.provenance else scans
    text = spread(np.concatenate([o.focalplane.net for o in known]) * 1e3, " mK_RJ √s")
    if not has_white_noise(data):
        return f"{text} (no white noise is simulated)"
    return f"{text} (of the first scan)" if len(known) < len(scans) else text


def _target(target: Target) -> str:
    if target.frame == "icrs":
        return f"{sexagesimal(target.longitude, target.latitude)} (ICRS)"
    names = ("azimuth", "elevation") if target.frame == "horizontal" else ("galactic l", "b")
    angles = np.degrees([target.longitude, target.latitude])
    return ", ".join(f"{name} {angle:.6g}°" for name, angle in zip(names, angles, strict=True))


def _scans(data: Data) -> list[tuple[str, ...]]:
    return [
        (
            o.name,
            str(o.start).replace("T", " "),
            f"{o.duration:.1f} s",
            f"{o.n_detectors} × {o.n_samples}",
            sexagesimal(*o.centre),
            _range(o.elevation),
            _range(np.unwrap(o.azimuth)),
            f"{np.count_nonzero(~o.good_samples)} / {np.count_nonzero(~o.good_detectors)}",
        )
        for o in data.observations
    ]


def _range(angles: AnyFloats) -> str:
    return f"{np.degrees(angles.min()):.2f}° – {np.degrees(angles.max()):.2f}°"


def _steps(data: Data) -> list[dict[str, Any]]:
    """Each step with its parameters: name, value, value as people read it, meaning."""
    found = []
    for label, kind, parameters in data.provenance.get("operators", []):
        cls = class_of(kind)
        doc, fields = ("", {}) if cls is None else (own_doc(cls).split("\n\n")[0], described(cls))
        meanings = {key: field.description or "" for key, field in fields.items()}
        rows = [(k, t, readable(str(t)), meanings.get(k, "")) for k, t in parameters.items()]
        title = label if label == kind else f"{label} ({kind})"
        found.append({"title": title, "doc": doc, "parameters": rows})
    return found


def _tally(data: Data) -> list[tuple[str, str, str]]:
    """The log of counts and figures, in the order of the steps."""
    rows: list[tuple[str, str, str]] = []
    previous = ""
    order = {label: k for k, (label, *_) in enumerate(data.provenance.get("operators", []))}
    told = sorted(data.log.told(), key=lambda row: order.get(row[0], len(order)))
    for who, what, value in told:
        value = re.sub(r"^\d+(?=$| \()", lambda m: f"{int(m[0]):,}".replace(",", "\u202f"), value)
        # a folded table begins with a name
        rows.append(("" if who == previous and len(rows) != LONG else who, what, value))
        previous = who
    return rows


def _timings(data: Data) -> list[dict[str, Any]]:
    """CPU seconds of each step, in all and by stage."""
    by_step: dict[str, Any] = {}
    for label, stage, seconds in data.provenance.get("timings", []):
        by_step.setdefault(str(label), Counter())[str(stage)] += float(seconds)
    return [
        {
            "label": label,
            "seconds": sum(stages.values()),
            "stages": ", ".join(f"{k} {v:.2g} s" for k, v in stages.items() if v >= 0.0005),
        }
        for label, stages in by_step.items()
    ]


def _provenance(data: Data) -> list[tuple[str, Any]]:
    provenance = data.provenance
    rows = {"seed": data.scene.seed, "command": provenance.get("command")}
    rows |= provenance.get("versions", {})
    rows["precision"] = provenance.get("precision")
    for name, run in provenance.get("runs", {}).items():
        parts = (
            f"{how} {' and '.join(what) if isinstance(what, list) else what}"
            for how, what in run.items()
        )
        rows[f"signal {name}"] = ", ".join(parts)
    return [(name, value) for name, value in rows.items() if value not in ("", None)]
