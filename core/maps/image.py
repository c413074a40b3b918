"""An image of the sky in memory."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..numerics.projection import pixel_matrix, wcs_frame_rotation
from ..polarization import between_meridians, turned_by
from ..types import Floats

if TYPE_CHECKING:
    from astropy.io.fits import Header

ROWS = 256
"""Of an image whose Q and U are turned at a time."""


@dataclass(repr=False)
class Image:
    """A pixelized brightness with its world coordinates.

    Attributes
    ----------
    values
        (ny, nx) float64, NaN where nothing is known; row 0 is the FITS file's first row.
    header
        FITS keywords with a two-dimensional celestial WCS.
    unit
        Unit of ``values``, e.g. ``K_RJ``.
    polarization, axis
        (2, ny, nx) Q and U beside them, COSMO, from the meridians through the ICRS direction
        ``axis`` (3,); `stokes` turns them to those of the image's frame. None: there are none.
    """

    values: Floats
    header: Header
    unit: str = "K_RJ"
    polarization: Floats | None = None
    axis: Floats | None = None

    def __repr__(self) -> str:
        rows, columns = self.values.shape
        return f"<Image {columns} x {rows}, {self.unit}>"

    def stokes(self, which: str, pole: Floats | None = None) -> Image:
        """I, Q or U as an image of its own, COSMO, from the meridians of its frame; NaN where I is.

        ``pole``: from those through this ICRS direction (3,) instead.

        Raises InputError for an image without Q and U, and for other names.
        """
        if self.polarization is None or self.axis is None:
            raise InputError(
                "the image has no Q and U",
                place="image.stokes",
                cure="give a map of I, Q and U",
            )
        if which not in ("I", "Q", "U"):
            raise InputError(
                f"{which!r} is none of I, Q and U",
                place="image.stokes",
                cure="write image.stokes('Q')",
            )
        plain = replace(self, polarization=None, axis=None)
        if which == "I":
            return plain
        to = wcs_frame_rotation(self.wcs)[2] if pole is None else pole
        return replace(
            plain,
            values=_turned(self.polarization, (self.axis, to), self, "QU".index(which)),
        )

    @property
    def fwhm(self) -> float:
        """Its resolution [rad] by BMAJ; 0 without: pixels are points of the sky before any beam."""
        return math.radians(float(self.header.get("BMAJ") or 0.0))

    @property
    def wcs(self) -> Any:
        """The `astropy.wcs.WCS` of the header."""
        from astropy.wcs import WCS

        return WCS(self.header, naxis=2)

    def plot(self, ax: Any = None, *, title: str = "", limit: float | None = None) -> Any:
        """Draw the image, and return the matplotlib Axes: ``ax``, or axes of the sky in place of
        plain ones. ``limit``: where the colours end; default: what 99.95 % of the pixels stay
        below.
        """
        from .map_plots import notebook_axes, plot_map

        ax = notebook_axes(self.values.shape, self.wcs) if ax is None else ax
        return plot_map(self.values, self.wcs, ax=ax, title=title, limit=limit, unit=self.unit)


def _turned(q_and_u: Floats, poles: tuple[Floats, Floats], image: Image, number: int) -> Floats:
    """Q or U (ny, nx), which stand to meridians through the first of the ``poles``, from those
    through the second.
    """
    to_sky, (axis, pole) = np.linalg.inv(pixel_matrix(image.wcs)), poles
    found: Floats = np.empty_like(image.values, np.float64)
    for start in range(0, len(found), ROWS):
        rows = slice(start, start + ROWS)
        y, x = np.indices(found[rows].shape, np.float64)
        rays = np.stack([x, y + start, np.ones_like(x)], axis=2) @ to_sky.T
        turn = between_meridians(rays / np.linalg.norm(rays, axis=2, keepdims=True), axis, pole)
        found[rows] = turned_by(q_and_u[:, rows], turn)[number]
    return np.where(np.isfinite(image.values), found, np.nan)
