"""The figures of a run in short, as cards of its report."""

from __future__ import annotations

import math
from contextlib import suppress
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.data import Data
from zonda.core.errors import ZondaError
from zonda.core.maps.map_view import maps_of, noise_figures
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.operator import Operator

if TYPE_CHECKING:
    from zonda.core.maps.map_product import MapProduct


def brightness(kelvin: float) -> str:
    """A brightness with three figures, in the unit that reads best."""
    if not math.isfinite(kelvin):
        return "unknown"
    for factor, unit in ((1e6, "µK_RJ"), (1e3, "mK_RJ")):
        if abs(kelvin) * factor < 1e3:
            return f"{kelvin * factor:.3g}\u00a0{unit}".replace("-", "−")
    return f"{kelvin:.3g}\u00a0K_RJ".replace("-", "−")


def flux_density(kelvin: float, fwhm: float, data: Data) -> str:
    """Of a point source with a flat spectrum whose peak is ``kelvin`` behind a Gaussian beam of ``fwhm`` [rad]."""
    jansky = kelvin / to_kelvin_rj("Jy/beam", data.scene.instrument.band, beam_solid_angle=math.pi / math.log(16) * fwhm**2)
    for factor, unit in ((1, "Jy"), (1e3, "mJy")):
        if abs(jansky) * factor >= 0.9995:
            return f"{jansky * factor:.3g}\u00a0{unit}"
    return f"{jansky * 1e6:.3g}\u00a0µJy"


def results(data: Data, diameter: float) -> str:
    """Cards: how much was observed, how noisy and how deep the maps are. ``diameter`` [rad] of the circle where that is taken."""
    maps = maps_of(data.products)
    seconds = sum(o.duration for o in data.observations)
    samples = sum(o.n_samples * o.n_detectors for o in data.observations)
    cards = [
        (str(len(data.observations)), "scan" if len(data.observations) == 1 else "scans"),
        (f"{seconds / 60:.3g} min" if seconds >= 60 else f"{seconds:.3g} s", "on the sky"),
        (f"{samples:,}".replace(",", "\u202f"), "samples of all detectors"),
    ]
    words = {"half_difference": "even − odd scans", "source_free": "run without the sky"}
    where = f"central {np.degrees(diameter) * 60:.3g}′"
    for figure in noise_figures(maps, diameter):
        label = "" if figure.product == "map" else f", {figure.product}"
        smoothed = math.isfinite(figure.smoothed)
        if not (smoothed or math.isfinite(figure.rms)):
            cards.append(("unknown", f"rms, {where}, {words[figure.of]}{label}: too few pixels; set central_diameter"))
            continue
        how = f", {_smoothed(figure.smoothed, maps[figure.product].fwhm, data)}" if smoothed else ""
        shown = brightness(figure.smoothed if smoothed else figure.rms)
        cards.append((shown, f"rms, {where}, {words[figure.of]}{how}{label}"))
        if smoothed:
            cards.append((brightness(figure.rms), f"the same before smoothing, per {angle(maps[figure.product].pixel)} pixel"))
    for name, made in maps.items():
        if "/" not in name:
            cards += _depth(name, made, diameter)
    if has_white_noise(data):
        cards += [card for name, made in maps.items() if "/" not in name for card in expected(name, made, diameter, data)]
    if (image := data.products.get("input")) is not None and hasattr(image, "values") and np.isfinite(image.values).any():
        cards.append((brightness(_extreme(image.values)), "strongest pixel of the input"))
    if (product := maps.get("noiseless/map")) is not None and np.isfinite(product.signal).any():
        cards.append((brightness(_extreme(product.signal)), "strongest pixel of the noiseless map"))
    return (
        '<div class="cards">'
        + "".join(f"<div class=card><b>{escape(b)}</b><span>{escape(s)}</span></div>" for b, s in cards)
        + "</div>"
    )


def has_white_noise(data: Data) -> bool:
    """Whether a step of the pipeline makes white noise."""
    classes = (class_of(kind) for _, kind, _ in data.provenance.get("operators", []))
    return any(cls is not None and "white" in cls.provides for cls in classes)


def expected(name: str, product: MapProduct, diameter: float, data: Data) -> list[tuple[str, str]]:
    """What the NET and the samples promise for the centre of a map: a card, or none where nothing is known.

    Smoothing with a beam of width sigma divides the variance of pixels of area A by 4 pi sigma^2 / A.
    """
    noise = product.noise[product.distance() <= diameter / 2]
    known = np.isfinite(noise) & (noise > 0)
    if not known.any() or product.noise_from != "net" or product.contents != "all":
        return []
    rms = float(1 / np.sqrt(np.sum(noise[known] ** -2.0) / noise.size))  # of the mean weight
    label = "" if name == "map" else f", {name}"
    where = f"central {np.degrees(diameter) * 60:.3g}′"
    factor = product.pixel / product.fwhm * math.sqrt(2 * math.log(2) / math.pi) if product.fwhm > 0 else math.inf
    if product.smoothed_by or factor > 0.5:  # pixels that are not small beside the beam
        return [(brightness(rms), f"white noise by NET and samples, {where}{label}")]
    how = _smoothed(rms * factor, product.fwhm, data)
    return [(brightness(rms * factor), f"white noise by NET and samples, {where}, {how}{label}")]


def _smoothed(kelvin: float, fwhm: float, data: Data) -> str:
    """What smoothing with the beam of ``fwhm`` [rad] made of a map: its resolution, and the flux density of ``kelvin`` in it."""
    resolution = math.sqrt(2) * fwhm
    how = f"{angle(fwhm, 3)} beam and as much smoothing, added in quadrature"
    return f"smoothed with the beam to {angle(resolution, 3)} ({how}): {flux_density(kelvin, resolution, data)} per such beam"


def _depth(name: str, product: MapProduct, diameter: float) -> list[tuple[str, str]]:
    """How long the centre of a map was observed: a card, or none where that is not known. The median over its pixels."""
    factor, near = product.seconds_per_beam(), product.distance() <= diameter / 2
    if factor is None or not near.any():
        return []
    samples, each = product.hits[near], np.broadcast_to(np.asarray(factor), product.hits.shape)[near]
    seconds = float(np.median(samples * each))
    time = f"{seconds:.3g}\u00a0s" if seconds < 6000 else f"{seconds / 3600:.3g}\u00a0h"
    where = f"central {np.degrees(diameter) * 60:.3g}′{'' if name == 'map' else f', {name}'}"
    counted = f"{np.median(samples):.4g} samples per {angle(product.pixel)} pixel"
    return [(time, f"of all detectors per {angle(product.fwhm, 3)} beam, {where}; {counted}")]


def _extreme(values: Any) -> float:
    finite = values[np.isfinite(values)]
    return float(finite[np.abs(finite).argmax()])


def angle(value: float, digits: int = 4) -> str:
    """``4°``, ``1.5′``, ``8.5″``, of rad."""
    for factor, unit in ((180 / math.pi, "°"), (10800 / math.pi, "′")):
        if abs(value) * factor >= 1:
            return f"{value * factor:.{digits}g}{unit}"
    return f"{value * 648000 / math.pi:.{digits}g}″"


def class_of(kind: str) -> type[Operator] | None:
    """The operator class of that name; None where its plugin cannot be had any more."""
    from zonda.core.registry import mapmakers, operators

    for registry in (operators, mapmakers):
        with suppress(ZondaError, KeyError):
            if kind in registry:
                found = registry.get(kind)
                if isinstance(found, type) and issubclass(found, Operator):
                    return found
    return None
