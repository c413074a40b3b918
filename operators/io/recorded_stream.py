"""One stream of an open file, read in blocks, in kelvin."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zonda.core.band import Band
from zonda.core.configuration.units import factor_to
from zonda.core.errors import InputError
from zonda.core.numerics.chunks import TILE_DETECTORS, TILE_SAMPLES, chunks
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.numerics.smooth import SmoothField
from zonda.core.types import AnyFloats, Bools, Floats, Indices

AT_ONCE = 4 * TILE_SAMPLES
"""Samples of `TILE_DETECTORS` detectors that are read at once."""

LITTLE = 10.0
"""Levels of all detectors up to this many standard deviations of their samples stay in the stream:
it has been filtered.
"""

LARGEST = 1e9
"""K: what is larger is no temperature, but damage."""

CMB = "_CMB"
"""Ends units of temperature of the CMB."""

STRETCHES, LENGTH = 5, 64
"""Parts of a scan, and samples of each, of which a detector's level is the median."""


@dataclass
class RecordedStream:
    """A stream of an open file.

    Attributes
    ----------
    file
        The reader (`save_tod.reader`).
    name
        Of the stream.
    rows
        (n_det,) rows of the file.
    mask
        Bits of the flags of a detector's samples that make one NaN.
    good, usable
        (n_samp,) which instants the file's flags leave, and those at which there is a signal that
        filters use; None: all.
    unit, band
        Unit of the stream, None: the file's; the band, for temperatures of the CMB.
    level
        (n_det,) K, constant, that stands beside the stream; ``mean``: the same as a field, None
        where it is zero.
    """

    file: Any
    name: str
    rows: Indices
    mask: np.uint8
    good: Bools | None = None
    usable: Bools | None = None
    unit: str | None = None
    band: Band | None = None
    level: Floats = field(default_factory=lambda: np.zeros(0))
    mean: SmoothField | None = None

    def __post_init__(self) -> None:
        unit = self.unit or self.file.streams[self.name]
        self._factor = _kelvin(unit, self.name, self.file.place, self.band)

    def levelled(self, n_detectors: int, n_samples: int) -> RecordedStream:
        """Itself, with the level of each detector; where that cannot be read the file is closed."""
        try:
            self.level, spread = levels(self, n_detectors, n_samples)
        except BaseException:
            self.file.close()
            raise
        used = (self.file.tod.detector_flags[self.rows] & self.mask) == 0
        if (np.abs(self.level) <= LITTLE * spread)[used].all():
            self.level = np.zeros(n_detectors)
        else:
            self.mean = SmoothField.constant(self.level, n_samples)
        return self

    def add(self, detectors: slice, samples: slice, out: AnyFloats) -> int:
        """Add what stands above `level` to ``out`` (n, m), in parts of a few megabytes; how many
        samples are flagged.
        """
        spoilt = 0
        for rows in chunks(detectors.stop - detectors.start, TILE_DETECTORS):
            for part in chunks(samples.stop - samples.start, AT_ONCE):
                first = detectors.start + rows.start
                begin = samples.start + part.start
                absolute = (
                    slice(first, detectors.start + rows.stop),
                    slice(begin, samples.start + part.stop),
                )
                values, bad = self.read(*absolute)
                values -= self.level[absolute[0], None]
                np.add(out[rows, part], values, out=out[rows, part], casting="same_kind")
                spoilt += bad
        return spoilt

    def read(self, detectors: slice, samples: slice) -> tuple[Floats, int]:
        """(n, m) float64 K at absolute detectors and samples, NaN where the file flags one.

        How many these are, too, but for detectors that the file excludes altogether. Raises
        InputError where a sample that is used is larger than `LARGEST`.
        """
        rows = self.rows[detectors]
        values = np.array(self.file.read(self.name, rows, samples), np.float64)
        if self._factor != 1.0:
            values *= self._factor
        flagged = self.file.flags(rows, samples)
        if flagged is not None:
            bad = (flagged & self.mask) != 0
            values[bad] = np.nan
        if (
            values.size
            and not max(np.fmax.reduce(values, axis=None), -np.fmin.reduce(values, axis=None))
            <= LARGEST
        ):
            self._refuse_damage(values, rows, samples)
        if flagged is None:
            return values, 0
        return values, int(
            np.count_nonzero(bad[(self.file.tod.detector_flags[rows] & self.mask) == 0])
        )

    def _refuse_damage(self, values: Floats, rows: Indices, samples: slice) -> None:
        """InputError for the first sample that is used and cannot be a temperature."""
        used = (self.file.tod.detector_flags[rows] & self.mask) == 0
        large = (
            (np.abs(values) > LARGEST)
            & used[:, None]
            & (True if self.good is None else self.good[samples])
        )
        for row, column in np.argwhere(large)[:1]:
            name = self.file.tod.names[rows[row]]
            sample = samples.start + column
            cure = (
                "the data are damaged: copy or make the file again; or flag the detector or the"
                " samples"
            )
            text = (
                f"the stream {self.name} is {values[row, column]:.3g} K at sample {sample} of"
                f" detector {name}"
            )
            raise InputError(f"{text}: no temperature", place=self.file.place, cure=cure)
        values[np.abs(values) > LARGEST] = np.nan  # of what is not used


