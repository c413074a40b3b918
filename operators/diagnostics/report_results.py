"""The figures of a run in short, as cards of its report."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.band import Band
from zonda.core.data import Data
from zonda.core.errors import ZondaError
from zonda.core.maps.measured_noise import central_diameter, in_beams
from zonda.core.maps.noise_figures import NoiseFigure, maps_of, noise_figures
from zonda.core.numerics.angles import angle_text, beam_area, sides_text
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.operator import Operator
from zonda.core.registry import declared

if TYPE_CHECKING:
    from zonda.core.maps.map_product import MapProduct


def scaled(
    value: float, units: Sequence[tuple[float, str]], digits: int = 3, least: float = 1.0
) -> str:
    """``value`` in the first unit (factor, name) in which it is at least ``least``, else in the
    last.
    """
    factor, name = next((u for u in units if abs(value) * u[0] >= least), units[-1])
    return f"{value * factor:.{digits}g}{name}"


def spread(values: Any, unit: str = "") -> str:
    """One number where all are the same, else the range and the mean."""
    low, high = float(np.min(values)), float(np.max(values))
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
    value, unit = float(match[1]), match[2].strip()
    if value == 0:
        return f"0 {unit.replace(' / ', '/')}"
    fitting = [(f, n) for f, n in _UNITS[unit] if abs(value) * f >= 0.9999995] or _UNITS[unit][-1:]
    factor, name = next(((f, n) for f, n in fitting if len(f"{value * f:.6g}") < 6), fitting[0])
    return f"{value * factor:.6g} {name}"


Card = tuple[str, str]
"""A figure, and what it is."""


def brightness(kelvin: float) -> str:
    """A brightness with three figures, in the unit that reads best."""
    if not math.isfinite(kelvin):
        return "unknown"
    return scaled(kelvin, ((1, "\u00a0K_RJ"), (1e3, "\u00a0mK_RJ"), (1e6, "\u00a0µK_RJ"))).replace(
        "-", "−"
    )


def flux_density(kelvin: float, fwhm: float, band: Band) -> str:
    """Flux density of a point source with a flat spectrum whose peak is ``kelvin`` behind a
    Gaussian beam of ``fwhm`` [rad].
    """
    jansky = kelvin / to_kelvin_rj("Jy/beam", band, beam_solid_angle=beam_area(fwhm))
    return scaled(jansky, ((1, "\u00a0Jy"), (1e3, "\u00a0mJy"), (1e6, "\u00a0µJy")), least=0.9995)


def results(data: Data, given: float | None) -> list[Card]:
    """Cards of how much was observed, how noisy and how deep the maps are.

    ``given`` is the diameter [rad] of the circle in which that is taken; None stands for
    `central_diameter` of each map.
    """
    maps, whole = maps_of(data.products), maps_of(data.products, split=False)
    wide = {name: central_diameter(m.fwhm, m.pixel, given) for name, m in maps.items()}
    main = {name: product for name, product in maps.items() if "/" not in name}
    seconds = sum(o.duration for o in data.scans)
    samples = sum(o.n_samples * o.n_detectors for o in data.observations)
    cards: list[Card] = [
        (str(len(data.scans)), "scan" if len(data.scans) == 1 else "scans"),
        (f"{seconds / 60:.3g} min" if seconds >= 60 else f"{seconds:.3g} s", "on the sky"),
        (f"{samples:,}".replace(",", "\u202f"), "samples of all detectors"),
    ]
    for name, product in whole.items():
        if "/" not in name:
            cards += _unsolved(name, product)
    for figure in noise_figures(maps, given):
        cards += _noise(figure, maps[figure.product])
    for name, product in main.items():
        if name in data.products:
            cards += _depth(name, product, wide[name])
    for name, product in main.items() if has_white_noise(data) else ():
        cards += expected(name, product, wide[name])
    strongest = {
        "input": getattr(data.products.get("input"), "values", np.nan),
        "noiseless map": getattr(maps.get("noiseless/map"), "signal", np.nan),
    }
    for what, values in strongest.items():
        known = np.asarray(values)[np.isfinite(values)]
        if known.size:
            peak = float(known[np.abs(known).argmax()])
            cards.append((brightness(peak), f"strongest pixel of the {what}"))
    return cards


def _of(name: str) -> str:
    """Name of a map behind what is said of it; that of ``map`` is left out."""
    return "" if name == "map" else f", {name}"


def _unsolved(name: str, product: MapProduct) -> list[Card]:
    """In how many pixels with samples a map has no I, Q and U: a card, or none where there are
    all.
    """
    if product.polarization is None:
        return []
    hit, solved = int(np.count_nonzero(product.hits)), int(np.count_nonzero(product.known))
    label = _of(name)
    text = f"pixels with samples are NaN: too few angles of polarization for I, Q and U{label}"
    return [(f"{hit - solved} of {hit}", text)] if solved < hit else []


def _noise(figure: NoiseFigure, product: MapProduct) -> list[Card]:
    """Cards of the noise at the centre of a map, smoothed with the beam if that can be done, and as
    it is.
    """
    of = {
        "half_difference": product.difference.replace(" - ", " − "),
        "source_free": "all but the sky",
    }[figure.of]
    where = f"rms, {_central(figure.diameter, product)}, {of}"
    label = _of(figure.product)
    if math.isfinite(figure.smoothed):
        how = _smoothed(figure.smoothed, product)
        before = f"the same before smoothing, per {sides_text(*product.sides)} pixel"
        return [
            (brightness(figure.smoothed), f"{where}, {how}{label}"),
            (brightness(figure.rms), before),
        ]
    if math.isfinite(figure.rms):
        return [(brightness(figure.rms), f"{where}{label}")]
    return [("unknown", f"{where}{label}: too few pixels; set central_diameter")]


def _central(diameter: float, product: MapProduct) -> str:
    return f"central {np.degrees(diameter) * 60:.3g}′{in_beams(diameter, product.fwhm)}"


def has_white_noise(data: Data) -> bool:
    """True if a step of the pipeline makes white noise."""
    classes = (class_of(kind) for _, kind, _ in data.provenance.get("operators", []))
    return any(cls is not None and "white" in declared(cls, "provides") for cls in classes)


def expected(name: str, product: MapProduct, diameter: float) -> list[Card]:
    """Card of the white noise at the centre of a map that NET and samples promise; none if nothing
    is known.

    Smoothing with a beam of width sigma divides the variance of pixels of area A by 4 pi sigma^2 /
    A: the weight of the pixels 1 / noise^2 is added up per solid angle.
    """
    near = product.distance() <= diameter / 2
    noise, areas = product.noise[near], np.broadcast_to(product.areas(), product.hits.shape)[near]
    known = np.isfinite(noise) & (noise > 0)
    if not known.any() or product.noise_from != "net" or product.contents != "all":
        return []
    rms = float(1 / np.sqrt(np.sum(noise[known] ** -2.0) / noise.size))  # of the mean weight
    label = _of(name)
    where = _central(diameter, product)
    side = math.sqrt(float(areas.mean()))
    factor = math.inf
    if product.fwhm > 0 and not product.smoothed_by:
        factor = side / product.fwhm * math.sqrt(2 * math.log(2) / math.pi)
    what = f"white noise by NET and samples, {where}"
    if factor > 0.5:  # pixels that are not small beside the beam
        return [(brightness(rms), f"{what}{label}")]
    return [(brightness(rms * factor), f"{what}, {_smoothed(rms * factor, product)}{label}")]


def _smoothed(kelvin: float, product: MapProduct) -> str:
    """Resolution of a map smoothed with its beam, and the flux density of ``kelvin`` in it, in
    words.
    """
    resolution = math.sqrt(2) * product.fwhm
    how = f"{angle_text(product.fwhm)} beam and as much smoothing, added in quadrature"
    text = f"smoothed with the beam to {angle_text(resolution)} ({how})"
    if product.band:
        text += f": {flux_density(kelvin, resolution, product.band)} per such beam"
    return text


def _depth(name: str, product: MapProduct, diameter: float) -> list[Card]:
    """Card of the time for which the centre of a map was observed, the median over its pixels; none
    if it is not known.
    """
    factor, near = product.seconds_per_beam(), product.distance() <= diameter / 2
    if factor is None or not near.any():
        return []
    samples = product.hits[near]
    each = np.broadcast_to(np.asarray(factor), product.hits.shape)[near]
    seconds = float(np.median(samples * each))
    time = f"{seconds:.3g}\u00a0s" if seconds < 6000 else f"{seconds / 3600:.3g}\u00a0h"
    where = _central(diameter, product) + _of(name)
    counted = f"{np.median(samples):.4g} samples per {sides_text(*product.sides)} pixel"
    return [(time, f"of all detectors per {angle_text(product.fwhm)} beam, {where}; {counted}")]


def class_of(kind: str) -> type[Operator] | None:
    """The operator class of that name; None where its plugin cannot be had any more."""
    from zonda.core.registry import operators

    with suppress(ZondaError):
        found: type[Operator] = operators.get(kind)
        return found
    return None
