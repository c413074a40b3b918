"""Write a figure as a PDF or SVG file for print."""

from __future__ import annotations

import io
from typing import Any

LEAST_DPI = 300.0
"""Lowest resolution of images inside a page, dots per inch."""
SETTINGS = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "zonda"}
"""Text stays text: PDF carries its TrueType fonts, SVG names them. Names inside an SVG file do not
change from run to run.
"""
METADATA = {
    "pdf": {"Creator": "zonda", "Producer": "matplotlib", "CreationDate": None},
    "svg": {"Creator": "zonda", "Date": None},
}


def vector_of(ax: Any, kind: str, dpi: float) -> bytes:
    """The figure of ``ax`` as ``pdf`` or ``svg``; the same figure gives the same bytes."""
    from matplotlib import rc_context

    out = io.BytesIO()
    with rc_context(SETTINGS):  # type: ignore[arg-type]
        ax.figure.savefig(out, format=kind, dpi=max(dpi, LEAST_DPI), metadata=METADATA[kind])
    return out.getvalue()
