"""A telescope with its camera, and the passband the camera sees."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, field_validator, model_validator

from .configuration.files import InputPath
from .configuration.parameters import Parameters, named, named_or_written, quantity
from .configuration.units import Angle, AngularAcceleration, AngularJerk, AngularSpeed, Fraction, Hertz, KelvinRootSecond, Metres
from .errors import InputError
from .focalplane import Focalplane
from .registry import bands, instruments
from .storage import packed
from .variants import LIKE, variant

SPEED_OF_LIGHT = 299792458.0


class Band(Parameters):
    """A passband: flat between two edges, or tabulated in a file of two columns (frequency in GHz, transmission)."""

    name: str
    """Registered name."""
    low: Hertz | None = None
    """Lower edge of a flat band."""
    high: Hertz | None = None
    """Upper edge of a flat band."""
    file: InputPath | None = None
    """Table of two columns, frequency in GHz and transmission (any scale); `#` begins a comment."""
    provenance: str = ""
    """Where these numbers come from."""

    _table: tuple[NDArray[np.float64], NDArray[np.float64]] = PrivateAttr()

    def _as_argument(self) -> str:
        return named_or_written(self, bands)

    @model_validator(mode="after")
    def _tabulate(self) -> Band:
        if self.file is not None:
            if self.low is not None or self.high is not None:
                raise ValueError("give either low and high, or file")
            self._table = _read_passband(self.file)
        elif self.low is not None and self.high is not None and 0 < self.low < self.high:
            self._table = (np.linspace(self.low, self.high, 61), np.ones(61))
        else:
            raise ValueError("a band needs 0 < low < high, or file")
        return self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Band) and self.model_dump() == other.model_dump()

    def __hash__(self) -> int:
        return hash((self.name, self.low, self.high, self.file))

    @property
    def frequency(self) -> NDArray[np.float64]:
        """(n,) Hz, increasing."""
        return self._table[0]

    @property
    def transmission(self) -> NDArray[np.float64]:
        """(n,) relative transmission, peak 1."""
        return self._table[1]

    @property
    def identity(self) -> tuple[str, ...]:
        """Name and passband, as text that is the same on every machine: two bands of one name are two bands."""
        if self.file is None:
            return self.name, f"{self.low:.9g}", f"{self.high:.9g}"
        table = ",".join(f"{nu:.9g} {t:.9g}" for nu, t in zip(*self._table, strict=True))
        return self.name, table

    @property
    def centre(self) -> float:
        """Transmission-weighted mean frequency, Hz."""
        nu, t = self._table
        return float(np.trapezoid(nu * t, nu) / np.trapezoid(t, nu))

    @property
    def width(self) -> float:
        """Equivalent width, integral of the (peak-normalized) transmission, Hz."""
        return float(np.trapezoid(self.transmission, self.frequency))


GIGAHERTZ_MAX = 1e5
"""Beyond, a column that was meant to be in GHz is in Hz."""


def _read_passband(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    place, cure = f"passband file {path}", "write two columns: frequency in GHz and transmission"
    try:
        table = np.loadtxt(io.StringIO(packed.text(path, place)), ndmin=2)
    except OSError:
        raise InputError("no such file", place=place, cure="check the path; it is relative to the folder zonda runs in") from None
    except ValueError as err:
        raise InputError(f"cannot be read as numbers: {err}", place=place, cure=cure) from None
    if table.shape[1] != 2 or len(table) < 2:
        raise InputError(f"has {len(table)} rows of {table.shape[1]} columns", place=place, cure=cure)
    if not np.isfinite(table).all():
        raise InputError("contains NaN or infinity", place=place, cure=cure)
    if table[:, 0].max() > GIGAHERTZ_MAX:
        raise InputError(f"has a frequency above {GIGAHERTZ_MAX:g} GHz", place=place, cure=cure)
    nu, t = table[:, 0] * 1e9, table[:, 1]
    if (np.diff(nu) <= 0).any() or nu[0] <= 0:
        raise InputError("frequencies must be positive and increase", place=place, cure=cure)
    if (t < 0).any() or t.max() <= 0:
        raise InputError("transmission must be >= 0 and somewhere > 0", place=place, cure=cure)
    return nu, t / t.max()


class Telescope(Parameters):
    """The dish and its mount."""

    name: str
    """E.g. GBT."""
    diameter: Metres = Field(gt=0)
    """Primary diameter."""
    site: str = Field("", exclude=True)
    """Registered name of the site where it stands; `zonda check` says so where the scene has another."""
    elevation_min: Angle = quantity("5 deg", ge=0)
    """Lowest elevation the mount reaches."""
    elevation_max: Angle = quantity("90 deg", gt=0)
    """Highest elevation the mount reaches."""
    speed_max: AngularSpeed | None = Field(None, gt=0)
    """Fastest motion on the sky, where there is a limit."""
    acceleration_max: AngularAcceleration | None = Field(None, gt=0)
    """Largest acceleration on the sky, where there is a limit."""
    azimuth_speed_max: AngularSpeed | None = Field(None, gt=0)
    """Fastest turn of the azimuth axis: the speed on the sky over the cosine of the elevation."""
    azimuth_acceleration_max: AngularAcceleration | None = Field(None, gt=0)
    """Largest acceleration of the azimuth axis."""
    azimuth_jerk_max: AngularJerk | None = Field(None, gt=0)
    """Fastest change of the azimuth axis' acceleration."""
    elevation_speed_max: AngularSpeed | None = Field(None, gt=0)
    """Fastest turn of the elevation axis."""
    elevation_acceleration_max: AngularAcceleration | None = Field(None, gt=0)
    """Largest acceleration of the elevation axis."""
    elevation_jerk_max: AngularJerk | None = Field(None, gt=0)
    """Fastest change of the elevation axis' acceleration."""

    def _as_argument(self) -> str:
        return repr(self)


