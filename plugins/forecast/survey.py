"""The scans of a pipeline as the forecast needs them: where detectors look on the map, how noisy
they are, what the filters cut. `steps_of` refuses pipelines that the forecast does not cover.

The telescope is pointed and levels of noise are resolved by the pipeline's own steps
(`Operator.observe`, `Operator.configure`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from zonda.core.assembly.signals import note_signals
from zonda.core.configuration.loaded import PipelineFile
from zonda.core.errors import PipelineError
from zonda.core.focalplane import Focalplane
from zonda.core.mapmaker import makes_products
from zonda.core.maps.beams import expected_fwhm
from zonda.core.numerics.projection import frame_rotation, pixel_matrix, ray_coefficients
from zonda.core.numerics.sphere import ARCMIN, FWHM_PER_SIGMA
from zonda.core.observation import Observation, WhiteLevel
from zonda.core.operator import Operator
from zonda.core.output import is_output
from zonda.core.pipeline import Pipeline
from zonda.core.plan.bounds import evenly
from zonda.core.plan.pointing import observed, speeds
from zonda.core.polarization import PolarizationAngles
from zonda.core.scene import Scene
from zonda.core.types import AnyFloats, Floats, Indices
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.operators.filters.brick_wall import plan_highpass
from zonda.operators.filters.common_mode import CommonModeFilter
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.angle_checks import check_polarized
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.maps.grid import TangentGrid, tangent_wcs
from zonda.operators.noise.pink import PinkNoise, PinkSpectrum, level_of
from zonda.operators.noise.planning import calibrated as calibrated_level
from zonda.operators.noise.white import WhiteNoise
from zonda.operators.optics.efficiency import Efficiency
from zonda.operators.optics.polarizers import HalfWavePlate
from zonda.operators.sky.skymap import SkyMap

COVERED: dict[type[Operator], frozenset[str] | None] = {
    AtmosphereLayers: frozenset(AtmosphereLayers.model_fields) - {"beam", "edge_taper"},
    WhiteNoise: frozenset({"net", "reference", "model"}),
    PinkNoise: None,
    Efficiency: frozenset({"main_beam", "illumination"}),
    HighpassFilter: frozenset({"frequency", "degree", "oversampling"}),
    CommonModeFilter: frozenset({"method", "residual", "gap", "on_undetermined"}),
    BinMap: frozenset(
        {
            "pixel",
            "width",
            "height",
            "centre",
            "projection",
            "frame",
            "weights",
            "noise",
            "half_difference",
            "smooth",
            "product",
            "stokes",
            "condition_limit",
        }
    ),
    HalfWavePlate: None,
    SkyMap: None,
}
"""Parameters that may have any value; the others must have their defaults. None: all may."""

BY_SEEDS = "find the noise with `zonda run` and several seeds"
CURE = f"remove it, or {BY_SEEDS}"


@dataclass(frozen=True)
class Steps:
    """The steps that make, filter and map the noise.

    Attributes
    ----------
    operators
        In order; neither sky nor outputs.
    binning
        The map.
    highpass, common
        The filters; None: there is none.
    """

    operators: tuple[Operator, ...]
    binning: BinMap
    highpass: HighpassFilter | None
    common: CommonModeFilter | None

    @classmethod
    def among(cls, operators: Sequence[Operator]) -> Steps:
        """Select the steps that matter; they have one map and at most one of each filter."""
        binning = next(o for o in operators if isinstance(o, BinMap))
        highpass = next((o for o in operators if isinstance(o, HighpassFilter)), None)
        common = next((o for o in operators if isinstance(o, CommonModeFilter)), None)
        return cls(tuple(operators), binning, highpass, common)

    def of(self, kind: type[Any]) -> list[Any]:
        """Steps of one class."""
        return [o for o in self.operators if isinstance(o, kind)]


def steps_of(file: PipelineFile) -> Steps:
    """The steps of a pipeline file that matter for the noise of its map.

    Raises PipelineError for what the forecast does not cover, with the step's name.
    """
    kept: list[Operator] = []
    for step in file.steps:
        operator = step.operator
        if is_output(operator) or type(operator) is SkyMap:
            continue
        if makes_products(operator) and not isinstance(operator, BinMap):
            continue
        if "boresight" not in operator.provides:
            _check(operator, step.key)
        kept.append(operator)
    _check_together(kept, file.header.name)
    return Steps.among(kept)


def _check(operator: Operator, name: str) -> None:
    """Refuse an operator, or a parameter of it, that is not covered."""
    if type(operator) not in COVERED:
        raise PipelineError("the forecast does not cover this step", place=name, cure=CURE)
    free = COVERED[type(operator)]
    if free is None:
        return
    usual = type(operator)()
    for parameter in type(operator).model_fields:
        value = getattr(operator, parameter)
        if parameter not in free | {"name"} and value != getattr(usual, parameter):
            raise PipelineError(
                f"the forecast does not cover {parameter}: {value}",
                place=name,
                cure=f"leave {parameter} out, or {BY_SEEDS}",
            )


def _check_together(steps: Sequence[Operator], name: str) -> None:
    """Refuse what the forecast does not cover of several steps."""
    maps, highpass, common, air, white, pink = (
        [o for o in steps if isinstance(o, kind)]
        for kind in (
            BinMap,
            HighpassFilter,
            CommonModeFilter,
            AtmosphereLayers,
            WhiteNoise,
            PinkNoise,
        )
    )
    one = "have one BinMap"
    for wrong, text, cure in (
        (not maps, "there is no map", one),
        (len(maps) > 1, f"there are {len(maps)} maps, the forecast is of one", one),
        *(
            (len(o) > 1, f"{o[0].label}: there are {len(o)} of them, the forecast covers one", CURE)
            for o in (highpass, common, air)
            if o
        ),
        (not (air or white or pink), "nothing in this pipeline makes noise", "add WhiteNoise"),
        (
            highpass and common and steps.index(common[0]) < steps.index(highpass[0]),
            "the forecast covers a CommonModeFilter only after the HighpassFilter",
            "exchange the two",
        ),
        (
            air and not highpass,
            "without a HighpassFilter the mean emission of the atmosphere, tens of kelvin, is in"
            " the map",
            "add HighpassFilter, or leave AtmosphereLayers out",
        ),
        (
            not common and any(o.shared > 0 for o in pink if isinstance(o, PinkNoise)),
            "noise that detectors share adds up coherently without a CommonModeFilter, which the"
            " forecast does not cover",
            "add CommonModeFilter, or set PinkNoise.shared to 0",
        ),
    ):
        if wrong:
            raise PipelineError(text, place=name, cure=cure)


CONFIGURED = 9
"""Scans whose atmosphere and levels of noise are looked at; the others have those of the nearest.
"""

PER_BEAM, PER_CUT = 2.5, 8.0
"""Instants per beam that is crossed, and per cycle of the high-pass filter's cut, at which scans
are followed.
"""

UNEVEN = 0.05
"""Largest relative scatter of NET between detectors that is taken as none."""

FLAGGED = 0.01
"""Largest share of flagged samples that is taken as none."""

CANCELLED = 1e-9
"""Largest sum of exp(2 i gamma) of detectors that is taken as none."""


@dataclass(frozen=True)
class Noise:
    """One kind of noise of one scan's calibrated samples: white, or 1/f.

    Attributes
    ----------
    sample
        Rms of one sample of the white noise that it refers to, K.
    spectrum
        Its power over that of that white noise at frequencies [Hz]; None: white.
    shared
        Share of the variance that all detectors have in common.
    """

    sample: float
    spectrum: Callable[[Floats], Floats] | None = None
    shared: float = 0.0

    @property
    def part(self) -> str:
        """Part of the map's noise that the step makes."""
        return "white" if self.spectrum is None else "1/f"


