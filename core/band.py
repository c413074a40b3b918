"""The passband that a camera sees."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, PrivateAttr, create_model, model_validator

from .configuration.diagnostics import mistake, refusal
from .configuration.input_paths import InputPath
from .configuration.parameters import Parameters, named, named_or_written
from .configuration.units import Angle, Fraction, Hertz, KelvinRootSecond, RadioFrequency
from .errors import InputError
from .registry import RegistryError, bands
from .storage.table_files import NUMBERED, read_table
from .types import Floats

SPEED_OF_LIGHT = 299792458.0


class Band(Parameters):
    """A passband: flat between two edges, or tabulated in a file (frequency, transmission)."""

    name: str
    """Registered name."""
    low: RadioFrequency | None = None
    """Lower edge of a flat band."""
    high: RadioFrequency | None = Field(None, examples=["110 GHz"])
    """Upper edge of a flat band."""
    file: InputPath | None = None
    """Table with frequency (in GHz where it states no unit) or wavelength, and transmission (any
    scale): two columns, or columns of these names; ECSV, CSV, IPAC, FITS or VOTable, in any order.
    Slightly negative values, as of a Fourier spectrometer, are kept.
    """
    provenance: str = ""
    """Source of these numbers."""

    _table: tuple[Floats, Floats] = PrivateAttr()

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
    def frequency(self) -> Floats:
        """(n,) Hz, increasing."""
        return self._table[0]

    @property
    def transmission(self) -> Floats:
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
    def edges(self) -> tuple[float, float]:
        """Lowest and highest frequency of half the peak's transmission, Hz."""
        nu, t = self._table
        first, last = np.flatnonzero(t >= 0.5)[[0, -1]].tolist()
        low = (
            np.interp(0.5, t[first - 1 : first + 1], nu[first - 1 : first + 1]) if first else nu[0]
        )
        above = slice(last, last + 2)
        return float(low), float(np.interp(-0.5, -t[above], nu[above]))

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
NEGATIVE_MAX = 0.1
"""Largest negative transmission, of the peak, that is taken as noise of a measurement."""
ALIASES = {
    "frequency": ("frequency", "freq", "f", "nu", "bandpass_frequency", "frequencies", "freqs"),
    "transmission": (
        "transmission", "throughput", "trans", "bandpass_weight", "weight", "response", "passband",
        "bandpass", "transmittance", "relative_response", "t", "efficiency",
    ),
    "wavelength": ("wavelength", "wl", "lambda", "wave"),
}  # fmt: skip
"""Names of columns in published passbands, in small letters."""


def _read_passband(path: Path) -> tuple[Floats, Floats]:
    """Frequency [Hz], rising, and transmission of peak 1. Negative values are kept: the noise of a
    spectrometer is as often below zero as above, and its mean must stay zero.
    """
    cure = "write two columns: frequency in GHz and transmission"
    table = read_table(path, f"passband file {path}", names=NUMBERED)
    table.rename(ALIASES)
    if (
        not {"frequency", "wavelength"} & table.columns.keys()
        or "transmission" not in table.columns
    ):
        if len(table.columns) != 2:
            there = f"has {len(table.columns)} columns, none of them frequency and transmission"
            raise InputError(f"{there}: {', '.join(table.columns)}", place=table.place, cure=cure)
        table.columns = dict(
            zip(("frequency", "transmission"), table.columns.values(), strict=True)
        )
    if "frequency" in table.columns:
        column, unit = table.columns["frequency"]
        table.columns = {**table.columns, "frequency": (column, unit or "GHz")}
        nu = table.numbers("frequency", "Hz")
    else:
        with np.errstate(divide="ignore"):
            nu = SPEED_OF_LIGHT / table.numbers("wavelength", "m")
    t = table.numbers("transmission")
    table.check()
    order = np.argsort(nu)
    nu = nu[order]
    t = t[order]
    most = GIGAHERTZ_MAX * 1e9
    least = GIGAHERTZ_MIN * 1e9
    for wrong, text in (
        (len(nu) < 2, "has one row"),
        (nu[-1] > most, f"has a frequency above {GIGAHERTZ_MAX:g} GHz"),
        (nu[-1] < least, f"has no frequency above {GIGAHERTZ_MIN:g} GHz"),
        (nu[0] <= 0, "frequencies must be positive"),
        ((np.diff(nu) <= 0).any(), "has a frequency twice"),
        (t.max() <= 0, "transmission must be somewhere > 0"),
        (
            t.min() < -NEGATIVE_MAX * t.max(),
            f"transmission is {t.min():g}, more than {NEGATIVE_MAX:.0%} of the peak below zero",
        ),
    ):
        if wrong:
            raise InputError(text, place=table.place, cure=cure)
    return nu, t / t.max()


def with_yield(base: type[Parameters], default: float | None) -> Any:
    """Subclass of ``base`` with the field ``yield``, a keyword that no class statement can name."""
    text = "Share of the detectors that give data. The others are dead, the same ones in each run."
    field = Field(default, gt=0, le=1, description=text)
    kind: Any = Fraction if default is not None else Fraction | None
    fields: dict[str, Any] = {"yield": (kind, field)}
    return create_model(f"{base.__name__}WithYield", __base__=base, **fields)


if TYPE_CHECKING:

    class BandWithYield(Band):
        """A band with the field ``yield``."""

else:
    BandWithYield = with_yield(Band, None)


class CameraBand(BandWithYield):
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
    fwhm: Angle | None = Field(None, gt=0, examples=["9 arcsec"])
    """Main-beam FWHM."""
    main_beam_efficiency: Fraction | None = Field(None, gt=0, le=1, examples=["0.6"])
    """zeta: share of an astronomical signal that the main beam delivers."""
    illumination_efficiency: Fraction | None = Field(None, gt=0, le=1, examples=["0.9"])
    """epsilon: share of the atmosphere's emission that reaches a detector."""
    net: KelvinRootSecond | None = Field(None, ge=0)
    """White noise on the sky after calibration, K_RJ sqrt(s)."""
    knee: Hertz | None = Field(None, ge=0)
    """Frequency at which pink noise equals white noise."""
    slope: float | None = Field(None, gt=0, le=3)
    """Pink noise falls as f^-slope."""
    pink_minimum_frequency: Hertz | None = Field(None, gt=0, examples=["1 mHz"])
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
                    err.message,
                    err.label,
                    f"{passband}\n{err.cure}",
                    at=("name",),
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
