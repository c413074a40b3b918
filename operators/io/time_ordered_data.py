"""One scan as it goes to and comes from a file: pointing, detectors, flags and streams."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.time import Instant
from zonda.core.data import Observation
from zonda.core.errors import InputError
from zonda.core.flags import (
    DETECTOR_FLAGS,
    PROCESSING,
    SAMPLE_FLAGS,
    TRIMMED,
    TRIMMED_INTERVALS,
    Flags,
    Intervals,
    from_file,
    in_file,
    intervals_of,
    of_before,
    samples_in,
)
from zonda.core.numerics.quaternions import detector_quaternions, directions
from zonda.core.numerics.sphere import angles
from zonda.core.storage.files import writing
from zonda.core.types import AnyFloats, Floats
from zonda.core.weather import GroundWeather

LIMITS = {
    "latitude": (-np.pi / 2, np.pi / 2),
    "longitude": (-2 * np.pi, 2 * np.pi),
    "altitude": (-1e4, 1e6),
    "sample_rate": (1e-9, 1e9),
    "field_of_view": (0.0, 2 * np.pi),
    "centre_ra": (-2 * np.pi, 2 * np.pi),
    "centre_dec": (-np.pi / 2, np.pi / 2),
    "telescope_diameter": (1e-6, 1e6),
}
"""Least and most of numbers that a file states once, SI."""
OF_SAMPLES = (
    "times",
    "seconds",
    "azimuth",
    "elevation",
    "boresight_azel",
    "boresight_radec",
    "flags",
    "hwp_angle",
)
"""What a scan may have of each sample, besides its streams."""
OF_DETECTORS = (
    "fwhm",
    "polarization_angle",
    "polarization_efficiency",
    "main_beam_efficiency",
    "illumination_efficiency",
    "band_centre",
    "band_width",
    "net",
    "knee",
    "minimum_frequency",
    "slope",
    "wafer",
)
"""Columns of the detectors in a file."""


def _none() -> Floats:
    return np.zeros((0, 4))


@dataclass(kw_only=True)
class TimeOrderedData:
    """The content of a file of time-ordered data.

    Attributes
    ----------
    name
        Of the observation.
    start
        Exact start, UTC, ISO 8601 with a fraction of a second.
    seconds
        (n_samp,) float64, s since ``start``.
    times
        (n_samp,) float64, POSIX seconds (0.24 us resolution).
    sample_rate
        Hz.
    telescope, field_of_view
        Name; diameter of the circle that holds all detectors, rad.
    site
        name, latitude [rad], longitude [rad], altitude [m].
    boresight_azel, boresight_radec
        (n_samp, 4) quaternions (x, y, z, w), see `Observation`; (0, 4): the file does not have
        them.
    flags, detector_flags
        (n_samp,) and (n_det,) uint8, TOAST's bits (`core.flags`): samples with a bit of 15 and
        detectors with one of 7 are not to be used.
    names, quats
        Detector names; (n_det, 4) rotations from the boresight's frame to the detectors'.
    columns
        Further detector columns, (n_det,) each, SI: fwhm [rad], net [K_RJ sqrt(s)], knee,
        minimum_frequency [Hz], slope, band_centre, band_width [Hz], main_beam_efficiency,
        illumination_efficiency, polarization_angle [rad], polarization_efficiency, wafer (whole
        numbers).
    streams
        (n_det, n_samp) arrays; K_RJ, but for what is no temperature. NaN: a single sample that is
        not to be used.
    intervals
        By TOAST's names: (start, stop) of parts of the scan, s since ``start`` (`core.flags`).
        In those called `TRIMMED_INTERVALS` *processing* means that a filter of zonda trimmed the
        samples.
    weather
        At the telescope; None: not known.
    hwp_angle
        (n_samp,) rad, of a half-wave plate in the focal plane; None: there is none.
    azimuth
        (n_samp,) rad, of the mount, north through east, as recorded; None: it follows from
        ``boresight_azel``.
    metadata
        Text and numbers that say where the data come from.
    offsets
        (n_det, 2) `xi` and `eta` to the last bit, where the file has them; None: they follow from
        ``quats``.
    """

    name: str
    start: str
    seconds: Floats
    times: Floats
    sample_rate: float
    telescope: str
    field_of_view: float
    site: tuple[str, float, float, float]
    boresight_azel: Floats = field(default_factory=_none)
    boresight_radec: Floats = field(default_factory=_none)
    flags: Flags
    detector_flags: Flags
    names: list[str]
    quats: Floats
    columns: dict[str, Floats]
    streams: dict[str, AnyFloats] = field(default_factory=dict)
    intervals: Intervals = field(default_factory=dict)
    weather: GroundWeather | None = None
    hwp_angle: Floats | None = None
    azimuth: Floats | None = None
    metadata: dict[str, str | int | float] = field(default_factory=dict)
    offsets: Floats | None = None

    @property
    def n_samples(self) -> int:
        return len(self.seconds)

    @property
    def n_detectors(self) -> int:
        return len(self.names)

    def check(self, place: str) -> None:
        """Raise an `InputError` about ``place`` where a statement is no text or number within its
        limits, shapes do not fit each other, or times and pointing are not finite.
        """
        self._check_statements(place)
        n = np.shape(self.times)[:1]
        d = np.shape(self.names)
        given = vars(self) | self.columns
        pointed = [name for name in ("boresight_azel", "boresight_radec") if len(given[name])]
        shapes = dict.fromkeys(("seconds", "times", "flags", "hwp_angle", "azimuth"), n)
        shapes |= {"quats": (*d, 4), "detector_flags": d, "offsets": (*d, 2)}
        shapes |= dict.fromkeys(pointed or ("boresight_azel",), (*n, 4))
        shapes |= dict.fromkeys(self.columns, d)
        known = {name: given[name] for name in shapes if given[name] is not None}
        wrong = [name for name, values in known.items() if np.shape(values) != shapes[name]]
        wrong += [name for name, v in known.items() if np.asarray(v).dtype.kind not in "fiu"]
        wrong += [
            name
            for name, stream in self.streams.items()
            if stream.shape[:2] != (*d, *n) or stream.dtype.kind not in "fiu"
        ]
        if wrong or not n or not d:
            message = f"does not fit together: {', '.join(wrong)} for {len(self.names)} detectors"
            raise InputError(message, place=place, cure="save it again")
        for name in ("azimuth", *self.columns):  # where it is no number, another is taken
            known.pop(name, None)
        known |= {f"intervals {name}": spans for name, spans in self.intervals.items()}
        numbers = [name for name, values in known.items() if not np.isfinite(values).all()]
        if numbers:
            raise InputError(
                f"has NaN or impossible values in {', '.join(numbers)}",
                place=place,
                cure="save it again",
            )

    def _check_statements(self, place: str) -> None:
        """Raise `InputError` for a text or a start that is none, or a number beyond its limits."""
        site, *where = self.site
        texts = {"name": self.name, "telescope": self.telescope, "site": site, "start": self.start}
        wrong = [
            f"{name} is {value!r:.60}"
            for name, value in texts.items()
            if not isinstance(value, str)
        ]
        if isinstance(self.start, str):
            try:
                Instant.parse(self.start)
            except ValueError as error:
                wrong.append(f"start: {error}")
        named: dict[str, Any] = dict(zip(("latitude", "longitude", "altitude"), where, strict=True))
        named |= {"sample_rate": self.sample_rate, "field_of_view": self.field_of_view}
        named |= {key: self.metadata[key] for key in LIMITS if key in self.metadata}
        if self.weather is not None:
            named |= {f"weather {key}": value for key, value in asdict(self.weather).items()}
        for name, value in named.items():
            least, most = LIMITS.get(name, (-1e30, 1e30))
            number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if not (number and least <= value <= most):
                wrong.append(f"{name} is {value!r:.60}, not {least:g} to {most:g}")
        for name, value in self.metadata.items():
            if not isinstance(value, str | int | float | np.generic):
                wrong.append(f"{name} is {value!r:.60}")
        if wrong:
            text = f"states impossible values: {'; '.join(wrong)}"
            raise InputError(text, place=place, cure="mend these values, or save it again")

    def of_samples(self) -> dict[str, NDArray[Any]]:
        """Arrays of the samples, by name: those that it has, with azimuth (as recorded, where it
        is) and elevation of the boresight.
        """
        longitude, elevation = angles(directions(self.boresight_azel))
        azimuth = -longitude % (2 * np.pi) if self.azimuth is None else self.azimuth
        found = vars(self) | {"azimuth": azimuth, "elevation": elevation}
        every = {name: found[name] for name in OF_SAMPLES}
        return {name: v for name, v in every.items() if v is not None and len(v)}

    def update_flags(self) -> None:
        """Make flags of a file that an earlier zonda wrote TOAST's; its *processing* is
        trimmed.
        """
        self.flags = of_before(self.flags, samples=True)
        self.detector_flags = of_before(self.detector_flags, samples=False)
        processed = (self.flags & np.uint8(PROCESSING)) != 0
        self.intervals[TRIMMED_INTERVALS] = intervals_of(processed, self.seconds)

    def take_flags(self, observation: Observation) -> None:
        """Take the flags that a scan has now, and its intervals."""
        self.flags = in_file(observation.flags, SAMPLE_FLAGS)
        self.detector_flags = in_file(observation.detector_flags, DETECTOR_FLAGS)
        trimmed = intervals_of(
            (observation.flags & np.uint8(TRIMMED | PROCESSING)) == TRIMMED,
            observation.seconds,
        )
        self.intervals = {
            **observation.intervals,
            **({TRIMMED_INTERVALS: trimmed} if trimmed else {}),
        }

    def sample_flags(self, mask: int) -> Flags:
        """(n_samp,) bits of `core.flags`; ``mask``: bits of the file that exclude a sample."""
        return from_file(
            self.flags,
            mask,
            samples_in(self.intervals.get(TRIMMED_INTERVALS, []), self.seconds),
        )

    @property
    def scan_intervals(self) -> Intervals:
        """The intervals without those that say what was trimmed."""
        return {name: spans for name, spans in self.intervals.items() if name != TRIMMED_INTERVALS}

    @property
    def xi(self) -> Floats:
        """(n_det,) offset towards increasing azimuth: a tangent, on the gnomonic plane about the
        boresight.

        sotodlib's xi is a sine (`xieta_sotodlib`): the same to 3e-7 rad at 0.5 deg, 35 arcsec less
        at 4 deg, 46 arcmin at 17 deg.
        """
        return self._offsets()[:, 0]

    @property
    def eta(self) -> Floats:
        """(n_det,) offset towards increasing elevation, as `xi`."""
        return self._offsets()[:, 1]

    def _offsets(self) -> Floats:
        if self.offsets is not None:
            return self.offsets
        x, y, z = directions(self.quats).T
        return np.stack([-y / z, -x / z], axis=1)

    def xieta_sotodlib(
        self,
    ) -> tuple[Floats, Floats, Floats]:
        """xi, eta, gamma (n_det,) [rad] as sotodlib and so3g define them: sines, of the same signs
        as ours; gamma is the angle of the polarization from increasing eta towards increasing xi.
        """
        x, y, _ = directions(self.quats).T
        _, _, z, w = self.quats.T
        return -y, -x, np.asarray(np.arctan2(2 * w * z, w * w - z * z))

    @classmethod
    def of(cls, observation: Observation) -> TimeOrderedData:
        """Everything but the streams of an observation."""
        o = observation
        f = observation.focalplane
        instrument = observation.instrument
        own = {
            "band_centre": np.full(len(f), instrument.band.centre),
            "band_width": np.full(len(f), instrument.band.width),
        }
        if "white" in o.components and "pink" not in o.components:
            own["knee"] = np.zeros(len(f))
        found = cls(
            name=o.name,
            start=o.start.isoformat(),
            seconds=o.seconds,
            times=o.start.posix + o.seconds,
            sample_rate=o.sample_rate,
            telescope=instrument.name,
            field_of_view=2 * float(np.arctan(f.radius)),
            site=(o.site.name, o.site.latitude, o.site.longitude, o.site.altitude),
            boresight_azel=o.boresight_azel,
            boresight_radec=o.boresight_radec,
            flags=o.flags,
            detector_flags=o.detector_flags,
            names=list(f.names),
            quats=detector_quaternions(f.xi, f.eta, f.polarization_angle),
            columns={
                name: np.asarray(own[name] if name in own else getattr(f, name), np.float64)
                for name in OF_DETECTORS
            },
            weather=o.weather,
            hwp_angle=o.hwp_angle,
            azimuth=np.asarray(
                o.azimuth if o.recorded_azimuth is None else o.recorded_azimuth,
                np.float64,
            ),
            metadata={
                "seed": o.seed,
                "observation_index": o.index,
                "centre_ra": o.centre[0],
                "centre_dec": o.centre[1],
                "band": instrument.band.name,
                "telescope": instrument.telescope.name,
                "telescope_diameter": instrument.telescope.diameter,
            },
            offsets=np.stack([f.xi, f.eta], axis=1),
        )
        found.take_flags(o)
        return found


class TodWriter:
    """Base of what writes a scan, rectangle by rectangle; a subclass has `write`, `_finish` and
    `_close`.
    """

    def __init__(self, path: Path, tod: TimeOrderedData) -> None:
        self.path = path
        self.tod = tod

    def write(self, stream: str, detectors: slice, samples: slice, values: AnyFloats) -> None:
        """Write a rectangle of a stream."""
        raise NotImplementedError

    def finish(self) -> None:
        """Write all but the streams, and close the file."""
        with writing(self.path):
            try:
                self._finish()
            finally:
                self._close()

    def close(self) -> None:
        """Close an unfinished file."""
        with suppress(OSError):  # nothing is lost: the caller removes the file
            self._close()

    def _finish(self) -> None:
        raise NotImplementedError

    def _close(self) -> None:
        raise NotImplementedError
