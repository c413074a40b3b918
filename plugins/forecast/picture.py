"""The picture of `zonda sensitivity`: depth against time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.canvas import COLOURS, DPI
from zonda.core.numerics.angles import ARCMIN

from .depth import PARTS
from .lines import prefixed

if TYPE_CHECKING:
    from .result import Forecast

PART_COLOURS = {
    "white": COLOURS["white"],
    "1/f": COLOURS["pink"],
    "atmosphere": COLOURS["atmosphere"],
}
NAMES = {"white": "white noise", "1/f": "1/f noise", "atmosphere": "atmosphere (indicative)"}


def figure(found: Forecast) -> Any:
    """Depth against time, all noise and its parts, with bands of their stated errors: a matplotlib
    figure, not pyplot's.
    """
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(7.2, 5.0), dpi=DPI, layout="constrained")
    ax = drawn.subplots()
    low, high = found.times.min(), found.times.max()
    end = float(found.depth.seconds[-1])
    t = np.unique(
        np.r_[np.geomspace(low, high, 200), found.depth.seconds[(found.depth.seconds > low)]]
    )
    factor, unit = prefixed(float(found.depth.total(found.seconds)), "K_RJ")
    hours = t / 3600
    for part in PARTS:
        values = found.depth.part(part, t) * factor
        if part not in found.depth.known or not values.any():
            continue
        error, colour = found.depth.error[part], PART_COLOURS[part]
        ax.fill_between(
            hours, values * (1 - error), values * (1 + error), color=colour, alpha=0.2, lw=0
        )
        ax.plot(hours, values, color=colour, lw=1.4, label=NAMES[part])
    total = found.depth.total(t) * factor
    inside = t <= end * (1 + 1e-9)
    ax.plot(hours[inside], total[inside], color="black", lw=2, label="together")
    ax.plot(
        hours[~inside],
        total[~inside],
        color="black",
        lw=2,
        ls="--",
        label="together, as time$^{-1/2}$",
    )
    for plane, depth in found.polarization.items():
        ax.plot(
            hours,
            depth.total(t) * factor,
            color="black",
            lw=1.2,
            ls="-." if plane == "Q" else ":",
            label=f"{plane}, together",
        )
    if found.audit is not None and (row := found.audit.together):
        ax.errorbar(
            end / 3600,
            row.mean * factor,
            row.error * factor,
            fmt="o",
            color="#D55E00",
            label=f"{row.seeds} simulations",
        )
    ax.set_xscale("log")
    ax.set_yscale("log")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    ax.set_xlabel("integration time [h]")
    kelvin = unit.replace("u", "µ").replace("K_RJ", "K$_\\mathrm{RJ}$")
    ax.set_ylabel(f"rms behind the beam [{kelvin}]")
    ax.grid(alpha=0.25, lw=0.5, which="both")
    ax.legend(frameon=False)
    ax.set_title(
        f"{found.file.header.name}: {found.camera}, circle of radius {found.radius / ARCMIN:.3g}′",
        fontsize=10,
    )
    return drawn
