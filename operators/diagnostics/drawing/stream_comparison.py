"""Picture of two streams beside each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.drawable import Sketch

from .canvas import OTHER, SEQUENCE, log_labels, new_figure, write_title

if TYPE_CHECKING:
    from ..stream_statistics import StreamComparison


def draw_stream_comparison(file: str, found: StreamComparison) -> list[Sketch]:
    """Spectra, their ratio and the coherence."""
    spectra, ratio, coherence = new_figure(
        (7.2, 7.2), [(0.12, 0.52, 0.86, 0.43), (0.12, 0.29, 0.86, 0.21), (0.12, 0.07, 0.86, 0.20)]
    )
    f, (x, y, d) = found.frequency, found.power
    for row, label, colour in (
        (x, found.stream, "black"),
        (y, found.reference, SEQUENCE[0]),
        (d, "difference", SEQUENCE[1]),
    ):
        if np.isfinite(row).all() and (row > 0).any():
            spectra.loglog(
                f, np.where(row > 0, row, np.nan), color=colour, linewidth=1.1, label=label
            )
    spectra.set_ylabel("power spectral density [unit²/Hz]")
    spectra.legend(frameon=False, fontsize=9)
    positive = y > 0
    ratio.loglog(f[positive], x[positive] / y[positive], color="black", linewidth=0.9)
    gain = found.over_detectors("gain")[0]
    if np.isfinite(gain) and gain != 0:
        ratio.axhline(gain**2, color=OTHER, linestyle="--", linewidth=1.0)
    ratio.set_ylabel("ratio")
    coherence.semilogx(f, found.coherence, color="black", linewidth=0.9)
    coherence.axhline(1 / found.segments, color=OTHER, linestyle="--", linewidth=1.0)
    coherence.set_ylabel("coherence")
    coherence.set_ylim(0, 1.05)
    coherence.set_xlabel("frequency [Hz]")
    for ax in (spectra, ratio, coherence):
        _finish(ax, f, last=ax is coherence)
    write_title(spectra, f"{found.stream} and {found.reference}")
    return [Sketch(file, "Streams compared", _caption(found), spectra)]


def _finish(ax: Any, f: Any, last: bool) -> None:
    ax.set_xlim(f[0], f[-1])
    ax.grid(which="major", color="0.9", linewidth=0.7)
    log_labels(ax.xaxis, *ax.get_xlim())
    if ax.get_yscale() == "log":
        log_labels(ax.yaxis, *ax.get_ylim())
    if not last:
        ax.tick_params(labelbottom=False, which="both")


def _caption(found: StreamComparison) -> str:
    (r, scatter, error), (gain, _, gain_error) = (
        found.over_detectors(k) for k in ("correlation", "gain")
    )
    many = (
        f"{len(found.names)} detectors and {found.observations}"
        f" scan{'s' if found.observations > 1 else ''}"
    )
    return (
        f"Streams {found.stream} and {found.reference} at step {found.label}, mean of {many}: power"
        f" spectra on the calibrated sky, their ratio (dashed: gain², {gain:.4g} ±"
        f" {gain_error:.2g}) and the coherence (dashed: 1/n of independent streams, n ="
        f" {found.segments:.3g} segments). Correlation {r:.4f} ± {error:.2g} of one detector,"
        f" scatter over detectors {scatter:.2g}."
    )
