"""HTML report of a run: one page that needs no other file, laid out by its template."""

from __future__ import annotations

import base64
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from pydantic import Field

from zonda.core.band import Band
from zonda.core.configuration.describe import described, own_doc
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import ZondaError
from zonda.core.figures import Figures
from zonda.core.instrument import Instrument
from zonda.core.maps.beams import expected_fwhm
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import NoiseFigure, maps_of, noise_figures
from zonda.core.maps.planes import central_diameter, in_beams
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.numerics.sphere import ARCSEC, angle_text, beam_area, sides_text
from zonda.core.operator import Operator
from zonda.core.output import Output, output_folder
from zonda.core.registry import declared, operators
from zonda.core.storage.files import write_text
from zonda.core.tables import render
from zonda.core.types import AnyFloats

from .plot_operators import DRAWN, Picture, Plots, pictures

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

    optional = DRAWN | {"pictures", "map_file", "tod_file", "figures"}
    provides = frozenset({"report"})

    central_diameter: Angle | None = Field(None, gt=0, examples=["1 arcmin"])
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
            folder / "report.html",
            page(data, shown, self.central_diameter),
        )


def page(data: Data, shown: Sequence[Picture], central_diameter: float | None) -> str:
    """The whole page. All text is escaped by the template."""
    provenance = data.provenance
    scene = data.scene
    version = str(provenance.get("versions", {}).get("zonda", ""))
    return render(
        __package__,
        "report.html",
        title=str(provenance.get("name") or "zonda run"),
        description=str(provenance.get("description") or ""),
        data=data,
        scene=scene,
        version=version,
        results=results(data, central_diameter),
        figures=[f for p in data.products.values() if isinstance(p, Figures) for f in p],
        pictures=_pictures(shown, [band.name for band in scene.instrument.bands]),
        about=_scene(data),
        steps=_steps(data),
        log=_log(data),
        timings=_timings(data),
        provenance=_provenance(provenance, scene.seed),
        long=LONG,
        written=[p.name for key in ("map_file", "tod_file") for p in data.products.get(key, [])],
        sexagesimal=sexagesimal,
        spans=_span,
        unwrap=np.unwrap,
    )


def _pictures(shown: Sequence[Picture], bands: Sequence[str]) -> list[dict[str, Any]]:
    found = []
    for picture in shown:
        band = next((b for b in bands if picture.name.endswith(f"_{b}")), "")
        title = picture.title if band in picture.title else f"{picture.title} ({band})"
        image = base64.b64encode(picture.png).decode()
        wide = int.from_bytes(picture.png[16:20], "big") > _WIDE
        found.append({"title": title, "caption": picture.caption, "image": image, "wide": wide})
    return found


def _scene(data: Data) -> dict[str, Any]:
    """Text about the scene by name; what is empty is not shown."""
    scene = data.scene
    instrument = scene.instrument
    site = scene.site
    telescope = scene.instrument.telescope
    cameras = instrument.cameras
    target = scene.target
    number = " + ".join(str(camera.detectors) for camera in cameras.values())
    place = f"{np.degrees(site.latitude):.4f}°, {np.degrees(site.longitude):.4f}°"
    field = f"detectors in a field of {angle_text(instrument.field_of_view)}"
    note = "this table and the plan are of its first entry, figures of its last, counts of all"
    campaign = data.provenance.get("campaign")
    rows = {
        "Campaign": campaign and f"{campaign}; {note}",
        "Site": f"{site.name}: {place}, {site.altitude:.0f} m",
        "Telescope": f"{telescope.name}, {telescope.diameter:.4g} m",
        "Instrument": f"{instrument.name}: {number} {field}",
    }
    sources = {"Site": site.provenance, "Instrument": instrument.provenance}
    for camera in cameras.values():
        tell = f" {camera.band.name}" if len(cameras) > 1 else ""
        rows |= {f"{name}{tell}": text for name, text in _band(camera, data).items()}
        sources[f"Band{tell}"] = camera.band.provenance
    rate = f"{data.observations[0].sample_rate:.6g} Hz" if data.observations else ""
    rows |= {
        "Read-out": rate,
        "Target": "given by the pointing step" if target is None else _target(target),
        "Start": scene.time,
        "Seed": scene.seed,
    }
    return rows | {f"{kind}: source of the numbers": text for kind, text in sources.items()}


