"""Excess path length of water vapour, for phase screens.

    delay = Pi PWV,    Pi = 1e-6 rho R_v (k_3 / T_m + k_2'),    T_m = int rho_v dz / int (rho_v / T) dz              (1)

with rho the density of water, R_v the gas constant of vapour, k_2' = 22.1 K/hPa and k_3 = 3.739e5 K2/hPa (Bevis et al. 1994, J.
Appl. Meteor. 33, 379, after Thayer). Pi is 6.4 at T_m = 273 K and falls with temperature, 0.35 % per K. It holds for radio
waves far from water lines; dispersion in the submillimetre windows (some per cent, more beside 557 GHz) is not in it.
"""

from __future__ import annotations

from zonda.core.types import Floats

WATER_DENSITY = 1000.0  # kg / m3
VAPOUR_GAS_CONSTANT = 461.52  # J / (kg K)
K2 = 0.221  # K / Pa
K3 = 3739.0  # K2 / Pa


def delay_per_vapour(temperature: Floats, weights: Floats) -> float:
    """Pi of equation (1) for vapour at temperatures [K] with weights (any unit)."""
    mean = float(weights.sum() / (weights / temperature).sum())
    return 1e-6 * WATER_DENSITY * VAPOUR_GAS_CONSTANT * (K3 / mean + K2)
