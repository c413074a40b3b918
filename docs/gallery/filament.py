"""A dust filament, polarized across its length: I, Q and U in filament.fits."""

import numpy as np
from astropy.io import fits

side, pixel = 160, 15.0 / 3600  # degrees
south, east = np.meshgrid(np.linspace(1, -1, side), np.linspace(1, -1, side), indexing="ij")
south = south - 0.35 * np.sin(2.5 * east)  # it is bent
slope = -0.35 * 2.5 * np.cos(2.5 * east)
brightness = 3.0 * np.exp(-((south / 0.09) ** 2)) + 0.6 * np.exp(-((south / 0.3) ** 2))  # MJy/sr
across = np.arctan(slope)  # the normal of the filament, from south to east
planes = [
    brightness,
    0.15 * brightness * np.cos(2 * across),
    0.15 * brightness * np.sin(2 * across),
]
header = fits.Header(
    {
        "BUNIT": "MJy/sr",
        "CTYPE3": "STOKES",
        "CRVAL3": 1,
        "CRPIX3": 1,
        "CDELT3": 1,
        "POLCCONV": "COSMO",
    }
)
header.update(
    CTYPE1="RA---TAN", CTYPE2="DEC--TAN", CRVAL1=75.0, CRVAL2=-30.0, CDELT1=-pixel, CDELT2=pixel
)
header.update(CRPIX1=(side + 1) / 2, CRPIX2=(side + 1) / 2)
fits.writeto("filament.fits", np.array(planes, np.float32), header, overwrite=True)
