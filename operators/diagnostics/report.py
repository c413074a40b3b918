"""One self-contained page that shows what a run made and says how."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from html import escape
from importlib import resources
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field, PrivateAttr

from zonda.core.configuration.docstrings import described, own_doc
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.figures import Figures
from zonda.core.maps.beams import expected_fwhm
from zonda.core.numerics.angles import angle_text
from zonda.core.output import Output, Progress, output_folder
from zonda.core.storage.files import write_text
from zonda.core.types import AnyFloats

from .plot_operators import DRAWN, Picture, Plots, pictures
from .report_results import class_of, flux_density, has_white_noise, results
from .report_text import LONG, Html, details, folded, readable, sexagesimal, small, spread, table

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target
    from zonda.core.data import Observation
    from zonda.core.instrument import Instrument

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

    _known: dict[str, str] | None = PrivateAttr(None)

    def observe(self, data: Data) -> None:
        """Refuse a missing or unwritable output folder before anything is simulated."""
        output_folder(data, self.label)

    def watch(self, data: Data, done: Progress) -> None:
        """Write what no later step changes while the last pictures are drawn."""
        if done == "maps":
            self._known = None
            with suppress(Exception):  # `finalize` says so, when the maps are written
                self._known = _known(data, self.central_diameter)

    def finalize(self, data: Data) -> None:
        folder = output_folder(data, self.label)
        shown = data.products.get("pictures")
        if shown is None:
            shown = pictures(data, replace(Plots().style(), central_diameter=self.central_diameter))
        known, self._known = self._known, None
        data.products["report"] = write_text(
            folder / "report.html", page(data, shown, self.central_diameter, known)
        )


def _known(data: Data, central_diameter: float | None) -> dict[str, str]:
    """The sections that are settled once all maps are made."""
    return {
        "results": results(data, central_diameter),
        "scene": _scene(data),
        "scans": _scans(data),
        "steps": _steps(data),
    }


def page(
    data: Data,
    shown: Sequence[Picture],
    central_diameter: float | None,
    known: Mapping[str, str] | None = None,
) -> str:
    """The whole page. Everything that is not markup of this module is escaped. ``known``: `_known`,
    where it was made before.
    """
    known = _known(data, central_diameter) if known is None else known
    style = resources.files(__package__).joinpath("data/report.css").read_text(encoding="utf-8")
    provenance = data.provenance
    name = str(provenance.get("name") or "zonda run")
    parts = [
        ("results", "Results", known["results"]),
        ("figures", "Figures", _figures(data)),
        (
            "pictures",
            "Pictures",
            _pictures(shown, [band.name for band in data.scene.instrument.bands]),
        ),
        ("scene", "Scene", known["scene"]),
        ("scans", "Scans", known["scans"]),
        ("steps", "Steps", known["steps"]),
        ("tally", "Counted and approximated", _tally(data)),
        ("plan", "Plan", _plan(data)),
        ("time", "Computing time", _timings(data)),
        ("provenance", "Provenance", _provenance(data)),
    ]
    parts = [p for p in parts if p[2]]
    links = "".join(f'<a href="#{key}">{title}</a>' for key, title, _ in parts)
    sections = "\n".join(
        f'<section id="{key}"><h2>{title}</h2>{body}</section>' for key, title, body in parts
    )
    scene = data.scene
    version = provenance.get("versions", {}).get("zonda", "")
    line = (
        f"{scene.instrument.name} on {scene.instrument.telescope.name} at {scene.site.name},"
        f" {scene.time}, seed {scene.seed}"
    )
    line += f", zonda {version}" if version else ""
    description = (
        f"<p>{escape(str(provenance['description']))}</p>" if provenance.get("description") else ""
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(name)} · zonda</title>
<style>
{style}</style>
</head>
<body>
<header><h1>{escape(name)}</h1>{description}<p>{escape(line)}</p></header>
<nav>{links}</nav>
<main>
{sections}
</main>
<footer>Simulated, not observed, by zonda {escape(str(version))}.</footer>
</body>
</html>
"""


def _pictures(shown: Sequence[Picture], bands: Sequence[str]) -> str:
    figures = []
    for picture in shown:
        band = next(
            (
                f" ({name})"
                for name in bands
                if picture.name.endswith(f"_{name}") and name not in picture.title
            ),
            "",
        )
        title = picture.title + band
        width = int.from_bytes(picture.png[16:20], "big")
        image = base64.b64encode(picture.png).decode()
        style = ' class="wide"' if width > _WIDE else ""
        alt = escape(f"{title}: {picture.caption}", quote=True)
        caption = f"<figcaption><b>{escape(title)}.</b> {escape(picture.caption)}</figcaption>"
        figures.append(
            f'<figure{style}><img alt="{alt}"'
            f' src="data:image/png;base64,{image}">{caption}</figure>'
        )
    return f'<div class="pictures">{"".join(figures)}</div>' if figures else ""


