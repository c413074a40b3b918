"""Emission and transmission above a pipeline's site for several PWVs, 1 to 1000 GHz, with the lines
named.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from zonda.operators.atmosphere.weather.sources import profile_of
from zonda.plugins.commands.weather_plots import plot_spectrum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from zonda.core.scene import Scene


def atmosphere_figure(scene: Scene) -> Figure:
    """A figure of the climatology's profile at the zenith of the scene's site and time, with the
    instrument's band.
    """
    from matplotlib.figure import Figure

    air = profile_of(None, scene.site, scene.time, 0)
    figure = Figure(figsize=(9, 8.5), dpi=110, layout="constrained")
    axes = figure.subplots(2)
    for ax, which in zip(axes, ("brightness", "transmission"), strict=True):
        plot_spectrum(ax, air, math.pi / 2, [scene.instrument.band], which)
    figure.legend(
        *axes[1].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=6,
        fontsize=8,
        frameon=False,
    )
    return figure
