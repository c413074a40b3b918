"""One continuous scan: where the telescope looks, with what, and what is known of its data."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from .errors import InputError
from .flags import DEAD, EXCLUDE_DETECTOR, EXCLUDE_SAMPLE, Flags, Intervals, good, intervals_of
from .focalplane import Focalplane
from .log import Log
from .numerics.random import Key, stream_key
from .numerics.smooth import SmoothField
from .tables import html_table
from .types import AnyFloats, Bools, Floats, Indices, Integers

if TYPE_CHECKING:
    from .configuration.time import Instant
    from .instrument import Instrument
    from .site import Site
    from .weather import GroundWeather


@dataclass(frozen=True)
class LoadSpectra:
    """The atmosphere over a passband, in cells of frequency, at elevations that the scan sees.

    Attributes
    ----------
    frequency
        (n,) Hz, of the cells, those at the passband's edges in part; each the mean of what the
        passband lets through of it.
    width, square
        (n,) Hz, integrals of the transmission t and of its square over each cell.
    brightness, transmission
        (k, n) Rayleigh-Jeans brightness [K] and e^-tau at k elevations.
    """

    frequency: Floats
    width: Floats
    square: Floats
    brightness: Floats
    transmission: Floats

    @property
    def emission(self) -> Floats:
        """(k,) mean brightness over the passband, K_RJ."""
        return np.asarray(self.brightness @ self.width / self.width.sum())


INSTANTS = 64
"""Instants of the mean emission, evenly over a scan: it changes with the elevation."""


T = TypeVar("T")


class WhiteLevel(Protocol):
    """The level of a step's white noise (`Observation.noise_levels`)."""

    @property
    def follows_load(self) -> bool:
        """True if it depends on the mean emission or transmission of the atmosphere."""

    def sky_net(self, observation: Observation) -> Floats:
        """(n_det,) K_RJ sqrt(s) on the sky, once every step is configured."""

    def expected_sky_net(self, observation: Observation) -> Floats:
        """About what `sky_net` will be, before."""

    def amplitude(self, observation: Observation) -> SmoothField:
        """rms of one sample at the detector, K_RJ."""


@dataclass(frozen=True)
class ClosedForm:
    """Power spectrum of a component (`Observation.closed_forms`).

    Attributes
    ----------
    spectrum
        Of frequencies (n,) [Hz], one-sided densities (n,) [K_RJ^2/Hz], the mean over detectors.
    shared
        Share of it that all detectors have in common, where they do not look.
    across
        Of frequencies (n,) [Hz] and edges (m + 1,) [1/rad] of wave numbers across the focal plane,
        the densities (n, m) of waves between these; None: detectors have `shared` in common.
    """

    spectrum: Callable[[Floats], Floats]
    shared: float = 0.0
    across: Callable[[Floats, Floats], Floats] | None = None

    def __call__(self, frequency: Floats) -> Floats:
        """See ``spectrum``."""
        return self.spectrum(frequency)


class KeptStreams(MutableMapping[str, AnyFloats]):
    """Streams (n_det, n_samp) by name, whole, float64: each is made when it is asked for. An array
    that a step puts in is that array.

    Attributes
    ----------
    parts
        By name: the stream as it was simulated, and the mean that must be added to it, or None.
    given
        Arrays that steps put in.
    """

    def __init__(self, parts: Mapping[str, tuple[AnyFloats, Any]] | None = None) -> None:
        self.parts = dict(parts or {})
        self.given = dict[str, AnyFloats]()

    @property
    def every(self) -> dict[str, tuple[AnyFloats, Any]]:
        """``parts``, and what is ``given`` likewise."""
        return {**self.parts, **{name: (array, None) for name, array in self.given.items()}}

    def rows(self, name: str, rows: slice) -> Floats:
        """Some detectors of a stream."""
        array, mean = self.every[name]
        found = np.array(array[rows], np.float64)
        if mean is not None:
            first, _, _ = rows.indices(len(array))
            for k, each in enumerate(found, first):
                each += mean.evaluate(slice(k, k + 1), slice(0, each.size))[0]
        return found

    def __getitem__(self, name: str) -> AnyFloats:
        return self.given[name] if name in self.given else self.rows(name, slice(None))

    def __setitem__(self, name: str, stream: AnyFloats) -> None:
        self.parts.pop(name, None)
        self.given[name] = stream

    def setdefault(self, name: str, stream: Any = None) -> Any:
        """The stream, or ``stream``, which is put in: the same for all threads."""
        return self[name] if name in self.parts else self.given.setdefault(name, stream)

    def __delitem__(self, name: str) -> None:
        del (self.given if name in self.given else self.parts)[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.every)

    def __len__(self) -> int:
        return len(self.every)

    def __repr__(self) -> str:
        return f"<KeptStreams: {', '.join(self)}>"


