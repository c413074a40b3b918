"""I, Q and U of polarized maps as maps of their own, and in files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from ..errors import InputError
from ..types import AnyFloats
from .map_arrays import MapArrays
from .polarized import COVARIANCES, Polarization

Map = TypeVar("Map", bound=MapArrays)

MEANINGS = {
    "i": "Stokes I",
    "q": "Stokes Q",
    "u": "Stokes U",
    **{
        f"cov_{pair}": f"covariance of {pair[0].upper()} and {pair[1].upper()}"
        for pair in COVARIANCES
    },
    "condition": "condition number of the angles in a pixel",
    "half_difference_q": "Q of the difference of two halves",
    "half_difference_u": "U of the difference of two halves",
}
"""Of the planes of a file."""
IQU = ("I", "Q", "U")
CONVENTION = "COSMO"
"""In which Q and U of maps are: angles from south to east."""


def stokes_plane(product: Map, name: str) -> Map:
    """`MapProduct.stokes`."""
    found = product.polarization
    if found is None:
        raise InputError(
            "the map has no Q and U", place="map.stokes", cure="set stokes: IQU of the map maker"
        )
    if name == "I":
        return replace(product, polarization=None)
    if name in ("Q", "U"):
        k = "QU".index(name)
        half = None if found.half_difference is None else found.half_difference[k]
        noise = np.sqrt(found.covariance[3 + 2 * k])
        signal = (found.q, found.u)[k]
        return replace(
            product,
            signal=signal,
            noise=noise,
            weights=found.weights[k],
            half_difference=half,
            polarization=None,
        )
    if name != "P":
        raise InputError(
            f"{name!r} is none of I, Q, U and P", place="map.stokes", cure="write map.stokes('Q')"
        )
    p = np.hypot(found.q, found.u)
    qq, qu, uu = found.covariance[3:]
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = (found.q**2 * qq + 2 * found.q * found.u * qu + found.u**2 * uu) / p**2
    weights = found.weights.mean(axis=0)
    return replace(
        product,
        signal=p,
        noise=np.sqrt(variance),
        weights=weights,
        half_difference=None,
        polarization=None,
    )


def planes_of(product: Map, name: str) -> dict[str, Map]:
    """Maps to show of a product ``name``: itself, or of a polarized one I (``name``), Q and U
    (``name_Q``, ``name_U``).
    """
    if product.polarization is None:
        return {name: product}
    return {
        name: stokes_plane(product, "I"),
        **{f"{name}_{s}": stokes_plane(product, s) for s in ("Q", "U")},
    }


def file_planes(product: MapArrays) -> dict[str, AnyFloats]:
    """Planes of the file of a polarized map: I, Q and U first, so that healpy finds them."""
    found = product.polarization
    assert found is not None  # asked for only where there is one
    planes: dict[str, Any] = {
        "i": product.signal,
        "q": found.q,
        "u": found.u,
        "hits": found.hits,
        "weights": product.weights,
    }
    planes |= {f"cov_{pair}": found.covariance[k] for k, pair in enumerate(COVARIANCES)}
    planes["condition"] = found.condition
    if product.half_difference is not None and found.half_difference is not None:
        planes["half_difference"] = product.half_difference
        planes["half_difference_q"], planes["half_difference_u"] = found.half_difference
    return planes


def smoothed_polarization(
    before: Polarization, i: MapArrays, q: MapArrays, u: MapArrays
) -> Polarization:
    """What is known of Q and U after I, ``q`` and ``u`` were smoothed one by one."""
    covariance = np.full_like(before.covariance, np.nan)
    for row, product in zip((0, 3, 5), (i, q, u), strict=True):
        covariance[row] = product.noise**2
    halves = None
    if q.half_difference is not None and u.half_difference is not None:
        halves = np.stack([q.half_difference, u.half_difference])
    return replace(before, q=q.signal, u=u.signal, covariance=covariance, half_difference=halves)
