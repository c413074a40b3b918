"""The hits of each scan of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError


@dataclass
class ScanHits:
    """Pixels that each scan hit, and how often: a plane of hits for each, kept without its zeros.

    Attributes
    ----------
    scans
        Names, in the order of the map's `MapArrays.scans`.
    pixels, hits
        Of each scan, int32: places in the flat arrays of the map, in rising order, and the samples
        there.
    """

    scans: list[str]
    pixels: list[NDArray[np.int32]] = field(default_factory=list)
    hits: list[NDArray[np.int32]] = field(default_factory=list)

    def plane(self, scan: str | int, shape: Sequence[int]) -> NDArray[np.int32]:
        """The hits of one scan in arrays of ``shape``. Raises InputError for one that is not there,
        or a name of several.
        """
        number = scan
        if isinstance(scan, str):
            if self.scans.count(scan) != 1:
                text = f"{self.scans.count(scan)} scans of the map are called {scan!r}"
                raise InputError(
                    text, place="map.scan_hits", cure=f"give its number, 0 to {len(self.scans) - 1}"
                )
            number = self.scans.index(scan)
        if not 0 <= int(number) < len(self.scans):
            text = f"the map has {len(self.scans)} scans, and no number {number}"
            raise InputError(text, place="map.scan_hits", cure=f"choose 0 to {len(self.scans) - 1}")
        found = np.zeros(int(np.prod(shape)), np.int32)
        found[self.pixels[int(number)]] = self.hits[int(number)]
        return found.reshape(shape)

    @property
    def table(self) -> dict[str, NDArray[np.int32]]:
        """Columns ``SCAN`` (its number), ``PIXEL`` and ``HITS``, a row for each pixel of each
        scan.
        """
        number = np.repeat(
            np.arange(len(self.scans), dtype=np.int32), [len(some) for some in self.pixels]
        )
        none = np.zeros(0, np.int32)
        return {
            "SCAN": number,
            "PIXEL": np.concatenate([none, *self.pixels]),
            "HITS": np.concatenate([none, *self.hits]),
        }
