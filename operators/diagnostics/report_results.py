"""The figures of a run in short, as cards of its report."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.band import Band
from zonda.core.data import Data
from zonda.core.errors import ZondaError
from zonda.core.maps.central import central_diameter, in_beams
from zonda.core.maps.noise_figures import NoiseFigure, maps_of, noise_figures
from zonda.core.numerics.angles import angle_text, beam_area, sides_text
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.operator import Operator
from zonda.core.registry import declared

from .report_text import scaled

if TYPE_CHECKING:
    from zonda.core.maps.map_product import MapProduct

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
    maps = maps_of(data.products)
    wide = {
        name: central_diameter(product.fwhm, product.pixel, given) for name, product in maps.items()
    }
    seconds = sum(o.duration for o in data.scans)
    samples = sum(o.n_samples * o.n_detectors for o in data.observations)
    cards: list[Card] = [
        (str(len(data.scans)), "scan" if len(data.scans) == 1 else "scans"),
        (f"{seconds / 60:.3g} min" if seconds >= 60 else f"{seconds:.3g} s", "on the sky"),
        (f"{samples:,}".replace(",", "\u202f"), "samples of all detectors"),
    ]
    whole = maps_of(data.products, split=False)
    cards += [
        card
        for name, product in whole.items()
        if "/" not in name
        for card in _unsolved(name, product)
    ]
    for figure in noise_figures(maps, given):
        cards += _noise(figure, maps[figure.product])
    main = [(name, product) for name, product in maps.items() if "/" not in name]
    cards += [
        card
        for name, product in main
        if name in data.products
        for card in _depth(name, product, wide[name])
    ]
    if has_white_noise(data):
        cards += [card for name, product in main for card in expected(name, product, wide[name])]
    strongest = {"input": getattr(data.products.get("input"), "values", None)}
    strongest["noiseless map"] = getattr(maps.get("noiseless/map"), "signal", None)
    for what, values in strongest.items():
        if values is not None and np.isfinite(values).any():
            cards.append((brightness(_extreme(values)), f"strongest pixel of the {what}"))
    return cards


def _unsolved(name: str, product: MapProduct) -> list[Card]:
    """In how many pixels with samples a map has no I, Q and U: a card, or none where there are
    all.
    """
    if product.polarization is None:
        return []
    hit, solved = int(np.count_nonzero(product.hits)), int(np.count_nonzero(product.known))
    label = "" if name == "map" else f", {name}"
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
    label = "" if figure.product == "map" else f", {figure.product}"
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
    label = "" if name == "map" else f", {name}"
    where = _central(diameter, product)
    side = math.sqrt(float(areas.mean()))
    factor = (
        side / product.fwhm * math.sqrt(2 * math.log(2) / math.pi) if product.fwhm > 0 else math.inf
    )
    if product.smoothed_by or factor > 0.5:  # pixels that are not small beside the beam
        return [(brightness(rms), f"white noise by NET and samples, {where}{label}")]
    how = _smoothed(rms * factor, product)
    return [(brightness(rms * factor), f"white noise by NET and samples, {where}, {how}{label}")]


def _smoothed(kelvin: float, product: MapProduct) -> str:
    """Resolution of a map smoothed with its beam, and the flux density of ``kelvin`` in it, in
    words.
    """
    resolution = math.sqrt(2) * product.fwhm
    how = f"{angle_text(product.fwhm)} beam and as much smoothing, added in quadrature"
    text = f"smoothed with the beam to {angle_text(resolution)} ({how})"
    return (
        f"{text}: {flux_density(kelvin, resolution, product.band)} per such beam"
        if product.band
        else text
    )


def _depth(name: str, product: MapProduct, diameter: float) -> list[Card]:
    """Card of the time for which the centre of a map was observed, the median over its pixels; none
    if it is not known.
    """
    factor, near = product.seconds_per_beam(), product.distance() <= diameter / 2
    if factor is None or not near.any():
        return []
    samples, each = (
        product.hits[near],
        np.broadcast_to(np.asarray(factor), product.hits.shape)[near],
    )
    seconds = float(np.median(samples * each))
    time = f"{seconds:.3g}\u00a0s" if seconds < 6000 else f"{seconds / 3600:.3g}\u00a0h"
    where = _central(diameter, product) + ("" if name == "map" else f", {name}")
    counted = f"{np.median(samples):.4g} samples per {sides_text(*product.sides)} pixel"
    return [(time, f"of all detectors per {angle_text(product.fwhm)} beam, {where}; {counted}")]


def _extreme(values: Any) -> float:
    finite = values[np.isfinite(values)]
    return float(finite[np.abs(finite).argmax()])


def class_of(kind: str) -> type[Operator] | None:
    """The operator class of that name; None where its plugin cannot be had any more."""
    from zonda.core.registry import operators

    with suppress(ZondaError):
        found: type[Operator] = operators.get(kind)
        return found
    return None
