"""An image of the sky in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from astropy.io.fits import Header

    from zonda.core.storage.fits_image import Cards


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

    values: NDArray[np.float64]
    header: Cards | Header
    unit: str = "K_RJ"

    @property
    def wcs(self) -> Any:
        """The `astropy.wcs.WCS` of the header."""
        from astropy.wcs import WCS

        return WCS(self.header, naxis=2)
