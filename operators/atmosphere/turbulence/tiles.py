"""Tiles of the layers' spline coefficients, kept up to `BYTES_KEPT`."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import Future

from .lattice import Turbulence, coefficients
from .levels import Field

_Key = tuple[int, tuple[int, ...], tuple[int, int, int, int]]

APRON = 3
"""Cells by which tiles overlap."""

BYTES_KEPT = 512 << 20
"""Memory of the tiles that are kept."""


class Tiles:
    """The coefficients of several layers, as many as `BYTES_KEPT` allow. Safe for threads."""

    def __init__(self) -> None:
        self._kept: dict[_Key, tuple[Field, int]] = {}
        self._making: dict[_Key, Future[tuple[Field, int]]] = {}
        self._lock = threading.Lock()
        self._free = BYTES_KEPT

    def get(self, fields: Mapping[int, Turbulence], layer: int, box: tuple[int, int, int, int]) -> tuple[Field, int]:
        """Coefficients of a layer and their address: of the cells low <= i < high, low <= j < high of a box, with the apron.

        (len(fields), rows, cells in a row): of the ``fields`` of some bands, by number.
        """
        key = (layer, tuple(fields), box)
        kept = self._kept.get(key)
        if kept is not None:
            return kept
        with self._lock:
            kept = self._kept.get(key)
            if kept is not None:
                return kept
            mine = key not in self._making
            making = self._making.setdefault(key, Future())
        if not mine:
            return making.result()
        try:
            a, b, c, d = box
            tile = coefficients([*fields.values()], a, b + APRON, c, d + APRON)
            made = tile, tile.ctypes.data
        except BaseException as error:
            making.set_exception(error)
            with self._lock:
                del self._making[key]
            raise
        with self._lock:
            self._free -= tile.nbytes
            while self._free < 0 and self._kept:  # the oldest goes first; a thread that works with it still holds it
                self._free += self._kept.pop(next(iter(self._kept)))[0].nbytes
            self._kept[key] = made
            del self._making[key]
        making.set_result(made)
        return made