def _band(camera: Instrument, data: Data) -> dict[str, str]:
    """A band, with what its detectors are like in the first scan."""
    band = camera.band
    low, high, centre = (f / 1e9 for f in (*band.edges, band.centre))
    rows = {"Band": f"{band.name}: {low:.4g} to {high:.4g} GHz about {centre:.4g} GHz"}
    scans = [o for o in data.observations if o.instrument == camera]
    if not scans:
        return rows
    plane = scans[0].focalplane
    # they differ where noise follows from the load; of a campaign the first scan is known
    known = scans[:1] if "campaign" in data.provenance else scans
    net = spread(np.concatenate([o.focalplane.net for o in known]) * 1e3, " mK_RJ √s")
    if not has_white_noise(data):
        net += " (no white noise is simulated)"
    elif len(known) < len(scans):
        net += " (of the first scan)"
    jansky = flux_density(1.0, expected_fwhm(plane.fwhm, plane.net), band)
    return rows | {
        "Beam (FWHM)": spread(plane.fwhm / ARCSEC, "″"),
        "1 K_RJ at a point source's peak": jansky,
        "Main-beam efficiency ζ": spread(plane.main_beam_efficiency),
        "Illumination efficiency ε": spread(plane.illumination_efficiency),
        "NET on the sky": net,
    }


def _target(target: Target) -> str:
    if target.frame == "icrs":
        return f"{sexagesimal(target.longitude, target.latitude)} (ICRS)"
    names = ("azimuth", "elevation") if target.frame == "horizontal" else ("galactic l", "b")
    angles = np.degrees([target.longitude, target.latitude])
    return ", ".join(f"{name} {angle:.6g}°" for name, angle in zip(names, angles, strict=True))


def _span(angles: AnyFloats) -> str:
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


def _log(data: Data) -> list[tuple[str, str, str]]:
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


def _timings(data: Data) -> dict[str, Counter[str]]:
    """CPU seconds of each step by stage."""
    by_step: dict[str, Counter[str]] = {}
    for label, stage, seconds in data.provenance.get("timings", []):
        by_step.setdefault(label, Counter())[stage] += seconds
    return by_step


