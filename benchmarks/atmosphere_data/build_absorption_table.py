"""Make `operators/atmosphere/data/absorption.npz`: cross-sections of dry air, water vapour and
ozone from am.

Needs `pip install am-python==0.8.0` (Linux x86_64; am 14.0 by S. Paine, SAO) at development time
only. About 4 minutes of CPU:

    python benchmarks/atmosphere_data/build_absorption_table.py
    operators/atmosphere/data/absorption.npz

Each entry is a single-layer am model at one pressure and temperature, its opacity divided by the
column density. Water is computed at a vanishing and at a high mixing ratio, because its
self-broadening makes the cross-section linear in the mixing ratio;
`zonda.operators.atmosphere.weather.absorption` interpolates. The monochromatic opacity is averaged
in cells of 0.5 GHz.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

AVOGADRO, GRAVITY, DRY_AIR, WATER = 6.02214076e23, 9.80665, 28.964e-3, 18.015e-3
"""1/mol, m/s2, kg/mol, kg/mol (am's own gravity and molar masses)."""

PRESSURE = 1050.0 * 0.72 ** np.arange(28)
"""hPa, from below sea level to 62 km."""
TEMPERATURE_OFFSETS = np.array([-60.0, -30.0, 0.0, 25.0, 50.0])
"""K, about the US Standard Atmosphere 1976 (8 K below it under 500 hPa, where high dry sites are
cold).
"""
CELL, LOWEST, HIGHEST = 0.5, 1.0, 1000.0
"""GHz: width of the frequency cells, first and last cell centre."""
OZONE_PARTS = (2, 4, 8, 16, 34)
"""Sixty-fourths of a cell, from the most opaque ones down: ozone's lines are narrower than cells
and saturate low in the sky.
"""
RATIO_LOW, RATIO_HIGH = 1e-3, 64.0
"""Limits of the packed ratios."""
WATER_LOW, WATER_HIGH, OZONE = 1e-5, 0.02, 1e-6
"""Volume mixing ratios of the single-layer models."""


def standard_temperature(pressure: float) -> float:
    """US Standard Atmosphere 1976 at a pressure in hPa, K (geopotential layers up to 71 km)."""
    base_pressure = np.array(
        [1013.25, 226.3206, 54.7489, 8.680187, 1.109063, 0.6693887, 0.03956420]
    )
    base_temperature = np.array([288.15, 216.65, 216.65, 228.65, 270.65, 270.65, 214.65])
    lapse = np.array([-6.5e-3, 0.0, 1.0e-3, 2.8e-3, 0.0, -2.8e-3, -2.0e-3])
    k = max(int(np.searchsorted(-base_pressure, -pressure)) - 1, 0)
    exponent = -8.31446 * lapse[k] / (GRAVITY * 28.9644e-3)
    return float(base_temperature[k] * (pressure / base_pressure[k]) ** exponent)


def molecules(pressure: float, mixing_ratio: float = 0.0) -> float:
    """Molecules per cm2 above a pressure in hPa in hydrostatic balance."""
    mass = DRY_AIR * (1 - mixing_ratio) + WATER * mixing_ratio
    return pressure * 100 / GRAVITY / mass * AVOGADRO * 1e-4


def cell_opacity(
    pressure: float, temperature: float, column: str, step: float
) -> NDArray[np.float64]:
    """Opacity of one layer, averaged over every cell with the trapezium rule at ``step`` GHz."""
    fine = fine_opacity(pressure, temperature, column, step)
    return fine.mean(axis=1)


def fine_opacity(
    pressure: float, temperature: float, column: str, step: float
) -> NDArray[np.float64]:
    """(cell, part) opacity of one layer in parts of ``step`` GHz of every cell."""
    import am

    first, last = LOWEST - CELL / 2, HIGHEST + CELL / 2
    model = (
        f"f {first:.6f} GHz {last:.6f} GHz {step} GHz\noutput f GHz tau neper\ntol 1e-4\nT0 0 K\n"
        f"layer\nPbase {pressure:.6g} mbar\nTbase {temperature:.4f} K\n{column}\n"
    )
    handle, path = tempfile.mkstemp(suffix=".amc")
    os.write(handle, model.encode())
    os.close(handle)
    run = am.Model(path, [])
    run.compute()
    os.unlink(path)
    tau = np.asarray(run._inner.raw_outputs["opacity"])
    cells, per_cell = round((HIGHEST - LOWEST) / CELL) + 1, round(CELL / step)
    tau = tau[np.argmin(abs(np.asarray(run.frequency) - first)) :][: cells * per_cell + 1]
    low, high = tau[:-1].reshape(cells, per_cell), tau[1:].reshape(cells, per_cell)
    return (low + high) / 2


def cross_sections(pressure: float, temperature: float) -> NDArray[np.float64]:
    """(4, cells) cm2 per molecule: dry air, water at vanishing mixing ratio, water at `WATER_HIGH`,
    ozone.
    """
    step = CELL / (4 if pressure >= 80 else 16 if pressure >= 10 else 64)
    dry = cell_opacity(pressure, temperature, "column dry_air hydrostatic", step) / molecules(
        pressure
    )
    low, high = (
        cell_opacity(pressure, temperature, f"column h2o hydrostatic {w}", step)
        / (molecules(pressure, w) * w)
        for w in (WATER_LOW, WATER_HIGH)
    )
    ozone = cell_opacity(pressure, temperature, f"column o3 hydrostatic {OZONE}", step) / (
        molecules(pressure, OZONE) * OZONE
    )
    slope = (high - low) / (WATER_HIGH - WATER_LOW)
    return np.array([dry, low - WATER_LOW * slope, high, ozone])


def ozone_ratios(temperature: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(part, pressure, cell) ozone's cross-section in parts of a cell over its mean there,
    logarithm in 1/255 of the range.

    The parts hold the same frequencies at all pressures: those sorted by the opacity of the
    standard atmosphere's ozone.
    """
    from zonda.operators.atmosphere.weather.air import ozone

    column = f"column o3 hydrostatic {OZONE}"
    fine = np.array(
        [
            fine_opacity(p, t, column, CELL / 64) / p
            for p, t in zip(PRESSURE, temperature, strict=True)
        ]
    )
    amount = ozone(PRESSURE * 100) * PRESSURE  # per step of the logarithm of pressure
    order = np.argsort(-np.einsum("p,pcs->cs", amount, fine), axis=1)
    fine = np.take_along_axis(fine, order[None], axis=2) / fine.mean(axis=2, keepdims=True)
    starts = np.concatenate([[0], np.cumsum(OZONE_PARTS)[:-1]])
    ratio = np.add.reduceat(fine, starts, axis=2) / np.array(OZONE_PARTS)
    share = np.log(np.clip(ratio, RATIO_LOW, RATIO_HIGH) / RATIO_LOW) / np.log(
        RATIO_HIGH / RATIO_LOW
    )
    return np.round(share * 255).astype(np.uint8).transpose(2, 0, 1)


def pack(cross_section: NDArray[np.float64]) -> dict[str, NDArray[np.generic]]:
    """Logarithms (4, pressure, temperature, cell) as uint16 between each cell's extremes,
    differenced along frequency.
    """
    log = np.log(np.maximum(cross_section, 1e-40))
    low, high = log.min(axis=(1, 2), keepdims=True), log.max(axis=(1, 2), keepdims=True)
    code = np.round((log - low) / (high - low) * 65535).astype(np.uint16)
    difference = np.diff(code, axis=-1, prepend=np.uint16(0)).astype(np.uint16)
    return {
        "difference": difference,
        "low": low.astype(np.float32),
        "high": high.astype(np.float32),
    }


def main(path: Path) -> None:
    """Compute the table on all processors and write it."""
    temperature = np.array(
        [standard_temperature(p) - (8 if p > 500 else 0) + TEMPERATURE_OFFSETS for p in PRESSURE]
    )
    states = [(p, t) for p, row in zip(PRESSURE, temperature, strict=True) for t in row]
    with multiprocessing.Pool() as pool:
        table = np.array(pool.starmap(cross_sections, states, chunksize=5))
    table = table.reshape(len(PRESSURE), len(TEMPERATURE_OFFSETS), 4, -1).transpose(2, 0, 1, 3)
    frequency = LOWEST + CELL * np.arange(table.shape[-1])
    axes = {"pressure": PRESSURE * 100, "temperature": temperature, "frequency": frequency * 1e9}
    np.savez_compressed(path, **axes, **pack(table), ozone_ratio=ozone_ratios(temperature[:, 2]))
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