@dataclass(frozen=True)
class Track:
    """A scan followed at some instants.

    Attributes
    ----------
    observation
        The scan.
    index
        (n,) sample numbers of the instants, each in the middle of the ``step`` samples that it
        stands for.
    rate
        Of the instants, Hz.
    matrices
        (n, 9): from (xi, eta, 1) to the map's tangent plane, rad from its centre towards west and
        north (`projection`, equation 1).
    """

    observation: Observation
    index: Any
    step: int
    rate: float
    matrices: Floats

    @cached_property
    def centre(self) -> Floats:
        """(n, 2) where the boresight is, rad."""
        h = self.matrices
        return h[:, (2, 5)] / h[:, 8:]

    @cached_property
    def turn(self) -> Floats:
        """(n, 2, 2) derivative of the position by (xi, eta) at the boresight."""
        h = self.matrices
        rows = [h[:, 3 * k : 3 * k + 2] - self.centre[:, k : k + 1] * h[:, 6:8] for k in (0, 1)]
        return np.stack(rows, axis=1) / h[:, 8, None, None]


@dataclass
class Survey:
    """Effect of a pipeline on noise, see `survey_of`.

    Attributes
    ----------
    scene, steps, observations
        The scans have their pointing; those of ``levels`` their levels of noise.
    levels
        For each scan the noises of its samples.
    weights
        (n_scan,) relative weight of a sample in the map.
    configured
        (n_scan,) index of the scan whose atmosphere a scan is taken to have.
    """

    scene: Scene
    steps: Steps
    observations: list[Observation]
    levels: list[tuple[Noise, ...]]
    weights: Floats
    configured: list[int]
    centre: tuple[float, float] | None = None
    """(lon, lat) [rad] in the map's frame of the place looked at; None: the map's centre."""
    _tracks: dict[tuple[int, int], Track] = field(default_factory=dict)

    @property
    def focalplane(self) -> Focalplane:
        """The detectors, those of the first scan."""
        return self.observations[0].focalplane

    @cached_property
    def offsets(self) -> Floats:
        """(n_det, 2) xi and eta."""
        return np.ascontiguousarray(np.stack([self.focalplane.xi, self.focalplane.eta], axis=1))

    @cached_property
    def fwhm(self) -> float:
        """FWHM of the map's beam [rad], `core.maps.beams`: by the weights of the detectors of the
        first scan.
        """
        fwhm = self.focalplane.fwhm
        net = self.focalplane.net
        net = net if self.steps.binning.weights == "inverse_variance" else np.ones(len(net))
        return expected_fwhm(fwhm, net) or self.scene.instrument.beam_fwhm

    @property
    def sigma(self) -> float:
        """Its standard deviation, rad."""
        return self.fwhm / FWHM_PER_SIGMA

    @property
    def cut(self) -> float:
        """Frequency of the high-pass filter, Hz; 0: there is none."""
        return self.steps.highpass.frequency if self.steps.highpass else 0.0

    @property
    def common(self) -> bool:
        """True if the common signal of the detectors is removed; a single detector has none."""
        return self.steps.common is not None and len(self.focalplane) > 1

    @property
    def polarized(self) -> bool:
        """True for a map of I, Q and U."""
        return self.steps.binning.stokes == "IQU"

    @cached_property
    def modulation(self) -> float:
        """Frequency at which a half-wave plate modulates polarization, Hz; 0: there is none that
        turns.
        """
        plates: list[HalfWavePlate] = self.steps.of(HalfWavePlate)
        return 4 * abs(plates[-1].frequency) if plates else 0.0

    @property
    def cancels(self) -> bool:
        """True if unpolarized signals that are the same for detectors at one place, such as the
        atmosphere, are in I alone: alike detectors there have angles of which cos 2 psi and sin 2
        psi add up to zero.
        """
        plane = self.focalplane
        good = self.observations[0].good_detectors
        names = ("xi", "eta", "fwhm", "main_beam_efficiency", "illumination_efficiency")
        seen = np.stack([getattr(plane, name)[good] for name in names], axis=1)
        places, which = np.unique(seen, axis=0, return_inverse=True)
        angles = (plane.polarization_efficiency * np.exp(2j * plane.polarization_angle))[good]
        sums = np.zeros(len(places), complex)
        np.add.at(sums, which.ravel(), angles)
        return bool((abs(sums) < CANCELLED).all())

    @property
    def atmosphere(self) -> AtmosphereLayers | None:
        """The step that makes the atmosphere."""
        found: list[AtmosphereLayers] = self.steps.of(AtmosphereLayers)
        return found[0] if found else None

    @cached_property
    def seconds(self) -> Floats:
        """(n_scan,) integration time after each scan, gaps between them not counted."""
        return np.cumsum([o.duration for o in self.observations])

    @cached_property
    def speed(self) -> float:
        """Median speed of the boresight on the sky, rad/s."""
        each = [speeds(o, evenly(o.n_samples - 1, 2000)) for o in self.observations[:3]]
        found = np.concatenate(each)
        return float(np.median(found)) if found.size else 0.0

    @property
    def rate(self) -> float:
        """Instants per second at which beams and filters are resolved, Hz."""
        return max(PER_BEAM * self.speed / self.fwhm, PER_CUT * self.cut, 1.0)

    def track(self, scan: int, rate: float) -> Track:
        """A scan followed at about ``rate`` [Hz], or at every sample."""
        o = self.observations[scan]
        step = min(max(1, int(o.sample_rate / rate)), max(1, o.n_samples // 16))
        if (scan, step) not in self._tracks:
            index = np.arange(step // 2, o.n_samples // step * step, step)
            grid = self.grid
            plane = tangent_wcs(self.centre or grid.origin, 1.0, (1, 1), grid.frame)
            matrices = np.ascontiguousarray(
                ray_coefficients(o.boresight_radec[index], pixel_matrix(plane)).T
            )
            self._tracks[scan, step] = Track(o, index, step, o.sample_rate / step, matrices)
        return self._tracks[scan, step]

    def filter(self, track: Track, rows: AnyFloats) -> None:
        """The pipeline's high-pass filter on series (n_row, n) at the instants of a track, in
        place.
        """
        if step := self.steps.highpass:
            cut = step.frequency / track.rate
            plan_highpass(len(track.index), cut, step.degree, step.oversampling).apply(rows)

    @property
    def grid(self) -> TangentGrid:
        """The map's pixels. Raises PipelineError where it is not a TAN map."""
        grid = self.steps.binning.grid
        if not isinstance(grid, TangentGrid):
            raise PipelineError(
                "the forecast is made for TAN maps",
                place="zonda sensitivity",
                cure="leave nside and projection of BinMap out",
            )
        return grid

    @property
    def reach(self) -> float:
        """Largest distance of a detector from the place that is looked at, rad."""
        field = float(np.hypot(*self.offsets.T).max()) + 3 * self.fwhm
        tracks = (self.track(k, 1.0) for k in range(len(self.observations)))
        return field + max(float(np.hypot(*t.centre.T).max()) for t in tracks)

    def check_radius(self, radius: float) -> None:
        """Raise PipelineError where a circle [rad] about the map's centre is not on the map."""
        half = min(self.grid.shape) * self.grid.pixel / 2
        if radius > half:
            raise PipelineError(
                f"a circle of radius {radius / ARCMIN:.3g} arcmin is not on the map, which reaches"
                f" {half / ARCMIN:.3g} arcmin from its centre",
                place="zonda sensitivity",
                cure="choose a smaller --radius",
            )


def survey_of(file: PipelineFile, band: str = "") -> Survey:
    """Point the telescope and resolve the noise, as the pipeline's steps do it; nothing is drawn.

    ``band``: the one that is looked at, of a camera with several.

    Raises PipelineError for what the forecast does not cover, and what the steps raise.
    """
    chosen = steps_of(file)
    header = file.header
    pipeline = Pipeline(chosen.operators, name=header.name, precision=header.precision)
    steps = Steps.among(pipeline.operators)  # copies, which know the scans
    data = observed(pipeline.operators, file.scene(), band)
    observations = [_alive(o) for o in data.observations]
    if observations and steps.binning.stokes == "IQU":
        check_polarized(observations[0], steps.binning.label)
    note_signals(observations, pipeline.signals.components, pipeline.signals.formed)
    looked = sparse(len(observations), CONFIGURED)
    for k in looked:
        for operator in pipeline.operators:
            operator.configure(observations[k])
    levels = {k: _noises(steps, observations[k]) for k in looked}
    nearest = [min(looked, key=lambda n: abs(n - k)) for k in range(len(observations))]
    _check_scans(observations, header.name)
    weights = np.ones(len(observations))
    if steps.binning.weights == "inverse_variance":
        nets = np.array([_rms(observations[k].expected_net()) for k in nearest])
        weights = np.where(nets > 0, (nets[0] / np.where(nets > 0, nets, 1.0)) ** 2, 1.0)
    return Survey(data.scene, steps, observations, [levels[k] for k in nearest], weights, nearest)


def sparse(number: int, most: int) -> list[int]:
    """At most so many of the numbers below ``number``, evenly spaced."""
    return sorted({round(k) for k in np.linspace(0, number - 1, min(most, number)).tolist()})


def subset(every: int, number: int, seed: int = 1) -> Indices:
    """At most ``number`` of the numbers below ``every``, drawn at random, in order."""
    few = np.arange(every)
    if number < every:
        few = np.sort(np.random.default_rng(seed).permutation(few)[:number])
    return few


def polarization_angles(survey: Survey, observation: Observation, index: Any) -> PolarizationAngles:
    """Polarization angles of the samples ``index`` (n,), from the meridians of the map's frame."""
    for plate in survey.steps.of(HalfWavePlate):
        plate.configure(observation)
    pole = frame_rotation(survey.steps.binning.frame)[2]
    found = PolarizationAngles.of(observation, observation.boresight_radec[index], pole)
    return (
        found._replace(plate=np.ascontiguousarray(found.plate[:, index]))
        if found.plate.size
        else found
    )


def _alive(observation: Observation) -> Observation:
    """The scan with only those detectors that give data."""
    kept = np.flatnonzero(observation.good_detectors)
    plane = observation.focalplane.rows(kept)
    flags = observation.detector_flags[kept]
    return replace(observation, focalplane=plane, detector_flags=flags)


def _check_scans(observations: Sequence[Observation], name: str) -> None:
    if not observations:
        raise PipelineError(
            "the pointing steps made no observation",
            place=name,
            cure="ask for at least one scan",
        )
    first = observations[0].focalplane.names
    for o in observations:
        if o.focalplane.names != first:
            cure = "forecast them one by one"
            raise PipelineError("scans with other detectors", place=o.name, cure=cure)
        unused = 1 - o.good_samples.mean() * o.good_detectors.mean()
        if unused > FLAGGED:
            share = f"{100 * unused:.3g} % of the samples"
            text = f"{share} are flagged, which the forecast does not cover"
            raise PipelineError(text, place=o.name, cure=BY_SEEDS)


def _noises(steps: Steps, observation: Observation) -> tuple[Noise, ...]:
    """The noises of a configured scan's calibrated samples."""
    found = []
    for white in steps.of(WhiteNoise):
        found.append(Noise(_even(observation, observation.noise_levels[white.label], white.label)))
    for pink in steps.of(PinkNoise):
        if spectrum := PinkSpectrum.of(pink, observation):
            level = _even(observation, level_of(pink, observation), pink.label)
            found.append(Noise(level, _response(spectrum, pink.poles), pink.shared))
    return tuple(found)


def _response(spectrum: PinkSpectrum, poles: int) -> Callable[[Floats], Floats]:
    """Power of pink noise over that of white noise: of the recursive filter that a run uses."""
    law = spectrum.filter(poles)
    frequency = np.geomspace(1e-3 * spectrum.minimum, spectrum.rate / 2, 500)
    table = np.log(spectrum.factor**2 * law.response(frequency / spectrum.rate))
    at = np.log(frequency)
    return lambda f: np.exp(np.interp(np.log(np.maximum(f, frequency[0])), at, table))


def _even(observation: Observation, noise: WhiteLevel, place: str) -> float:
    """The rms of a calibrated sample's white noise, which all detectors have alike."""
    samples = calibrated_level(noise, observation)
    level = _rms(samples)
    if level > 0 and float(np.std(samples)) > UNEVEN * level:
        raise PipelineError(
            "the detectors' NETs differ, which the forecast does not cover",
            place=place,
            cure=f"leave the scatter out, or {BY_SEEDS}",
        )
    return level


def _rms(values: Floats) -> float:
    return math.sqrt(float(np.mean(np.asarray(values) ** 2)))


def elevations(survey: Survey) -> tuple[float, float]:
    """Lowest and highest elevation of the boresight, rad."""
    ends = [survey.observations[k].elevation for k in (0, -1)]
    return min(float(e.min()) for e in ends), max(float(e.max()) for e in ends)
