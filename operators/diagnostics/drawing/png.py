"""Write a figure as a PNG file, to the pixels of ``figure.savefig``."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

LEVEL = 2
"""Of zlib: higher ones save some per cent of the bytes and double the time."""


def png_of(ax: Any, dpi: float | None = None) -> bytes:
    """The figure of ``ax``, drawn once: without the rehearsal and the opaque alpha channel of
    ``figure.savefig``.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    if dpi is not None:
        ax.figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(ax.figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]  # type: ignore[no-untyped-call]
    return encoded(pixels, ax.figure.dpi, {"Software": "zonda"})


def encoded(pixels: NDArray[np.uint8], dpi: float, texts: dict[str, str]) -> bytes:
    """``pixels`` (ny, nx, 3) as a PNG file (ISO/IEC 15948). ``texts``: ASCII notes by keyword.

    Rows are not filtered: flat areas and text, of which these pictures are made, are smaller
    without, and quicker to pack.
    """
    ny, nx = pixels.shape[:2]
    rows = np.zeros(
        (ny, 1 + 3 * nx), np.uint8
    )  # a row begins with the number of its filter: 0, none
    rows[:, 1:].reshape(ny, nx, 3)[...] = pixels
    per_metre = round(dpi / 0.0254)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", nx, ny, 8, 2, 0, 0, 0))]
    chunks += [
        (b"tEXt", key.encode("ascii") + b"\0" + text.encode("ascii")) for key, text in texts.items()
    ]
    chunks += [
        (b"pHYs", struct.pack(">IIB", per_metre, per_metre, 1)),
        (b"IDAT", zlib.compress(rows.tobytes(), LEVEL)),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*chunk) for chunk in chunks)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