@dataclass
class Observation:
    """One continuous scan.

    Attributes
    ----------
    name, index
        Unique name and position in `Data.observations`.
    start
        Exact start instant.
    seconds
        (n_samp,) float64, increasing, seconds since ``start``: when each sample is taken. They need
        not be a perfect comb: pointing and atmosphere follow them, noise and filters count samples
        (see `jitter`).
    sample_rate
        Hz; of the comb that comes nearest to ``seconds``.
    boresight_azel, boresight_radec
        (n_samp, 4) float64 quaternions (x, y, z, w), exactly TOAST's: Rz(lon) Ry(pi/2 - lat)
        Rz(psi), lon = -az for azel.
    pointed_radec
        (n_samp, 4) where the boresight in fact is on the sky, where a step makes that differ from
        what is recorded; else None.
    centre
        ICRS (ra, dec) [rad] of the scan's target without its per-scan offset: the default map
        centre.
    flags, detector_flags
        (n_samp,) and (n_det,) uint8, bits of `core.flags`; most of them mean: do not use
        (`good_samples`, `good_detectors`).
    intervals
        By TOAST's names: (start, stop) of parts of the scan, s since ``start`` (`core.flags`).
        Default: all is *scanning*.
    weather
        At the telescope; None: not known.
    smooth
        Slowly varying float64 fields: ``atmosphere`` (mean emission at the detector before
        efficiency, K_RJ) and ``transmission`` (band-mean e^-tau at the mean PWV), each a
        `SmoothField`. Set by operators in ``configure``, so that the levels which follow from them
        are known before any step is prepared.
    detdata
        (n_det, n_samp) streams that the run kept.
    expected_load
        Tells the atmosphere's mean emission [K_RJ] and transmission in the middle of the scan,
        before ``smooth`` is known; None: there is no atmosphere.
    load_spectra
        Tells the atmosphere over the passband; None: it is not known, and taken to be flat.
    noise_levels
        Levels of the white noise by step, in their order. Pink noise refers to the last.
    closed_forms
        By component: power spectra on the calibrated sky, one for each step that makes it, of use
        once all steps are prepared.
    quoted_net
        (n_det,) ``focalplane.net`` before a step with white noise set it to what it comes to on the
        sky; None: there is none.
    windows
        By step, (n_samp,) factors by which it multiplied the filtered signals (`window`).
    components
        Names of the streams that the steps make before there is a signal: ``sky``, ``white`` ...
    signals
        Names of the streams of all signals that are formed, the complete one first (`core.signal`).
    unfiltered
        Those of them on which no filter acts.
    log
        What was counted or approximated.
    hwp_angle
        (n_samp,) rad, of a half-wave plate in the focal plane (`core.polarization`); None: there is
        none.
    recorded_azimuth
        (n_samp,) rad, of the mount, as a file states it beside the boresight; None: it follows from
        ``boresight_azel``.
    common
        What is the same for all views of a scan that are made with the same key (`once`); None:
        there is one band.
    output
        Folder (Path) for files that are written while the scan runs (see `Data.output`).
    seen_of
        Samples and sample rate [Hz] of the scan of which this is a look at fewer instants
        (`Operator.check`); None: of itself.
    """

    name: str
    index: int
    site: Site
    instrument: Instrument
    focalplane: Focalplane
    start: Instant
    seconds: Floats
    sample_rate: float
    boresight_azel: Floats
    boresight_radec: Floats
    centre: tuple[float, float]
    seed: int
    flags: Flags = field(default_factory=lambda: np.zeros(0, np.uint8))
    detector_flags: Flags = field(default_factory=lambda: np.zeros(0, np.uint8))
    intervals: Intervals = field(default_factory=dict)
    weather: GroundWeather | None = None
    smooth: dict[str, SmoothField] = field(default_factory=dict)
    detdata: KeptStreams = field(default_factory=KeptStreams)
    noise_levels: dict[str, WhiteLevel] = field(default_factory=dict)
    closed_forms: dict[str, list[ClosedForm]] = field(default_factory=dict)
    quoted_net: Floats | None = None
    log: Log = field(default_factory=Log)
    output: Any = None
    expected_load: Callable[[], tuple[float, float]] | None = None
    load_spectra: Callable[[], LoadSpectra] | None = None
    components: frozenset[str] = frozenset()
    signals: tuple[str, ...] = ("signal",)
    unfiltered: frozenset[str] = frozenset()
    windows: dict[str, Floats] = field(default_factory=dict)
    hwp_angle: Floats | None = None
    pointed_radec: Floats | None = None
    recorded_azimuth: Floats | None = None
    common: dict[Hashable, Any] | None = None
    seen_of: tuple[int, float] | None = None

    def __post_init__(self) -> None:
        if not self.flags.size:
            self.flags = np.zeros(self.n_samples, np.uint8)
        if not self.detector_flags.size:
            self.detector_flags = np.where(self.focalplane.dead != 0, DEAD, 0).astype(np.uint8)
        if not self.intervals:
            self.intervals = {"scanning": intervals_of(np.ones(self.n_samples, bool), self.seconds)}

    @property
    def n_samples(self) -> int:
        return len(self.seconds)

    @property
    def n_detectors(self) -> int:
        return len(self.focalplane)

    def expected_net(self) -> Floats:
        """(n_det,) about what ``focalplane.net`` will be once the steps with white noise are
        prepared.
        """
        levels = [level.expected_sky_net(self) for level in self.noise_levels.values()]
        return np.asarray(reduce(np.hypot, levels) if levels else self.focalplane.net, np.float64)

    @property
    def origin(self) -> tuple[str, str, str]:
        """Names of the telescope, the instrument and the site."""
        return self.instrument.telescope.name, self.instrument.name, self.site.name

    @property
    def good_samples(self) -> Bools:
        """(n_samp,) True where no flag excludes the sample."""
        return good(self.flags, EXCLUDE_SAMPLE)

    @property
    def good_detectors(self) -> Bools:
        """(n_det,) True where no flag excludes the detector."""
        return good(self.detector_flags, EXCLUDE_DETECTOR)

    @property
    def window(self) -> Floats | None:
        """(n_samp,) product of `windows`, 0 to 1, by which maps weigh samples; None: there is
        none.
        """
        return reduce(np.multiply, self.windows.values()) if self.windows else None

    @property
    def duration(self) -> float:
        """n_samples / sample_rate, s."""
        return self.n_samples / self.sample_rate

    @property
    def sampling(self) -> tuple[int, float]:
        """Samples and sample rate [Hz] with which a run takes the scan."""
        return self.seen_of or (self.n_samples, self.sample_rate)

    @property
    def name_of_all_bands(self) -> str:
        """The name of the scan without that of its band."""
        return self.name.removesuffix(f"-{self.instrument.band.name}")

    @classmethod
    def of_bands(cls, scans: Sequence[Observation]) -> Observation:
        """A scan with the detectors of all bands. A sample that one band flags is flagged: the
        bands have no common mode there.
        """
        first = scans[0]
        return replace(
            first,
            name=f"{first.name_of_all_bands}, all bands",
            focalplane=Focalplane.of_bands({str(k): s.focalplane for k, s in enumerate(scans)}),
            flags=np.bitwise_or.reduce([scan.flags for scan in scans]),
            detector_flags=np.concatenate([scan.detector_flags for scan in scans]),
            smooth={},
            detdata=KeptStreams(),
            log=Log(),
        )

    def of_each_band(self) -> list[Observation]:
        """The scan as a camera with each of the instrument's bands alone sees it: its detectors,
        with flags and counts of its own; itself where there is one.

        Raises InputError for a band that has no detector.
        """
        if not self.instrument.bands:
            return [self]
        found = []
        for number, (band, camera) in enumerate(self.instrument.cameras.items()):
            rows = self.focalplane.band == number
            if not rows.any():
                raise InputError(
                    f"the focal plane has no detector of the band {band}",
                    place=f"instrument {camera.name}",
                    cure=(
                        "a class that lays out detectors of several bands joins them with"
                        " Focalplane.of_bands"
                    ),
                )
            view = replace(
                self,
                name=f"{self.name}-{band}",
                instrument=camera,
                focalplane=self.focalplane.of_band(number),
                flags=self.flags.copy(),
                detector_flags=self.detector_flags[rows],
                intervals=dict(self.intervals),
                smooth={},
                detdata=KeptStreams(),
                noise_levels={},
                closed_forms={},
                windows={},
                quoted_net=None,
                expected_load=None,
                load_spectra=None,
                log=Log(),
            )
            found.append(view)
        return found

    def looks_as(self, other: Observation) -> bool:
        """Tell whether the detectors are where those of another band of the scan are."""
        one = self.focalplane
        two = other.focalplane
        return np.array_equal(one.xi, two.xi) and np.array_equal(one.eta, two.eta)

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """Make something that is the same for all bands with this ``key``; it is made by the first
        of them that asks, and released when the last has observed the scan.
        """
        if self.common is None:
            return make()
        if key not in self.common:
            self.common[key] = make()
        found: T = self.common[key]
        return found

    @property
    def departures(self) -> Floats:
        """(n_samp,) s by which samples are later than a comb of `sample_rate` with the same mean;
        zeros for a perfect one.
        """
        late = self.seconds - (self.seconds[0] + np.arange(self.n_samples) / self.sample_rate)
        return np.asarray(late - late.mean(), np.float64) if late.any() else late

    @cached_property
    def jitter(self) -> float:
        """rms of `departures`, s."""
        late = self.departures
        return float(np.sqrt(np.mean(late * late)))

    def seconds_at(self, index: Integers) -> Floats:
        """`seconds` at sample numbers, which go on at `sample_rate` beyond the ends of the scan."""
        inside = np.clip(index, 0, self.n_samples - 1)
        return self.seconds[inside] + (index - inside) / self.sample_rate

    @property
    def sky_boresight(self) -> Floats:
        """(n_samp, 4) as `boresight_radec`: where the telescope in fact looks on the sky."""
        return self.boresight_radec if self.pointed_radec is None else self.pointed_radec

    def thinned(self, at: slice | Indices) -> Observation:
        """The scan at some of its samples alone."""
        each = ("seconds", "boresight_azel", "boresight_radec", "flags",
                "recorded_azimuth", "hwp_angle", "pointed_radec")  # fmt: skip
        held = {name: getattr(self, name) for name in each}
        return replace(self, **{name: x[at] for name, x in held.items() if x is not None})

    def key(self, *names: str | int) -> Key:
        """Random-stream key (2,) uint32 that belongs to this seed, this observation and
        ``names``.
        """
        return stream_key(self.seed, "observation", self.index, *names)

    def detector_key(self, *names: str | int) -> Key:
        """Key of random numbers that belong to the detectors, such as noise and gains. Another
        instrument or another band has numbers of its own.

        The atmosphere is keyed without them: all bands of one seed look through the same.
        """
        return self.key(*self.instrument.identity, *names)

    def camera_key(self, *names: str | int) -> Key:
        """Key of random numbers of detectors that stay from scan to scan, such as time constants
        and sidelobes.
        """
        return stream_key(self.seed, "camera", *self.instrument.identity, *names)

    def derotate(self, which: str) -> tuple[AnyFloats, AnyFloats, AnyFloats]:
        """(lon, lat, psi) of ``boresight_azel`` or ``boresight_radec`` [rad]; for azel lon =
        -azimuth.
        """
        x, y, z, w = getattr(self, which).T
        lat = np.arctan2(1 - 2 * (x * x + y * y), 2 * np.hypot(x * z + w * y, y * z - w * x))
        lon = np.arctan2(2 * (y * z - w * x), 2 * (x * z + w * y))
        psi = np.arctan2(2 * (y * z + w * x), -2 * (x * z - w * y))
        return lon % (2 * np.pi), lat, psi

    @property
    def azimuth(self) -> AnyFloats:
        """(n_samp,) rad, north through east, 0 to below 2 pi; as recorded, where it is."""
        recorded = self.recorded_azimuth
        found = (-self.derotate("boresight_azel")[0] if recorded is None else recorded) % (
            2 * np.pi
        )
        # the remainder of what is a rounding below zero
        return np.where(found < 2 * np.pi, found, 0.0)

    @property
    def elevation(self) -> AnyFloats:
        """(n_samp,) rad."""
        x, y, z, w = self.boresight_azel.T
        return np.asarray(
            np.arctan2(1 - 2 * (x * x + y * y), 2 * np.hypot(x * z + w * y, y * z - w * x)),
            np.float64,
        )

    @property
    def ra(self) -> AnyFloats:
        """(n_samp,) rad, ICRS."""
        return self.derotate("boresight_radec")[0]

    @property
    def dec(self) -> AnyFloats:
        """(n_samp,) rad, ICRS."""
        return self.derotate("boresight_radec")[1]

    def detector_positions(self) -> tuple[Floats, Floats]:
        """(n_det, n_samp) right ascension and declination of each detector, rad, ICRS, as
        recorded.
        """
        from .numerics.projection import directions
        from .numerics.sphere import angles

        plane = self.focalplane
        longitude, dec = angles(directions(self.boresight_radec, plane.xi, plane.eta))
        return longitude % (2 * np.pi), dec

    @property
    def mean_emission(self) -> dict[str, float]:
        """Mean emission of the atmosphere over instants and detectors that are not flagged, K_RJ;
        empty if there is none.

        ``atmosphere`` is <T_atm>, before any efficiency, and ``scan`` the same on the calibrated
        scale, eps illumination and zeta main-beam efficiency:

            T_scan = < eps T_atm / (zeta e^-tau) >.                                              (1)
        """
        smooth = self.smooth
        plane = self.focalplane
        good = self.good_detectors
        if not ({"atmosphere", "transmission"} <= smooth.keys() and good.any()):
            return {}
        every = slice(0, len(plane))
        found = {"atmosphere": 0.0, "scan": 0.0}
        instants = np.unique(((np.arange(INSTANTS) + 0.5) * self.n_samples / INSTANTS).astype(int))
        for t in instants:
            at = slice(int(t), int(t) + 1)
            level = smooth["atmosphere"].evaluate(every, at)[:, 0].astype(np.float64)
            transmission = smooth["transmission"].evaluate(every, at)[:, 0]
            calibrated = level * (
                plane.illumination_efficiency / (plane.main_beam_efficiency * transmission)
            )
            for name, values in (("atmosphere", level), ("scan", calibrated)):
                found[name] += float(values[good].mean()) / len(instants)
        return found

    def plot(self, ax: Any = None) -> Any:
        """Draw the boresight's track on the sky, and beside it in azimuth and elevation; return the
        matplotlib Axes of the former. ``ax``: axes for that alone.
        """
        from .plots import plot_scans

        return plot_scans([self], ax)

    def __repr__(self) -> str:
        return (
            f"<Observation {self.name}: {self.n_detectors} detectors x {self.n_samples} samples at"
            f" {self.sample_rate:g} Hz>"
        )

    def _repr_html_(self) -> str:
        rows = [
            ("instrument", self.instrument.name),
            ("site", self.site.name),
            ("start", str(self.start)),
            ("duration", f"{self.duration:.1f} s at {self.sample_rate:g} Hz"),
            ("detectors", self.n_detectors),
            (
                "elevation",
                (
                    f"{np.degrees(self.elevation.min()):.2f} to"
                    f" {np.degrees(self.elevation.max()):.2f} deg"
                ),
            ),
        ]
        return html_table(f"Observation {self.name}", rows)
