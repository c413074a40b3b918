"""Small scenes that several tests share."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def camera(detectors: int) -> str:
    """The top of a pipeline file: a camera of so many detectors that the 100 m dish at Green Bank points at (75, 20) deg."""
    return f"""\
site: green_bank
instrument:
  name: cam
  telescope: {{name: dish, diameter: 100 m}}
  band: {{name: b, low: 80 GHz, high: 100 GHz}}
  detectors: {detectors}
  field_of_view: 2 arcmin
  fwhm: 9 arcsec
  main_beam_efficiency: 0.3
  illumination_efficiency: 0.8
  net: 1 mK s(1/2)
  knee: 1 Hz
  sample_rate: 50 Hz
time: 2024-11-25T07:00
target: 05h00m00s +20d00m00s
seed: 1
"""


def write_sky(path: Path, side: int, pixel: float, rms: float) -> None:
    """A FITS map of ``side`` x ``side`` random pixels [K_RJ] of ``pixel`` degrees about (75, 20) deg."""
    from astropy.io import fits

    image = fits.PrimaryHDU(np.random.default_rng(0).standard_normal((side, side)) * rms)
    middle = (side + 1) // 2
    image.header.update({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": middle, "CRPIX2": middle, "CRVAL1": 75.0})
    image.header.update({"CRVAL2": 20.0, "CDELT1": -pixel, "CDELT2": pixel, "CUNIT1": "deg", "CUNIT2": "deg", "BUNIT": "K_RJ"})
    image.writeto(path)
