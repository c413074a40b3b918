"""How files name Stokes parameters: columns, extensions, and planes along an axis STOKES."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

_NAMES = {1: "I", 2: "Q", 3: "U", 4: "V"}
"""Values of a FITS axis STOKES (Greisen & Calabretta 2002); those below zero are correlations."""
_POLARIZED = re.compile(r"(STOKES[ _-]?)?[QUV]([ _-].*)?", re.IGNORECASE)
"""Names of columns and extensions: Q_POLARISATION (healpy), Q_STOKES (Planck), STOKES_Q, Q."""


def is_polarized(name: str) -> bool:
    """Whether a column or an extension of this name holds Q, U or V."""
    return _POLARIZED.fullmatch(name.strip()) is not None


def columns_of_q_and_u(names: Sequence[str]) -> list[int] | None:
    """Which of the columns or extensions of these names hold Q and U; None where they are not both there."""
    letters = [_letter(name) for name in names]
    return [letters.index("Q"), letters.index("U")] if {"Q", "U"} <= set(letters) else None


def along_axis(header: Any, axis: int, length: int) -> list[str]:
    """What each plane along the FITS axis STOKES is."""
    first, step, pixel = (float(header.get(f"{key}{axis}", 1.0)) for key in ("CRVAL", "CDELT", "CRPIX"))
    return [_NAMES.get(round(first + (n + 1 - pixel) * step), "a correlation") for n in range(length)]


def _letter(name: str) -> str:
    return re.sub(r"^STOKES[ _-]?", "", name.strip().upper())[:1] if is_polarized(name) else ""