def _figures(data: Data) -> str:
    """What `MeasureFigures` found."""
    rows = [
        (
            f.name,
            f"{f.value:.5g} {f.unit}".strip(),
            f"{f.error:.2g}" if np.isfinite(f.error) else "",
            small(f.description),
        )
        for product in data.products.values()
        if isinstance(product, Figures)
        for f in product
    ]
    return table(rows, ("metric", "value", "standard error", ""), numbers=(1, 2)) if rows else ""


def _scene(data: Data) -> str:
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
    return table(rows)


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


def _scans(data: Data) -> str:
    head = (
        "scan",
        "start",
        "duration",
        "detectors × samples",
        "target (RA, Dec)",
        "elevation",
        "azimuth",
    )
    rows = [
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
    return (
        "<div"
        f' class="compact">{folded(rows, (*head, "flagged samples / detectors"), "scans")}</div>'
    )


def _range(angles: AnyFloats) -> str:
    return f"{np.degrees(angles.min()):.2f}° – {np.degrees(angles.max()):.2f}°"


def _steps(data: Data) -> str:
    made = []
    for label, kind, parameters in data.provenance.get("operators", []):
        cls = class_of(kind)
        doc, fields = ("", {}) if cls is None else (own_doc(cls).split("\n\n")[0], described(cls))
        rows = []
        for key, text in parameters.items():
            value = Html(
                "<span"
                f' title="{escape(str(text), quote=True)}">{escape(readable(str(text)))}</span>'
            )
            rows.append((key, value, small(fields[key].description or "" if key in fields else "")))
        title = escape(label if label == kind else f"{label} ({kind})")
        made.append(
            details(Html(title + small(doc)), table(rows) or '<p class="note">No parameters.</p>')
        )
    note = '<p class="note">In the order in which they acted; a step opens to its parameters.</p>'
    return note + "".join(made) if made else ""


def _tally(data: Data) -> str:
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
    table = folded(rows, ("step", "what", "value"), "counts and figures")
    return f'<div class="steps">{table}</div>' if table else ""


def _plan(data: Data) -> str:
    """What was omitted, dropped or coarsened, and the errors that this may cause (`core.plan`)."""
    head = ("effect", "decision", "error bound", "formula or reason")
    table = folded(list(data.provenance.get("plan", [])), head, "decisions")
    return f'<div class="steps">{table}</div>' if table else ""


def _timings(data: Data) -> str:
    by_step: dict[str, dict[str, float]] = {}
    for label, stage, seconds in data.provenance.get("timings", []):
        stages = by_step.setdefault(str(label), {})
        stages[str(stage)] = stages.get(str(stage), 0.0) + float(seconds)
    if not by_step:
        return ""
    total = {label: sum(stages.values()) for label, stages in by_step.items()}
    longest = max(total.values()) or 1.0
    rows: list[tuple[Any, ...]] = []
    for label, stages in by_step.items():
        if total[label] >= 0.0005:  # the pictures and this page are not done yet
            detail = ", ".join(f"{k} {v:.2g} s" for k, v in stages.items() if v >= 0.0005)
            bar = f'<span class="bar" style="width:{100 * total[label] / longest:.1f}%"></span>'
            rows.append((label, f"{total[label]:.3f} s", Html(bar), small(detail)))
    what = "CPU seconds before the products were written, added up over threads"
    note = f'<p class="note">{what}: {sum(total.values()):.2f} s (first use compiles).</p>'
    return (
        f"{note}<div"
        f' class="timings">{table(rows, ("step", "CPU", "", "stages"), numbers=(1,))}</div>'
    )


def _provenance(data: Data) -> str:
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
    files = [str(p.name) for key in ("map_file", "tod_file") for p in data.products.get(key, [])]
    if len(files) > LONG // 2 + 2:
        every = "".join(f"<li>{escape(name)}</li>" for name in files)
        all_of_them = details(f"all {len(files)} files", f'<ul class="files">{every}</ul>')
        rows.append(("files", Html(f"{escape(files[0])} to {escape(files[-1])}{all_of_them}")))
    elif files:
        rows.append(("files", ", ".join(files)))
    text = str(provenance.get("resolved_yaml", ""))
    return table(rows) + (
        details("Configuration with every default filled in", f"<pre>{escape(text)}</pre>")
        if text
        else ""
    )