class Instrument(Parameters):
    """A camera on a telescope: hexagonally packed detectors in a round field of view. Subclass to lay out others."""

    name: str
    """Registered name."""
    description: str = ""
    """What it is, in one line."""
    telescope: Telescope
    """The dish it is mounted on."""
    band: Band
    """The passband: a registered name, or a Band."""
    detectors: int = Field(ge=1, le=1_000_000)
    """Number of detectors."""
    field_of_view: Angle = Field(ge=0, le=1.0)
    """Diameter of the circle that holds all detectors."""
    polarization: Literal["none", "pairs"] = "none"
    """`pairs`: a pixel has two polarized detectors at right angles, A and B; A lies at 0 and 45 deg in turn from pixel to pixel."""
    fwhm: Angle | None = Field(None, gt=0)
    """Main-beam FWHM; where absent, the diffraction limit 1.22 lambda / D at the band centre."""
    main_beam_efficiency: Fraction = Field(gt=0, le=1)
    """zeta: share of an astronomical signal that the main beam delivers."""
    illumination_efficiency: Fraction = Field(gt=0, le=1)
    """epsilon: share of the atmosphere's emission that reaches a detector."""
    net: KelvinRootSecond = Field(ge=0)
    """White noise on the sky after calibration, K_RJ sqrt(s): the rms of one second of integration."""
    knee: Hertz = quantity("0 Hz", ge=0)
    """Frequency at which pink noise equals white noise (0: no pink noise)."""
    slope: float = Field(1.0, gt=0, le=3)
    """Pink noise falls as f^-slope."""
    pink_minimum_frequency: Hertz = quantity("1 mHz", gt=0)
    """Below this frequency pink noise is flat."""
    sample_rate: Hertz = Field(gt=0, le=1e6)
    """Read-out rate."""
    provenance: str = ""
    """Where these numbers come from."""

    def _as_argument(self) -> str:
        return named_or_written(self, instruments)

    @model_validator(mode="after")
    def _in_pairs(self) -> Instrument:
        if self.polarization == "pairs" and self.detectors % 2:
            raise ValueError(
                f"polarization: pairs needs an even number of detectors, two in each pixel; detectors is {self.detectors}"
            )
        return self

    @field_validator("band", mode="before")
    @classmethod
    def _band_by_name(cls, value: Any) -> Any:
        return named(bands, value)

    def varied(self, **changes: Any) -> Instrument:
        """This instrument with fields changed, as ``{like: ..., ...}`` in a pipeline file (`core.variants.variant`)."""
        made: Instrument = variant({LIKE: self, **changes})
        return made

    @property
    def identity(self) -> tuple[str, ...]:
        """What tells its detectors' random numbers from those of another instrument or band: names and passband."""
        return "instrument", self.name, "band", *self.band.identity

    @property
    def beam_fwhm(self) -> float:
        """`fwhm`, or the diffraction limit 1.22 lambda / D at the band centre, rad."""
        if self.fwhm is not None:
            return self.fwhm
        return 1.22 * SPEED_OF_LIGHT / self.band.centre / self.telescope.diameter

    def focalplane(self) -> Focalplane:
        """The detector table: pixels at points of a hexagonal lattice that just fill `field_of_view`, nearest its centre first.

        A pixel has one detector, or two with ``polarization: pairs``: A and B, at right angles, next to each other in the table.
        A of every second pixel lies at 0, of the others at 45 deg.
        """
        pair = 2 if self.polarization == "pairs" else 1
        pixels, n = self.detectors // pair, self.detectors
        x, y = hexagonal_packing(pixels)
        reach = float(np.hypot(x, y).max())
        scale = math.tan(self.field_of_view / 2) / reach if reach > 0 else 0.0
        width = len(str(pixels - 1))
        full = np.full
        angle = np.add.outer(np.pi / 4 * (np.arange(pixels) % 2), [0.0, np.pi / 2]).ravel() if pair == 2 else np.zeros(n)
        return Focalplane(
            names=[f"d{k:0{width}d}{side}" for k in range(pixels) for side in ("AB" if pair == 2 else ("",))],
            xi=np.repeat(x * scale, pair),
            eta=np.repeat(y * scale, pair),
            fwhm=full(n, self.beam_fwhm),
            main_beam_efficiency=full(n, self.main_beam_efficiency),
            illumination_efficiency=full(n, self.illumination_efficiency),
            net=full(n, self.net),
            polarization_angle=angle,
            polarization_efficiency=full(n, float(pair == 2)),
            band=[self.band.name] * n,
            knee=full(n, self.knee),
            slope=full(n, self.slope),
            minimum_frequency=full(n, self.pink_minimum_frequency),
        )


def hexagonal_packing(n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The ``n`` points of a unit-pitch hexagonal lattice nearest its origin. Two arrays (n,), nearest first."""
    rings = math.ceil(math.sqrt(n)) + 1
    i, j = np.mgrid[-rings : rings + 1, -rings : rings + 1]
    x, y = (i + j / 2.0).ravel(), (j * math.sqrt(3) / 2).ravel()
    order = np.lexsort((np.round(np.arctan2(y, x), 9), np.round(np.hypot(x, y), 9)))[:n]
    return x[order], y[order]
