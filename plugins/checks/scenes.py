"""Rows of the stability matrix that `zonda doctor` measures, and the machine itself; small made-up
scans for the checks, run through the real pipeline.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import PrivateAttr

from zonda.core.checks import Case
from zonda.core.configuration.time import Instant
from zonda.core.data import Block, Data, Observation
from zonda.core.experiment.variant import Variant
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.numerics.quaternions import from_angles
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.core.scene import Scene
from zonda.core.site import Site
from zonda.core.types import AnyFloats

DECADES = Case(
    "7 decades between atmosphere (30 K) and signal (1 uK)",
    "noiseless transfer function with and without a 30 K atmospheric mean differ by < 1e-3; a"
    " common mode 1e7 x the signal leaves < 1e-8 K in float64, and in float32 the run chooses"
    " float64 or refuses",
)
PINK = Case(
    "1/f noise to f -> 0; hours to days",
    "explicit f_min; PSD within the stated error over the whole band; variance of a week equals"
    " theory",
)
TIME = Case(
    "timestamps ~1.8e9 s; leap seconds; sampling jitter; gaps; NaN rows",
    "t0 kept exact; pointing error < 1e-9 rad over a day",
)
BLOCKS = Case(
    "blocks, threads, workers in any number",
    "identical bits",
)
TWICE = Case(
    "two identical runs, interrupted and resumed",
    "identical bits",
)
DISPATCH = Case(
    "another instruction set, numpy or numba dispatch",
    "tests pass; differences stated, and within float32 rounding",
)
MACHINE = Case("this machine", "what the other figures rest on")
"""Differs from machine to machine: shown by `zonda doctor`, not published."""


SITE = Site(
    name="Green Bank",
    latitude="38.4331 deg",
    longitude="-79.8398 deg",
    altitude="825 m",
    climatology="green_bank",
)
START = Instant.parse("2024-11-25T07:00:00Z")
TARGET = (75.0, 20.0)
"""RA, Dec, deg."""


def camera(
    detectors: int = 37,
    *,
    field: str = "4.2 arcmin",
    low: str = "78 GHz",
    high: str = "108 GHz",
) -> Instrument:
    """A camera on a 100 m dish."""
    return Instrument(
        name="check",
        telescope=Telescope(name="dish", diameter="100 m"),
        band=Band(name="band", low=low, high=high),
        detectors=detectors,
        field_of_view=field,
        fwhm="8.5 arcsec",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1.7 mK s(1/2)",
        knee="0.5 Hz",
        pink_minimum_frequency="10 mHz",
        sample_rate="100 Hz",
    )


def scene(instrument: Instrument | None = None, **more: Any) -> Scene:
    """Green Bank in a November night, the camera, a target that is up."""
    given = {
        "site": SITE,
        "instrument": instrument or camera(),
        "time": START,
        "target": f"{TARGET[0]} deg {TARGET[1]} deg",
    }
    return Scene(**{**given, "seed": 7, **more})


def scan(
    detectors: int = 37,
    samples: int = 3000,
    *,
    azimuth: float = 150.0,
    elevation: float = 57.0,
    radius: float = 4.0,
    instrument: Instrument | None = None,
    offsets: tuple[ArrayLike, ArrayLike] | None = None,
) -> Observation:
    """Circles of ``radius`` arcmin in 20 s at 100 Hz, around a direction [deg] and around `TARGET`;
    0: a stare.
    """
    instrument = instrument or camera(detectors)
    plane = instrument.focalplane()
    if offsets is not None:
        plane.xi, plane.eta = (np.asarray(o, np.float64) for o in offsets)
    t = np.arange(samples) / 100.0
    reach = np.radians(radius / 60)
    turn = 2 * np.pi * t / 20
    (az, el), (ra, dec) = np.radians([azimuth, elevation]), np.radians(TARGET)
    x = reach * np.cos(turn)
    y = reach * np.sin(turn)
    return Observation(
        "scan-000",
        0,
        SITE,
        instrument,
        plane,
        START,
        t,
        100.0,
        from_angles(-az - x / np.cos(el), el + y),
        from_angles(ra + x / np.cos(dec), dec + y),
        (float(ra), float(dec)),
        7,
    )


class Points(Operator):
    """Points as a given scan does."""

    provides = frozenset({"boresight"})
    _observation: Any = PrivateAttr(None)

    def observe(self, data: Data) -> None:
        """Append the scan."""
        data.observations.append(self._observation)


class Gives(Operator):
    """Provides a given signal (n_det, n_samp)."""

    requires = frozenset({"boresight"})
    provides = frozenset({"signal"})
    _signal: Any = PrivateAttr(None)

    def exec(self, block: Block, state: Any) -> None:
        """Copy the block's part."""
        block.new("signal")[...] = self._signal[block.detectors, block.samples]


def run(
    operators: list[Operator],
    observation: Observation,
    signal: AnyFloats | None = None,
    *,
    precision: Literal["float32", "float64"] = "float64",
    keep: tuple[str, ...] = (),
    **settings: Any,
) -> Data:
    """A pipeline of operators over one made-up scan, and a made-up signal where one is given."""
    points = Points()
    gives = Gives()
    points._observation, gives._signal = observation, signal
    steps = [points, *([gives] if signal is not None else []), *operators]
    pipeline = Pipeline(steps, precision=precision)
    variant = Variant(pipeline, scene(observation.instrument), keep=keep)
    return variant.run(operators=pipeline.operators, **{"threads": 1, **settings})


@contextmanager
def sky_file(values: AnyFloats, pixel: float = 1.0) -> Iterator[Path]:
    """A FITS image (K_RJ, pixels of ``pixel`` arcsec) centred on `TARGET`, gone afterwards."""
    from astropy.io import fits

    image = fits.PrimaryHDU(np.asarray(values, np.float64))
    ny, nx = values.shape
    cards = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "RADESYS": "ICRS",
        "BUNIT": "K",
        "TEMPSCAL": "K_RJ",
        "CRPIX1": (nx + 1) / 2,
        "CRPIX2": (ny + 1) / 2,
        "CRVAL1": TARGET[0],
        "CRVAL2": TARGET[1],
        "CDELT1": -pixel / 3600,
        "CDELT2": pixel / 3600,
    }
    image.header.update(cards)
    with TemporaryDirectory(prefix="zonda-check-") as folder:
        path = Path(folder) / "sky.fits"
        image.writeto(path)
        yield path


def largest(*figures: float) -> float:
    """Largest value, NaN if any value is NaN (`max` would ignore it)."""
    return float(np.max(figures))


def differing(one: Any, other: Any) -> int:
    """Number of values of two arrays that are not the same bits (NaN equals NaN)."""
    a = np.asarray(one)
    b = np.asarray(other)
    if a.shape != b.shape or a.dtype != b.dtype:
        return max(a.size, b.size, 1)
    same = (a == b) | ((a != a) & (b != b))
    return int(np.count_nonzero(~same))
