"""The passband that a camera sees."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from .configuration.diagnostics import mistake, refusal
from .configuration.input_paths import InputPath
from .configuration.parameters import Parameters, named, named_or_written
from .configuration.units import Angle, Fraction, Hertz, KelvinRootSecond, RadioFrequency
from .errors import InputError
from .registry import RegistryError, bands
from .storage.files import unpacked_text

SPEED_OF_LIGHT = 299792458.0


class Band(Parameters):
    """A passband: flat between two edges, or tabulated in a file of two columns (frequency in GHz,
    transmission).
    """

    name: str
    """Registered name."""
    low: RadioFrequency | None = None
    """Lower edge of a flat band."""
    high: RadioFrequency | None = None
    """Upper edge of a flat band."""
    file: InputPath | None = None
    """Table of two columns, frequency in GHz and transmission (any scale); `#` begins a comment."""
    provenance: str = ""
    """Source of these numbers."""

    _table: tuple[NDArray[np.float64], NDArray[np.float64]] = PrivateAttr()

    def _as_argument(self) -> str:
        return named_or_written(self, bands)

    @model_validator(mode="after")
    def _tabulate(self) -> Band:
        if self.file is not None:
            if self.low is not None or self.high is not None:
                raise ValueError("give either low and high, or file")
            try:
                self._table = _read_passband(self.file)
            except InputError as err:
                raise refusal(err, at=("file",)) from None
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
        """Name and passband, as text that is the same on every machine: two bands of one name are
        two bands.
        """
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

    def plot(self, ax: Any = None) -> Any:
        """Draw the passband with its centre and width into ``ax`` (default: a new figure), and
        return the matplotlib Axes.
        """
        from .canvas import shown_axes
        from .plots import draw_passband

        ax = shown_axes(ax)
        draw_passband(ax, self)
        return ax


GIGAHERTZ_MIN, GIGAHERTZ_MAX = 0.5, 1e5
"""Beyond, a column that was meant to be in GHz is in THz, or in Hz."""


def _read_passband(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    place, cure = f"passband file {path}", "write two columns: frequency in GHz and transmission"
    try:
        table = np.loadtxt(io.StringIO(unpacked_text(path, place)), ndmin=2)
    except OSError:
        raise InputError(
            "no such file",
            place=place,
            cure="check the path; it is relative to the folder zonda runs in",
        ) from None
    except ValueError as err:
        raise InputError(f"cannot be read as numbers: {err}", place=place, cure=cure) from None
    if table.shape[1] != 2 or len(table) < 2:
        raise InputError(
            f"has {len(table)} rows of {table.shape[1]} columns", place=place, cure=cure
        )
    if not np.isfinite(table).all():
        raise InputError("contains NaN or infinity", place=place, cure=cure)
    if table[:, 0].max() > GIGAHERTZ_MAX:
        raise InputError(f"has a frequency above {GIGAHERTZ_MAX:g} GHz", place=place, cure=cure)
    if table[:, 0].max() < GIGAHERTZ_MIN:
        raise InputError(f"has no frequency above {GIGAHERTZ_MIN:g} GHz", place=place, cure=cure)
    nu, t = table[:, 0] * 1e9, table[:, 1]
    if (np.diff(nu) <= 0).any() or nu[0] <= 0:
        raise InputError("frequencies must be positive and increase", place=place, cure=cure)
    if (t < 0).any() or t.max() <= 0:
        raise InputError("transmission must be >= 0 and somewhere > 0", place=place, cure=cure)
    return nu, t / t.max()


class CameraBand(Band):
    """One of the bands of a camera that has several: its passband, and what its detectors have of
    their own.

    What is absent holds as the instrument has it. A name without a passband is that of a registered
    band.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9_]+$")
    """Name, which products and files of this band bear; a registered name where no passband is
    given.
    """
    detectors: int | None = Field(None, ge=1, le=1_000_000)
    """Number of its detectors."""
    fwhm: Angle | None = Field(None, gt=0)
    """Main-beam FWHM."""
    main_beam_efficiency: Fraction | None = Field(None, gt=0, le=1)
    """zeta: share of an astronomical signal that the main beam delivers."""
    illumination_efficiency: Fraction | None = Field(None, gt=0, le=1)
    """epsilon: share of the atmosphere's emission that reaches a detector."""
    net: KelvinRootSecond | None = Field(None, ge=0)
    """White noise on the sky after calibration, K_RJ sqrt(s)."""
    knee: Hertz | None = Field(None, ge=0)
    """Frequency at which pink noise equals white noise."""
    slope: float | None = Field(None, gt=0, le=3)
    """Pink noise falls as f^-slope."""
    pink_minimum_frequency: Hertz | None = Field(None, gt=0)
    """Below this frequency pink noise is flat."""

    @model_validator(mode="before")
    @classmethod
    def _registered(cls, value: Any) -> Any:
        if isinstance(value, Band):
            return value if isinstance(value, cls) else value.model_dump(mode="json")
        if isinstance(value, str):
            return named(bands, value).model_dump(mode="json")
        if (
            isinstance(value, dict)
            and isinstance(value.get("name"), str)
            and not PASSBAND & {k for k, v in value.items() if v}
        ):
            try:
                return bands.create(value["name"]).model_dump(mode="json") | value
            except RegistryError as err:
                passband = "a band of your own needs a passband: low and high, or file"
                raise mistake(
                    err.message, err.label, f"{passband}\n{err.cure}", at=("name",)
                ) from None
        return value

    @property
    def stated(self) -> dict[str, Any]:
        """Values that it does not leave to the instrument, by name."""
        return {key: value for key in PER_BAND if (value := getattr(self, key)) is not None}

    @property
    def alone(self) -> Band:
        """The passband as that of a camera that has no other."""
        made = Band.model_construct(**{key: getattr(self, key) for key in Band.model_fields})
        made._table = self._table
        return made


if TYPE_CHECKING:
    BandOfCamera = Band
else:
    BandOfCamera = Band | None
"""The band of an `Instrument`: there is none where it has several, and nothing that asks for it can
go on.
"""

NO_BAND: Any = None

PASSBAND = {"low", "high", "file"}
"""Keys of a passband."""

PER_BAND = tuple(key for key in CameraBand.model_fields if key not in Band.model_fields)
"""Keys in which bands of a camera may differ, by the instrument's names."""