def _provenance(known: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Origin of the numbers: seed, command, versions, signals; what is empty is not shown."""
    rows = {"seed": seed, "command": known.get("command"), **known.get("versions", {})}
    rows["precision"] = known.get("precision")
    for name, run in known.get("runs", {}).items():
        parts = (
            f"{how} {' and '.join(what) if isinstance(what, list) else what}"
            for how, what in run.items()
        )
        rows[f"signal {name}"] = ", ".join(parts)
    return rows


PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "µ"))


def scaled(value: float, unit: str, least: float = 1.0) -> str:
    """``value`` with three digits and a prefix: none, m or µ, the first with which it is at least
    ``least``.
    """
    if not math.isfinite(value):
        return "unknown"
    factor, prefix = next((u for u in PREFIXES if abs(value) * u[0] >= least), PREFIXES[-1])
    return f"{value * factor:.3g}\u00a0{prefix}{unit}".replace("-", "−")


def spread(values: Any, unit: str = "") -> str:
    """One number where all are the same, else the range and the mean."""
    low = float(np.min(values))
    high = float(np.max(values))
    if math.isclose(low, high, rel_tol=1e-9):
        return f"{low:.4g}{unit}"
    return f"{low:.4g} to {high:.4g}{unit}, mean {float(np.mean(values)):.4g}"


def sexagesimal(ra: float, dec: float) -> str:
    """``02h32m11.00s −04°40′00.0″``, from rad."""
    s = round(ra % (2 * math.pi) * 43200 / math.pi, 2) % 86400
    a = round(abs(dec) * 648000 / math.pi, 1)
    hours = f"{s // 3600:02.0f}h{s % 3600 // 60:02.0f}m{s % 60:05.2f}s"
    degrees = f"{a // 3600:02.0f}°{a % 3600 // 60:02.0f}′{a % 60:04.1f}″"
    return f"{hours} {'−' if dec < 0 else '+'}{degrees}"


_NUMBER = re.compile(r"([-+]?\d+\.?\d*(?:e[-+]?\d+)?) ([A-Za-z][A-Za-z0-9 /()]*)", re.IGNORECASE)
_ANGLES = ((180 / math.pi, "deg"), (10800 / math.pi, "arcmin"), (648000 / math.pi, "arcsec"))
_KELVIN = ((1.0, ""), (1e3, "m"), (1e6, "u"))
_UNITS = {
    "rad": _ANGLES,
    "rad / s": tuple((factor, f"{name}/s") for factor, name in _ANGLES),
    "s": ((1 / 60, "min"), (1, "s"), (1e3, "ms")),
    "Hz": ((1e-9, "GHz"), (1e-3, "kHz"), (1, "Hz")),
    "m": ((1e-3, "km"), (1, "m"), (1e3, "mm")),
    "K": tuple((factor, f"{prefix}K") for factor, prefix in _KELVIN),
    "K s(1/2)": tuple((factor, f"{prefix}K sqrt(s)") for factor, prefix in _KELVIN),
}


def readable(text: str) -> str:
    """``0.0011635528346628863 rad`` as ``4 arcmin``; other text as it is."""
    match = _NUMBER.fullmatch(text.strip())
    if match is None or match[2].strip() not in _UNITS:
        return text
    value = float(match[1])
    unit = match[2].strip()
    if value == 0:
        return f"0 {unit.replace(' / ', '/')}"
    fitting = [(f, n) for f, n in _UNITS[unit] if abs(value) * f >= 0.9999995] or _UNITS[unit][-1:]
    factor, name = next(((f, n) for f, n in fitting if len(f"{value * f:.6g}") < 6), fitting[0])
    return f"{value * factor:.6g} {name}"


Row = tuple[str, str, str]
"""A quantity in words, and its value per beam and per pixel; empty where there is none."""


def brightness(kelvin: float) -> str:
    """A brightness with three figures, in the unit that reads best."""
    return scaled(kelvin, "K_RJ")


def flux_density(kelvin: float, fwhm: float, band: Band) -> str:
    """Flux density of a point source with a flat spectrum whose peak is ``kelvin`` behind a
    Gaussian beam of ``fwhm`` [rad].
    """
    jansky = kelvin / to_kelvin_rj("Jy/beam", band, beam_solid_angle=beam_area(fwhm))
    return scaled(jansky, "Jy", 0.9995)


def results(data: Data, given: float | None) -> tuple[dict[str, str], list[Row]]:
    """Amount that was observed, by name; noise and depth of the maps.

    ``given`` is the diameter [rad] of the circle in which that is taken; None stands for
    `central_diameter` of each map.
    """
    maps = maps_of(data.products)
    whole = maps_of(data.products, split=False)
    wide = {name: central_diameter(m.fwhm, m.pixel, given) for name, m in maps.items()}
    main = {name: product for name, product in maps.items() if "/" not in name}
    seconds = sum(o.duration for o in data.scans)
    samples = sum(o.n_samples * o.n_detectors for o in data.observations)
    found = {
        "scans": str(len(data.scans)),
        "on the sky": f"{seconds / 60:.3g} min" if seconds >= 60 else f"{seconds:.3g} s",
        "samples of all detectors": f"{samples:,}".replace(",", "\u202f"),
    }
    for name, product in whole.items():
        if "/" not in name:
            found |= _unsolved(name, product)
    rows = [_noise(figure, maps[figure.product]) for figure in noise_figures(maps, given)]
    for name, product in main.items():
        if name in data.products:
            rows += _depth(name, product, wide[name])
    for name, product in main.items() if has_white_noise(data) else ():
        rows += expected(name, product, wide[name])
    strongest = {
        "input": getattr(data.products.get("input"), "values", np.nan),
        "noiseless map": getattr(maps.get("noiseless/map"), "signal", np.nan),
    }
    for what, values in strongest.items():
        known = np.asarray(values)[np.isfinite(values)]
        if known.size:
            peak = float(known[np.abs(known).argmax()])
            found[f"strongest pixel of the {what}"] = brightness(peak)
    return found, rows


def _of(name: str) -> str:
    """Name of a map behind what is said of it; that of ``map`` is left out."""
    return "" if name == "map" else f", {name}"


def _unsolved(name: str, product: MapProduct) -> dict[str, str]:
    """Number of pixels with samples in which a map has no I, Q and U; none where there are all."""
    if product.polarization is None:
        return {}
    hit = int(np.count_nonzero(product.hits))
    solved = int(np.count_nonzero(product.known))
    label = _of(name)
    text = f"pixels with samples are NaN: too few angles of polarization for I, Q and U{label}"
    return {text: f"{hit - solved} of {hit}"} if solved < hit else {}


def _noise(figure: NoiseFigure, product: MapProduct) -> Row:
    """The noise at the centre of a map, smoothed with the beam if that can be done, and as it
    is.
    """
    of = {
        "half_difference": product.difference.replace(" - ", " − "),
        "source_free": "all but the sky",
    }[figure.of]
    where = f"rms, {_central(figure.diameter, product)}, {of}{_of(figure.product)}"
    if not math.isfinite(figure.rms):
        return f"{where}: too few pixels; set central_diameter", "", "unknown"
    smoothed = _smoothed(figure.smoothed, product) if math.isfinite(figure.smoothed) else ""
    return where, smoothed, _each(brightness(figure.rms), product)


def _central(diameter: float, product: MapProduct) -> str:
    return f"central {np.degrees(diameter) * 60:.3g}′{in_beams(diameter, product.fwhm)}"


def has_white_noise(data: Data) -> bool:
    """True if a step of the pipeline makes white noise."""
    classes = (class_of(kind) for _, kind, _ in data.provenance.get("operators", []))
    return any(cls is not None and "white" in declared(cls, "provides") for cls in classes)


def expected(name: str, product: MapProduct, diameter: float) -> list[Row]:
    """The white noise at the centre of a map that NET and samples promise; none if nothing
    is known.

    Smoothing with a beam of width sigma divides the variance of pixels of area A by 4 pi sigma^2 /
    A: the weight of the pixels 1 / noise^2 is added up per solid angle.
    """
    near = product.distance() <= diameter / 2
    noise = product.noise[near]
    areas = np.broadcast_to(product.areas(), product.hits.shape)[near]
    known = np.isfinite(noise) & (noise > 0)
    if not known.any() or product.noise_from != "net" or product.contents != "all":
        return []
    rms = float(1 / np.sqrt(np.sum(noise[known] ** -2.0) / noise.size))  # of the mean weight
    what = f"white noise by NET and samples, {_central(diameter, product)}{_of(name)}"
    side = math.sqrt(float(areas.mean()))
    factor = math.inf
    if product.fwhm > 0 and not product.smoothed_by:
        factor = side / product.fwhm * math.sqrt(2 * math.log(2) / math.pi)
    smoothed = "" if factor > 0.5 else _smoothed(rms * factor, product)  # small beside the beam
    return [(what, smoothed, _each(brightness(rms), product))]


def _each(value: str, product: MapProduct) -> str:
    return f"{value} ({sides_text(*product.sides)} pixels)"


def _smoothed(kelvin: float, product: MapProduct) -> str:
    """``kelvin`` in a map smoothed with its beam, its flux density, and the resolution."""
    resolution = math.sqrt(2) * product.fwhm
    flux = f", {flux_density(kelvin, resolution, product.band)}" if product.band else ""
    return f"{brightness(kelvin)}{flux} ({angle_text(resolution)} beam)"


def _depth(name: str, product: MapProduct, diameter: float) -> list[Row]:
    """The time for which the centre of a map was observed, the median over its pixels; none
    if it is not known.
    """
    factor = product.seconds_per_beam()
    near = product.distance() <= diameter / 2
    if factor is None or not near.any():
        return []
    samples = product.hits[near]
    each = np.broadcast_to(np.asarray(factor), product.hits.shape)[near]
    seconds = float(np.median(samples * each))
    time = f"{seconds:.3g}\u00a0s" if seconds < 6000 else f"{seconds / 3600:.3g}\u00a0h"
    where = f"time of all detectors, {_central(diameter, product)}{_of(name)}"
    counted = _each(f"{np.median(samples):.4g} samples", product)
    return [(where, f"{time} ({angle_text(product.fwhm)} beam)", counted)]


def class_of(kind: str) -> type[Operator] | None:
    """The operator class of that name; None where its plugin cannot be had any more."""
    with suppress(ZondaError):
        found: type[Operator] = operators.get(kind)
        return found
    return None
