"""One self-contained page that shows what a run made and says how."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from zonda.core.configuration.describe import described, own_doc
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.figures import Figures
from zonda.core.maps.beams import expected_fwhm
from zonda.core.numerics.angles import angle_text
from zonda.core.output import Output, output_folder
from zonda.core.pages import render
from zonda.core.storage.files import write_text
from zonda.core.types import AnyFloats

from .plot_operators import DRAWN, Picture, Plots, pictures
from .report_results import class_of, flux_density, has_white_noise, results
from .report_text import readable, sexagesimal, spread

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target
    from zonda.core.data import Observation
    from zonda.core.instrument import Instrument

LONG = 12
"""Rows of a table that are shown; the rest of a longer one is folded away. Half as many of files,
in one cell.
"""
_WIDE = 1000
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
            style = replace(Plots().style(), central_diameter=self.central_diameter)
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
        band = next((f" ({b})" for b in bands if picture.name.endswith(f"_{b}")), "")
        title = picture.title if band and band[2:-1] in picture.title else picture.title + band
        found.append(
            {
                "title": title,
                "caption": picture.caption,
                "image": base64.b64encode(picture.png).decode(),
                "wide": int.from_bytes(picture.png[16:20], "big") > _WIDE,
            }
        )
    return found


def _figures(data: Data) -> list[tuple[str, ...]]:
    """Name, value, standard error and meaning of each figure of `MeasureFigures`."""
    return [
        (
            f.name,
            f"{f.value:.5g} {f.unit}".strip(),
            f"{f.error:.2g}" if np.isfinite(f.error) else "",
            f.description,
        )
        for product in data.products.values()
        if isinstance(product, Figures)
        for f in product
    ]


def _scene(data: Data) -> list[tuple[str, Any]]:
    scene = data.scene
    instrument, site, telescope = scene.instrument, scene.site, scene.instrument.telescope
    cameras = instrument.cameras
    number = " + ".join(str(camera.detectors) for camera in cameras.values())
    rows: list[tuple[str, Any]] = [
        (
            "Site",
            (
                f"{site.name}: {np.degrees(site.latitude):.4f}°, {np.degrees(site.longitude):.4f}°,"
                f" {site.altitude:.0f} m"
            ),
        ),
        ("Telescope", f"{telescope.name}, {telescope.diameter:.4g} m"),
        (
            "Instrument",
            (
                f"{instrument.name}: {number} detectors in a field of"
                f" {angle_text(instrument.field_of_view)}"
            ),
        ),
        *(
            row
            for camera in cameras.values()
            for row in _band(camera, data, several=len(cameras) > 1)
        ),
        (
            "Target",
            _target(scene.target) if scene.target is not None else "given by the pointing step",
        ),
        ("Start", scene.time),
        ("Seed", scene.seed),
    ]
    if data.observations:
        rows.insert(-3, ("Read-out", f"{data.observations[0].sample_rate:.6g} Hz"))
    if campaign := data.provenance.get("campaign"):
        rows.insert(
            0,
            (
                "Campaign",
                (
                    f"{campaign}; this table and the plan are of its first entry, figures of its"
                    " last, counts of all"
                ),
            ),
        )
    bands = [
        (f"Band {c.band.name}" if len(cameras) > 1 else "Band", c.band.provenance)
        for c in cameras.values()
    ]
    for kind, text in (("Site", site.provenance), ("Instrument", instrument.provenance), *bands):
        if text:
            rows.append((f"{kind}: source of the numbers", text))
    return rows


def _band(camera: Instrument, data: Data, *, several: bool) -> list[tuple[str, Any]]:
    """A band, with what its detectors are like in the first scan."""
    band, tell = camera.band, f" {camera.band.name}" if several else ""
    edges = (
        f"{band.frequency[0] / 1e9:.4g} to {band.frequency[-1] / 1e9:.4g} GHz about"
        f" {band.centre / 1e9:.4g} GHz"
    )
    rows: list[tuple[str, Any]] = [(f"Band{tell}", f"{band.name}: {edges}")]
    scans = [o for o in data.observations if o.instrument == camera]
    if scans:
        plane = scans[0].focalplane
        rows += [
            (f"Beam (FWHM){tell}", spread(plane.fwhm * 648000 / np.pi, "″")),
            (
                f"1 K_RJ at a point source's peak{tell}",
                flux_density(1.0, expected_fwhm(plane.fwhm, plane.net), band),
            ),
            (f"Main-beam efficiency ζ{tell}", spread(plane.main_beam_efficiency)),
            (f"Illumination efficiency ε{tell}", spread(plane.illumination_efficiency)),
            (f"NET on the sky{tell}", _net(scans, data)),
        ]
    return rows


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
    return (
        f"{names[0]} {np.degrees(target.longitude):.6g}°, {names[1]}"
        f" {np.degrees(target.latitude):.6g}°"
    )


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
        title = label if label == kind else f"{label} ({kind})"
        rows = [
            (key, text, readable(str(text)), fields[key].description or "" if key in fields else "")
            for key, text in parameters.items()
        ]
        found.append({"title": title, "doc": doc, "parameters": rows})
    return found


def _tally(data: Data) -> list[tuple[str, str, str]]:
    """The log of counts and figures, in the order of the steps."""
    rows: list[tuple[str, str, str]] = []
    previous = ""
    order = {label: k for k, (label, *_) in enumerate(data.provenance.get("operators", []))}
    for who, what, value in sorted(
        data.tally.told(), key=lambda row: order.get(row[0], len(order))
    ):
        counted = re.fullmatch(r"(\d+)( \(.* %\))?", value)
        number = (
            f"{int(counted[1]):,}{counted[2] or ''}".replace(",", "\u202f") if counted else value
        )
        rows.append(
            ("" if who == previous and len(rows) != LONG else who, what, number)
        )  # a folded table begins with a name
        previous = who
    return rows


def _timings(data: Data) -> list[dict[str, Any]]:
    """CPU seconds of each step, in all and by stage."""
    by_step: dict[str, dict[str, float]] = {}
    for label, stage, seconds in data.provenance.get("timings", []):
        stages = by_step.setdefault(str(label), {})
        stages[str(stage)] = stages.get(str(stage), 0.0) + float(seconds)
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
    rows: list[tuple[str, Any]] = [("seed", data.scene.seed)]
    if provenance.get("command"):
        rows.append(("command", provenance["command"]))
    rows += provenance.get("versions", {}).items()
    if provenance.get("precision"):
        rows.append(("precision", provenance["precision"]))
    for name, run in provenance.get("runs", {}).items():
        parts = [
            f"{how} {' and '.join(what) if isinstance(what, list) else what}"
            for how, what in run.items()
        ]
        rows.append((f"signal {name}", ", ".join(parts)))
    return rows
