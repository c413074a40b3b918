"""Each parameter of the sky operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.wcs import WCS

from zonda.core.errors import ZondaError

from ..parameters import Step, cases, ignored


def tangent(pixel: float) -> WCS:
    """About the scene's target, pixels in arcsec."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = (
        ["RA---TAN", "DEC--TAN"],
        [75.0, 20.0],
        [32.5, 32.5],
    )
    wcs.wcs.cdelt = [-pixel / 3600, pixel / 3600]
    return wcs


ARRAY: dict[str, Any] = {
    "file": None,
    "map": np.hypot(*np.indices((64, 64)) - 31.5) / 1e3,
    "wcs": tangent(3.0),
    "unit": "K_RJ",
}
"""A map that is no file."""

STEPS = (
    Step(
        "CMBSky",
        given={"spectrum": "theory.txt", "nside": 256, "scaling": "l(l+1)/2pi"},
        changes={
            "spectrum": ({}, {"spectrum": "flat.txt"}),
            "nside": ({}, {"nside": 512}),
            "realization": ({}, {"realization": 1}),
            "columns": ({"spectrum": "two.txt", "columns": "TT, EE"}, {"columns": "EE, TT"}),
            "unit": ({"spectrum": "flat.txt", "unit": "uK^2"}, {"unit": "K^2"}),
            "scaling": ({"unit": "uK^2"}, {"scaling": "none"}),
        },
    ),
    Step(
        "PointSources",
        given={"catalogue": "sources.csv"},
        changes={
            "catalogue": ({}, {"catalogue": "others.csv"}),
            "frequency": ({"catalogue": "sources.csv"}, {"frequency": "30 GHz"}),
            "scale": ({}, {"scale": 2.0}),
        },
    ),
    Step(
        "SkyMap",
        ignored=({"beam": "none", "fwhm": "9 arcsec"}, {"te": "8 keV"}),
        changes={
            "file": ({}, {"file": "flux.fits"}),
            "map": (ARRAY, {"map": 2 * ARRAY["map"]}),
            "wcs": (ARRAY, {"wcs": tangent(4.0)}),
            "unit": ({}, {"unit": "mK_CMB"}),
            "pixel_size": ({}, {"pixel_size": "4 arcsec"}),
            "centre": ({}, {"centre": "05h00m01s +20d00m00s"}),
            "input_beam": (
                {"file": "beam.fits", "input_beam": "9 arcsec"},
                {"input_beam": "12 arcsec"},
            ),
            "coordsys": ({"file": "sphere.fits"}, {"coordsys": "galactic"}),
            "plane": ({"file": "cube.fits", "plane": 1}, {"plane": 2}),
            "polarization_convention": (
                {"file": "iqu.fits", "polarization_convention": "cosmo"},
                {"polarization_convention": "iau"},
            ),
            "hdu": ({"file": "two.fits"}, {"hdu": "second"}),
            "column": ({"file": "fine.fits"}, {"column": "other"}),
            "beam": ({}, {"beam": "none"}),
            "fwhm": ({}, {"fwhm": "12 arcsec"}),
            "outside": ({"pixel_size": "1 arcsec"}, {"outside": "1 K"}),
            "missing": ({"file": "hole.fits", "missing": "zero"}, {"missing": "error"}),
            "scale": ({}, {"scale": 2.0}),
            "spectral_index": ({"file": "flux.fits"}, {"spectral_index": 3.0}),
            "pixels_per_fwhm": ({}, {"pixels_per_fwhm": 8.0}),
            "te": ({"unit": "y"}, {"te": "8 keV"}),
            "interpolation": ({}, {"interpolation": "linear"}),
        },
        refused={"missing": "NaN"},
        polarized=("polarization_convention",),
    ),
)


@pytest.mark.parametrize(("step", "field"), cases(STEPS))
def test_each_parameter_has_an_effect(
    step: Step, field: str, maps: Path, tmp_path: Path, known: dict[str, Any]
) -> None:
    step.check(field, maps, tmp_path, known)


@pytest.mark.parametrize(("step", "parameters"), ignored(STEPS))
def test_what_would_be_ignored_is_refused(
    step: Step, parameters: dict[str, Any], maps: Path
) -> None:
    with pytest.raises(ZondaError):
        step.made(maps, parameters)
