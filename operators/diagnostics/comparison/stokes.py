"""I, Q and U of maps that are compared: each plane for itself, Q and U of both from the meridians
of one frame.

Where the frames differ, Q and U of the reference are turned on its own pixels, before anything is
smoothed or interpolated:

    Q' + i U' = (Q + i U) exp(-2 i delta),   (1)

delta the angle from the meridian of its own frame to that of the map's
(`core.polarization.between_meridians`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.planes import IQU
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import Floats

from .files import plane_of
from .planes import Plane

NORTH = np.array([0.0, 0.0, 1.0])
SAME = 1e-12
"""1 - cos of the angle between poles that count as one."""


def products_of(
    product: MapProduct | Image, name: str
) -> dict[str, tuple[str, MapProduct | Image]]:
    """(name, product) of I, and of Q and U where there are some: ``name``, ``name_Q``,
    ``name_U``.
    """
    if product.polarization is None:
        return {"I": (name, product)}
    return {
        plane: (name if plane == "I" else f"{name}_{plane}", product.stokes(plane)) for plane in IQU
    }


def planes_of(product: MapProduct | Image, name: str) -> dict[str, Plane]:
    """The planes of a product of a run, with their noise."""
    return {
        plane: plane_of(one, its_name)
        for plane, (its_name, one) in products_of(product, name).items()
    }


def on_meridians_of(other: Plane, planes: Mapping[str, Plane]) -> dict[str, Plane]:
    """The planes with Q and U from the meridians of another map's frame, equation (1); as they are
    where it is their own.

    The covariance of Q and U counts as 0 in their noise.
    """
    if "Q" not in planes:
        return dict(planes)
    q, u = planes["Q"], planes["U"]
    pole = q.grid.turn @ other.grid.turn[2]
    if 1 - float(pole @ NORTH) < SAME:
        return dict(planes)
    turn = between_meridians(q.grid.directions(), NORTH, pole)
    values, alone = (_turned(turn, a, b) for a, b in ((q.values, u.values), (q.alone, u.alone)))
    noise: list[Floats | None] = [None, None]
    if q.noise is not None and u.noise is not None:
        noise = [
            np.hypot(turn.real * a, turn.imag * b)
            for a, b in ((q.noise, u.noise), (u.noise, q.noise))
        ]
    q = replace(q, values=values[0], noise=noise[0], alone=alone[0])
    u = replace(u, values=values[1], noise=noise[1], alone=alone[1])
    return {**planes, "Q": q, "U": u}


def _turned(turn: Any, q: Floats | None, u: Floats | None) -> Any:
    return (None, None) if q is None or u is None else turned_by(np.stack([q, u]), turn)