def levels(stream: RecordedStream, n_detectors: int, n_samples: int) -> tuple[Floats, Floats]:
    """Median and standard deviation (n_detectors,) [K] of a few hundred finite samples of each
    detector, 0 where there is none.

    They depend on the file alone, and not on samples that it flags. For the level any number would
    do: it is subtracted in float64 and added again.
    """
    found = np.zeros((2, n_detectors))
    usable = np.arange(n_samples) if stream.usable is None else np.flatnonzero(stream.usable)
    begins = (
        usable[np.unique(np.linspace(0, max(len(usable) - LENGTH, 0), STRETCHES).astype(int))]
        if len(usable)
        else usable
    )
    stretches = [slice(int(b), min(int(b) + LENGTH, n_samples)) for b in begins]
    for rows in chunks(n_detectors, TILE_DETECTORS) if stretches else ():
        known = [slice(None) if stream.usable is None else stream.usable[s] for s in stretches]
        parts = np.hstack(
            [stream.read(rows, s)[0][:, k] for s, k in zip(stretches, known, strict=True)]
        )
        for number, values in enumerate(parts, rows.start):
            finite = values[np.isfinite(values)]
            found[:, number] = (np.median(finite), np.std(finite)) if finite.size else (0.0, 0.0)
    return found[0], found[1]


def kelvin_per(unit: str) -> float | None:
    """Kelvin per unit of a temperature (mK_RJ, K_CMB, ...), on its own scale; None: of another
    quantity.
    """
    plain = unit.strip().removesuffix(CMB).removesuffix("_RJ")
    return factor_to("K", plain) if plain else None


def check_unit(unit: str, name: str, place: str) -> None:
    """Raise InputError for a stream in a unit that is none of temperature."""
    if kelvin_per(unit) is None:
        cure = "calibrate it to a temperature; state its unit, e.g. LoadTOD: {unit: K_CMB}"
        has = f"is in {unit!r}, not in kelvin" if unit else "has no unit"
        raise InputError(f"the stream {name} {has}", place=place, cure=cure)


def _kelvin(unit: str, name: str, place: str, band: Band | None) -> float:
    """Kelvin (Rayleigh-Jeans) per unit of a stream."""
    check_unit(unit, name, place)
    factor = kelvin_per(unit) or 1.0
    if not unit.strip().endswith(CMB):
        return factor
    if band is None:
        cure = "convert it with LoadTOD, which knows the band, and SaveTOD"
        raise InputError(f"the stream {name} is in {unit}", place=place, cure=cure)
    return factor * to_kelvin_rj("K_CMB", band)
