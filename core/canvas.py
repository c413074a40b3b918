"""Matplotlib figures without pyplot: colours, labels and files that all pictures share.

matplotlib is imported inside functions: no window system is needed and no global state is touched.
Colours are told apart by colour-blind eyes (Okabe & Ito 2008), and brightness scales are
perceptually ordered.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np


@dataclass(frozen=True)
class Sketch:
    """Picture that is drawn but not printed: ``name`` without suffix, a title, what it shows, one
    of its matplotlib Axes.
    """

    name: str
    title: str
    caption: str
    ax: Any


@runtime_checkable
class Drawable(Protocol):
    """Product with pictures of its own."""

    def sketches(self, name: str) -> list[Sketch]:
        """Pictures whose names begin with ``name``, on matplotlib figures that belong to nobody
        else (not to pyplot).
        """


COLOURS = {
    "signal": "#000000",
    "atmosphere": "#0072B2",
    "pink": "#CC79A7",
    "white": "#999999",
    "sky": "#D55E00",
    "transmission": "#009E73",
}
OTHER = "#56B4E9"
SEQUENCE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
PALE = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0}
"""Box behind text that lies on lines."""

DPI = 110
LEAST_DPI = 300.0
"""Lowest resolution of images within PDF and SVG files, dots per inch."""
SETTINGS = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "zonda"}
"""Text stays text: PDF carries its TrueType fonts, SVG names them. Names inside an SVG file do not
change from run to run.
"""
METADATA = {
    "png": {"Software": "zonda"},
    "pdf": {"Creator": "zonda", "Producer": "matplotlib", "CreationDate": None},
    "svg": {"Creator": "zonda", "Date": None},
}


def new_axes(size: tuple[float, float] = (7.2, 5.0), above: float = 0.45, **grid: Any) -> Any:
    """Axes of a new figure of ``size`` [in] that is not pyplot's.

    Margins are fixed: matplotlib's own layout draws everything twice. ``above``: room for the
    title, and for a second axis below it, in. ``grid`` is passed to `Figure.subplots`, which
    returns an array of Axes for several of them.
    """
    from matplotlib.figure import Figure

    width, height = size
    figure = Figure(figsize=size, dpi=DPI)
    figure.subplots_adjust(0.85 / width, 0.6 / height, 1 - 0.25 / width, 1 - above / height)
    return figure.subplots(**grid)


def new_figure(title: str, size: tuple[float, float], notebook: bool = False) -> Any:
    """Figure of ``size`` [in] that matplotlib lays out, for axes of a known content; for a
    ``notebook`` one of pyplot, which is shown there.
    """
    style: dict[str, Any] = {"figsize": size, "dpi": DPI, "layout": "constrained"}
    if notebook:
        from matplotlib import pyplot as plt

        figure: Any = plt.figure(**style)
    else:
        from matplotlib.figure import Figure

        figure = Figure(**style)
    if title:
        figure.suptitle(title)
    return figure


def shown_axes(ax: Any, size: tuple[float, float] = (7.2, 4.2)) -> Any:
    """``ax``; where it is None, axes of a new figure that notebooks show."""
    return new_figure("", size, notebook=True).subplots() if ax is None else ax


def finish(ax: Any, across: str, up: str, title: str = "", **legend: Any) -> None:
    """Name the axes, draw a grid, label logarithmic axes, and add a legend where ``legend`` says
    how.
    """
    ax.set_xlabel(across)
    ax.set_ylabel(up)
    ax.set_title(title, wrap=True)
    ax.grid(which="major", color="0.9", linewidth=0.7)
    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            log_labels(axis)
    if legend:
        ax.legend(**{"frameon": False, "fontsize": 8} | legend)


def wide_legend(ax: Any, **style: Any) -> None:
    """A legend whose lines are wide enough for their colours to be told apart."""
    for line in ax.legend(fontsize=8, **style).get_lines():
        line.set_linewidth(2)


def axis_above(ax: Any, product: float, name: str) -> None:
    """Add a second, logarithmic axis on top: ``product`` divided by the values of the first."""

    def inverse(values: Any) -> Any:
        with np.errstate(divide="ignore"):
            return product / np.asarray(values, np.float64)

    upper = ax.secondary_xaxis("top", functions=(inverse, inverse))
    upper.set_xlabel(name)
    log_labels(upper.xaxis)


def file_of(figure: Any, kind: str, dpi: float = DPI) -> bytes:
    """A figure as a ``png``, ``pdf`` or ``svg`` file; the same figure gives the same bytes."""
    from matplotlib import rc_context

    out = io.BytesIO()
    fast = {"pil_kwargs": {"compress_level": 2}} if kind == "png" else {}
    dpi = dpi if kind == "png" else max(dpi, LEAST_DPI)
    with rc_context(SETTINGS):  # type: ignore[arg-type]
        figure.savefig(out, format=kind, dpi=dpi, metadata=METADATA[kind], **fast)
    return out.getvalue()


def unit_of(peak: float) -> tuple[float, str]:
    """Factor and name of the unit in which a brightness of ``peak`` kelvin reads well."""
    for factor, name in ((1e6, "µK"), (1e3, "mK")):
        if peak * factor < 3e3:
            return factor, name
    return 1.0, "K"


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _power_of_ten(value: float) -> str:
    power = int(np.floor(np.log10(value) + 1e-9))
    mantissa = f"{value / 10.0**power:.3g}"
    return f"{'' if mantissa == '1' else mantissa + ' · '}10{str(power).translate(_RAISED)}"


def log_labels(axis: Any) -> None:
    """Label the powers of ten of an axis, and 2 and 5 of each where there are few."""

    def text(value: float, minor: bool) -> str:
        low, high = sorted(axis.get_view_interval())
        few = 0 < low < high < 160 * low
        if value <= 0 or (minor and not (few and f"{value:.0e}"[0] in "25")):
            return ""
        return f"{value:.6g}" if low > 1e-3 and high < 1e5 else _power_of_ten(value)

    axis.set_major_formatter(lambda value, _: text(value, minor=False))
    axis.set_minor_formatter(lambda value, _: text(value, minor=True))
    axis.set_tick_params(which="minor", pad=5)  # as far away as labels of the longer marks
