"""Absorption cross-sections of air, interpolated in a table that was computed with am (see
data/README.md).

The table holds logarithms of cross-sections per molecule, averaged over cells of 0.5 GHz, on 28
pressures times 5 temperatures. It is read once, in a few hundredths of a second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from zonda.core.errors import InputError
from zonda.core.storage.files import own_data
from zonda.core.types import Floats, Indices

TABLE = Path(__file__).parent.parent / "data" / "absorption.npz"

MIXING_RATIO_HIGH = 0.02
"""Volume mixing ratio of the table's second water cross-section."""
OZONE_PARTS = np.array([2, 4, 8, 16, 34]) / 64
"""Shares of a cell, from ozone's most opaque frequencies down."""
RATIO_LOW, RATIO_HIGH = 1e-3, 64.0
"""Limits of the packed ratios of ozone's cross-section in these parts to the cell's mean."""
TEMPERATURE_MARGIN = 15.0
"""K by which a temperature may lie outside the table."""
PRESSURE_MARGIN = 1.3
"""Extrapolation above the highest pressure or below the lowest one, in steps of the table (a factor
0.72 each).
"""
THIN_AIR = 50.0
"""Pa: above this height air absorbs too little for its temperature to matter, and any temperature
is taken as the nearest that the table has. The air of a `Profile` ends below, at 75 Pa: only other
users of the table come here."""


@dataclass(frozen=True)
class CrossSections:
    """m2 per molecule, each (n_layer, n_frequency).

    Water's own pressure broadening makes its cross-section linear in the mixing ratio: ``water +
    mixing_ratio * water_self``. Ozone's lines are narrower than a cell: ``ozone_ratio`` (n_part,
    n_layer, n_frequency) is its cross-section in parts of the cell, `OZONE_PARTS`, over the cell's
    mean.
    """

    dry_air: Floats
    water: Floats
    water_self: Floats
    ozone: Floats
    ozone_ratio: Floats


