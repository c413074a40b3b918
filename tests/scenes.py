"""Small scenes that several tests share, and what several do with them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from zonda.core.data import Block
from zonda.core.flags import DEAD, OPAQUE, SUN_UP
from zonda.core.operator import Operator


def skip_without(package):
    """Skip the tests of a file where an optional package is not installed;
    ``ZONDA_<PACKAGE>=required`` lets them fail.
    """
    if os.environ.get(f"ZONDA_{package.upper()}") != "required":
        pytest.importorskip(
            package,
            reason=f"{package} is not installed: .ci/{package} makes an environment with it",
        )


class Marks(Operator):
    """Flags a dead and an opaque detector and opaque samples, as CommonModeFilter and Efficiency
    do; the Sun, which is used.
    """

    def prepare(self, observation):
        observation.detector_flags[[1, 5]] |= np.array([DEAD, OPAQUE], np.uint8)
        observation.flags[400:437] |= OPAQUE
        observation.flags[420:600] |= SUN_UP


def camera(detectors: int) -> str:
    """The top of a pipeline file: a camera of so many detectors that the 100 m dish at Green Bank
    points at (75, 20) deg.
    """
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
    """A FITS map of ``side`` x ``side`` random pixels [K_RJ] of ``pixel`` degrees about (75, 20)
    deg.
    """
    from astropy.io import fits

    image = fits.PrimaryHDU(np.random.default_rng(0).standard_normal((side, side)) * rms)
    middle = (side + 1) // 2
    image.header.update(
        {
            "CTYPE1": "RA---TAN",
            "CTYPE2": "DEC--TAN",
            "CRPIX1": middle,
            "CRPIX2": middle,
            "CRVAL1": 75.0,
        }
    )
    image.header.update(
        {
            "CRVAL2": 20.0,
            "CDELT1": -pixel,
            "CDELT2": pixel,
            "CUNIT1": "deg",
            "CUNIT2": "deg",
            "BUNIT": "K_RJ",
        }
    )
    image.writeto(path)


def in_blocks(step, observation, data, streams, means=None, sizes=(16,)):
    """The products of a step of one scan whose ``streams`` (n_det, n_samp) come in blocks of
    ``sizes`` detectors and the rest.
    """
    state = step.prepare(observation)
    first = 0
    for size in [*sizes, observation.n_detectors]:
        last = min(first + size, observation.n_detectors)
        if last > first:
            part = {k: v[first:last] for k, v in streams.items()}
            step.exec(
                Block(
                    observation,
                    slice(first, last),
                    slice(0, observation.n_samples),
                    part,
                    means or {},
                ),
                state,
            )
        first = last
    step.collect(data, observation, state)
    step.finalize(data)
    return data.products


def installed_plugin(source, target):
    """The environment of a process that sees a distribution, installed from its folder into another
    one; without network.
    """
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "--target",
        str(target),
    ]
    subprocess.run([*pip, str(source)], check=True, capture_output=True, text=True)
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(target), os.environ.get("PYTHONPATH", "")]),
    }
