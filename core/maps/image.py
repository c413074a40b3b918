"""An image of the sky in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..types import Floats

if TYPE_CHECKING:
    from astropy.io.fits import Header

    from ..storage.fits_image import Cards


@dataclass
class Image:
    """A pixelized brightness with its world coordinates.

    Attributes
    ----------
    values
        (ny, nx) float64, NaN where nothing is known; row 0 is the FITS file's first row.
    header
        FITS keywords with a two-dimensional celestial WCS; a dict that `astropy.io.fits.Header` takes.
    unit
        Unit of ``values``, e.g. ``K_RJ``.
    """

    values: Floats
    header: Cards | Header
    unit: str = "K_RJ"

    @property
    def wcs(self) -> Any:
        """The `astropy.wcs.WCS` of the header."""
        from astropy.wcs import WCS

        return WCS(self.header, naxis=2)

    def plot(self, ax: Any = None, *, title: str = "", limit: float | None = None) -> Any:
        """Draw it; the matplotlib Axes. ``limit``: where the colours end; default: what 99.5 % of the pixels stay below."""
        from .picture import Shown, draw

        return draw(Shown(self.values, self.wcs, self.unit, title), ax, limit)