class AbsorptionTable:
    """Absorption of air against frequency, pressure and temperature (`absorption_table` reads it).

    Attributes
    ----------
    frequency
        (n,) Hz, centres of the cells.
    pressure
        (n_pressure,) Pa, falling.
    temperature
        (n_pressure, n_temperature) K, rising along the second axis.
    """

    def __init__(self, path: Path) -> None:
        with own_data(path) as file:
            self._code = np.cumsum(file["difference"], axis=-1, dtype=np.uint16)
            self._low = file["low"].astype(np.float64)
            self._high = file["high"].astype(np.float64)
            self.frequency: Floats = file["frequency"].astype(np.float64)
            self.pressure: Floats = file["pressure"].astype(np.float64)
            self.temperature: Floats = file["temperature"].astype(np.float64)
            self._ozone_code = file["ozone_ratio"]

    @property
    def edges(self) -> Floats:
        """(n + 1,) Hz, edges of the cells."""
        half = (self.frequency[1] - self.frequency[0]) / 2
        return np.append(self.frequency - half, self.frequency[-1] + half)

    def cells(self, low: float, high: float, place: str = "") -> slice:
        """The cells that a frequency range in Hz touches.

        Raises
        ------
        InputError
            The range reaches outside the table; the message names its limits.
        """
        edges = self.edges
        if not edges[0] <= low < high <= edges[-1]:
            limits = f"{edges[0] / 1e9:g} to {edges[-1] / 1e9:g} GHz"
            raise InputError(
                f"{low / 1e9:g} to {high / 1e9:g} GHz is not inside the range of the absorption"
                f" table, {limits}",
                place=place,
                cure=f"keep the band within {limits}",
            )
        return slice(
            int(np.searchsorted(edges, low, "right")) - 1,
            int(np.searchsorted(edges, high, "left")),
        )

    def cross_sections(
        self,
        pressure: Floats,
        temperature: Floats,
        cells: slice = slice(None),
    ) -> CrossSections:
        """Cross-sections of layers at ``pressure`` [Pa] and ``temperature`` [K], both (n_layer,),
        in some cells.

        The logarithm is interpolated linearly in ln(pressure) and as a quartic in 1/temperature.

        Raises
        ------
        InputError
            A pressure or temperature outside the table; the message names the limits.
        """
        pressure = np.asarray(pressure, np.float64)
        temperature = np.asarray(temperature, np.float64)
        below, upper_weight = self._bracket(pressure)
        scale = (self._high - self._low)[..., cells] / 65535.0
        log = self._low[..., cells] + self._code[..., cells] * scale
        total = np.zeros((4, len(pressure), log.shape[-1]))
        for row, weight in ((below, 1 - upper_weight), (below + 1, upper_weight)):
            taps = self._temperature_weights(pressure, temperature, row) * weight
            for k, tap in enumerate(taps):
                total += tap[:, None] * log[:, row, k]
        dry, water, water_high, ozone = np.exp(total) * 1e-4
        # In the margins the ratios are those of the edge: their mean over a cell stays 1, its ozone
        # is what it is.
        code = self._ozone_code[..., cells]
        upper = np.clip(upper_weight, 0.0, 1.0)[:, None]
        log_ratio = code[:, below] * (1 - upper) + code[:, below + 1] * upper
        ratio = RATIO_LOW * np.exp(log_ratio * (math.log(RATIO_HIGH / RATIO_LOW) / 255))
        ratio /= np.einsum("g,glf->lf", OZONE_PARTS, ratio)
        return CrossSections(dry, water, (water_high - water) / MIXING_RATIO_HIGH, ozone, ratio)

    def _bracket(self, pressure: Floats) -> tuple[Indices, Floats]:
        """Index of the table's pressure below each layer, and the weight of the one above."""
        grid = -np.log(self.pressure)
        x = -np.log(pressure)
        step = grid[1] - grid[0]
        if (x < grid[0] - (PRESSURE_MARGIN - 1) * step).any():
            worst = pressure.max() / 100
            limit = self.pressure[0] / 100 * 0.72 ** (1 - PRESSURE_MARGIN)
            raise InputError(
                f"a pressure of {worst:.5g} hPa is above the absorption table's limit of"
                f" {limit:.5g} hPa"
            )
        below = np.clip(
            np.searchsorted(grid, x) - 1,
            0,
            len(grid) - 2,
        )  # the first and last step also serve the margins
        # Air thinner than the table's 0.13 hPa has the cross-sections of its edge; a `Profile` has
        # none, it ends at 0.75 hPa.
        return below, np.minimum((x - grid[below]) / step, PRESSURE_MARGIN)

    def _temperature_weights(
        self,
        pressure: Floats,
        temperature: Floats,
        row: Indices,
    ) -> Floats:
        """Lagrange weights in 1/temperature on the nodes of each layer's row. (n_temperature,
        n_layer).
        """
        nodes = self.temperature[row]
        low = nodes[:, 0] - TEMPERATURE_MARGIN
        high = nodes[:, -1] + TEMPERATURE_MARGIN
        outside = ((temperature < low) | (temperature > high)) & (pressure > THIN_AIR)
        if outside.any():
            k = int(np.argmax(outside))
            raise InputError(
                f"a temperature of {temperature[k]:.1f} K at {pressure[k] / 100:.4g} hPa is outside"
                f" the absorption table's limits there, {low[k]:.0f} to {high[k]:.0f} K"
            )
        x = 1 / np.clip(temperature, low, high)
        y = 1 / nodes
        n = nodes.shape[1]
        return np.array(
            [
                np.prod([(x - y[:, m]) / (y[:, k] - y[:, m]) for m in range(n) if m != k], axis=0)
                for k in range(n)
            ]
        )


@lru_cache(maxsize=1)
def absorption_table() -> AbsorptionTable:
    """The shipped table, read once."""
    return AbsorptionTable(TABLE)
