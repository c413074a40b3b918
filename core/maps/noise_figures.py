"""The maps among the products of a run, and how noisy they are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..errors import InputError
from ..signal import Signal
from ..types import Floats
from .map_product import MapProduct
from .planes import ELSEWHERE, central_diameter, stated

Noise = Literal["half_difference", "source_free"]
"""What holds noise alone: half the difference of two halves of the samples, the map of the signal
without the sky.
"""


def maps_of(products: Mapping[str, Any], *, split: bool = True) -> dict[str, MapProduct]:
    """Every map among ``data.products``, by name, of ``signal`` first; not of signals that a step
    has for itself (_NAME).

    ``split``: Q and U of a polarized map are maps of their own, ``NAME_Q`` and ``NAME_U``.
    """
    found = (n for n, p in products.items() if isinstance(p, MapProduct) and not n.startswith("_"))
    names = sorted(found, key=lambda n: ("/" in n, n))
    if not split:
        return {name: products[name] for name in names}
    return {
        name if which == "I" else f"{name}_{which}": one
        for name in names
        for which, one in products[name].by_stokes().items()
    }


@dataclass(frozen=True)
class NoiseFigure:
    """Noise of a map near its centre.

    ``of``: ``half_difference`` or ``source_free``; ``rms``: in K, NaN where there is no pixel;
    ``smoothed``: the same after smoothing with the beam (NaN where the map cannot be or is already
    smoothed); ``diameter`` [rad] of the circle.
    """

    product: str
    of: Noise
    rms: float
    smoothed: float
    diameter: float


def noise_figures(maps: Mapping[str, MapProduct], given: float | None = None) -> list[NoiseFigure]:
    """Weighted rms about zero in the middle, of what holds noise alone: `noise_sources`.

    ``given``: diameter of the circle, rad; None: `central_diameter` of each map.
    """
    found = []
    for name in maps:
        for of, (product, plane) in noise_sources(maps, name).items():
            diameter = central_diameter(product.fwhm, product.pixel, given)
            rms = product.rms(diameter / 2, of=plane)
            again = product.header is not None and product.fwhm > 0 and not product.smoothed_by
            smoothed = (
                product.smoothed_rms(product.fwhm, diameter / 2, of=plane) if again else math.nan
            )
            found.append(NoiseFigure(name, of, rms, smoothed, diameter))
    return found


def matched(template: MapProduct, product: MapProduct) -> tuple[float, float]:
    """Amplitude of a template t in a map m of the same step, and its standard error,

        a = (A t)^T m / t^T A t,   sigma = (t^T A t)^(-1/2).                                    (1)

    ``template``: maximum-likelihood map of a signal without noise, which has A t as a plane. 1 /
    sigma is its signal-to-noise ratio as a template. Raises InputError for one without, or without
    power, and for maps of other samples or noise models (filtered, smoothed), or in another unit.
    """
    if "template" not in template.planes:
        raise InputError(
            "the map has no weights as a template",
            place="template",
            cure="take the maximum-likelihood map of a signal without noise, e.g. {only: [sky]},"
            " not smoothed",
        )
    same = all(
        getattr(template, name) == getattr(product, name) for name in ("unit", "smoothed_by")
    )
    same = same and all(
        np.array_equal(getattr(template, name), getattr(product, name), equal_nan=True)
        for name in ("hits", "weights")
    )
    if not same:
        raise InputError(
            "the map has other samples, another noise model, beam or unit than the template",
            place="template",
            cure="take both maps from one step of one run, not smoothed, and in one unit",
        )
    weights = np.nan_to_num(template.planes["template"].values)
    t, m = (np.nan_to_num(one.planes["signal"].values) for one in (template, product))
    power = float((weights * t).sum())
    if not power > 0:
        raise InputError("the template is empty", place="template", cure="use a sky with a source")
    return float((weights * m).sum()) / power, power**-0.5


FREE = "the map of all but the sky"
"""How the source-free map is called."""


def noise_alone(
    maps: Mapping[str, MapProduct],
    name: str,
    wanted: Sequence[Noise] = ("source_free", "half_difference"),
) -> tuple[Floats, str] | None:
    """The noise map that belongs to the map ``name``, and which it is: all but the sky, else half
    the difference of two halves of the samples (in the order of ``wanted``); None if there is none.
    """
    sources = noise_sources(maps, name)
    for of in wanted:
        if of in sources:
            product, plane = sources[of]
            values = np.where(product.known, getattr(product, plane), np.nan)
            return (
                values,
                FREE if of == "source_free" else f"half the difference, {product.difference}",
            )
    return None


def noise_stated(
    maps: Mapping[str, MapProduct],
    name: str,
    runs: Mapping[str, Any] | None = None,
) -> dict[str, tuple[float | None, str]]:
    """Known noise of I, and of Q and U if they are there, of a map among ``maps`` (`maps_of`).

    The factor on its white noise, and what it was measured in; None and `WHITE` where there is no
    map of the noise alone, and `ELSEWHERE` of a map without noise. Nothing where no noise is known.
    ``runs``: as of `is_quiet`.
    """
    found: dict[str, tuple[float | None, str]] = {}
    for key, own in (("I", name), ("Q", f"{name}_Q"), ("U", f"{name}_U")):
        if own in maps and np.isfinite(maps[own].noise).any():
            quiet = is_quiet(runs or {}, name)
            found[key] = (
                (None, ELSEWHERE) if quiet else stated(maps[own].noise, noise_alone(maps, own))
            )
    return found


def is_quiet(runs: Mapping[str, Any], name: str) -> bool:
    """True if the map ``name`` is of a signal without noise. ``runs``: the signals of a run, as its
    provenance has them.
    """
    signal, _, rest = name.partition("/")
    return bool(rest) and signal in runs and Signal(**runs[signal]).is_quiet


def noise_sources(
    maps: Mapping[str, MapProduct],
    name: str,
) -> dict[Noise, tuple[MapProduct, Literal["signal", "half_difference"]]]:
    """For a map of ``signal``: which product's which plane holds noise alone; nothing for maps of
    other signals.
    """
    found: dict[Noise, tuple[MapProduct, Literal["signal", "half_difference"]]] = {}
    if "/" in name:
        return found
    if maps[name].half_difference is not None:
        found["half_difference"] = (maps[name], "half_difference")
    free = maps.get(f"source_free/{name}")
    if free is not None and free.signal.shape == maps[name].signal.shape:
        found["source_free"] = (free, "signal")
    return found
