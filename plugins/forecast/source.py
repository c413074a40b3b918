"""A source behind the filters of a pipeline: what they leave of its peak, and the signal-to-noise
ratio of its peak and of its template.

With s_i the source as the beam of sample i = (detector d, time t) sees it, F the filters of
`detector_noise`, a_i the weights of samples in the map, K the beam about the peak, and n the noise,

    kept     = sum a K F s / sum a K s,   smoothed = sum a K s / sum a K                         (1)
    peak     = |kept smoothed| / depth                                                           (2)
    template = sum a s F s / rms(sum a s F n)                                                    (3)

(2) is the height of the peak in the map that is smoothed with the beam, over the rms there. (3) is
the map multiplied with the source as the beam sees it, unfiltered, and the weights of its pixels.
F is a projection (F F = F), so that for white noise of variance sigma^2 this is the matched filter:
with t the filtered template, N the covariance of the map's pixels, (3) is (t^T N^-1 t)^(1/2),
because t = N (a s / sigma^2). 1/f noise and atmosphere count in the rms, and the weights stay those
of white noise.

(1) is a closed form: the pipeline's own high-pass filter is applied to s along the scans, and the
common mode is the mean of the detectors. It holds for sources that are faint beside what all
detectors see.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from pydantic_core import PydanticCustomError
from scipy.ndimage import correlate1d

from zonda.core.configuration.diagnostics import input_error
from zonda.core.configuration.input_paths import find_in
from zonda.core.configuration.units import Unit
from zonda.core.errors import InputError
from zonda.core.numerics.projection import frame_rotation
from zonda.core.numerics.sphere import angle_between, angle_text, angles, unit_vectors
from zonda.core.types import AnyFloats, Floats, Indices
from zonda.operators.maps.grid import tangent_wcs
from zonda.operators.sky.convolved import Beam, tangent_areas
from zonda.operators.sky.input_map import ImageMap
from zonda.operators.sky.region import directions_on
from zonda.operators.sky.sampling import Rows, pointing
from zonda.operators.sky.skymap import SkyMap

from . import atmosphere_noise, detector_noise
from .default_pipeline import parsed
from .depth import Depth, in_unit, read_depth
from .detector_noise import Comb
from .survey import Survey, Track, sparse, subset

FORMS = "'point', 'gaussian 1 arcmin', 'beta 1 arcmin 0.7', 'disc 30 arcsec', or a FITS map"
PEAKS = "'1 mJy/beam', '0.1 MJy/sr', '200 uK', or '300 uK_CMB'"
PLACE = "--source"
SAMPLES, FEWEST = 4e6, 24
"""Samples (of one scan) of which (1) and (3) are made, and the least number of detectors."""
PER_SOURCE, PER_BEAM, FINEST = 10.0, 3.0, 40.0
"""Pixels per size of a source, and per beam at least and at most."""
OF = ("peak", "template")
"""Parts of a source that have a signal-to-noise ratio."""
_SIGMA = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*(sigma|σ)\s*", re.IGNORECASE)
WIDE = 2.1
"""Half the image of a Gaussian in its FWHM: at its edge it is 5e-6."""


def sigmas(text: str) -> float:
    """A signal-to-noise ratio such as ``5 sigma``; 0 for anything else. Raises InputError for 0
    sigma.
    """
    if (match := _SIGMA.fullmatch(text)) is None:
        return 0.0
    if not float(match[1]) > 0:
        raise InputError(f"{text} is not positive", place="--reach", cure="write e.g. 5 sigma")
    return float(match[1])


class Source(NamedTuple):
    """A source that is asked for.

    Attributes
    ----------
    kind
        ``point``, ``gaussian``, ``beta``, ``disc``, or ``file``.
    size
        FWHM, core radius or diameter, rad.
    slope
        Of a beta model: the profile is (1 + r^2 / size^2)^((1 - 3 slope) / 2), that of the
        Sunyaev-Zel'dovich effect of an isothermal cluster.
    peak, flux
        Brightness at the peak as the beam sees it, before any filter, or flux density: text with
        a unit. Of a file none is needed.
    """

    text: str
    kind: str
    size: float = 0.0
    slope: float = 0.0
    peak: str | None = None
    flux: str | None = None

    @classmethod
    def parse(cls, text: str, peak: str | None = None, flux: str | None = None) -> Source:
        """Read a source from text. Raises InputError for text that names none, and for a
        brightness that is given twice.
        """
        words = str(text).split()
        kind = words[0].lower() if words else ""
        cure = f"write {FORMS}"
        if kind in ("point", "gaussian", "beta", "disc"):
            numbers = words[1:-1] if kind == "beta" else words[1:]
            if (not numbers) != (kind == "point"):
                raise InputError(f"cannot read '{text}' as a source", place=PLACE, cure=cure)
            size = parsed(PLACE, Unit("rad", "1 arcmin").parse, " ".join(numbers)) if numbers else 0
            slope = parsed(PLACE, Unit("", "0.7").parse, words[-1]) if kind == "beta" else 0.0
            if kind != "point" and not size > 0:
                raise InputError(f"'{text}' has no size", place=PLACE, cure=cure)
            if kind == "beta" and not 1 / 3 < slope <= 3:
                text = f"a beta of {slope:g} is outside the limits, above 1/3 and up to 3"
                raise InputError(text, place=PLACE, cure="write e.g. 'beta 1 arcmin 0.7'")
        else:
            kind = "file"
            size = 0.0
            slope = 0.0
        if peak is not None and flux is not None:
            wrong = "the brightness is given twice"
            cure = "give --peak or --flux"
            raise InputError(wrong, place="--peak, --flux", cure=cure)
        if kind == "beta" and flux is not None and slope <= 1:
            wrong = f"the flux of a beta model of {slope:g} grows without limit with its radius"
            raise InputError(wrong, place="--flux", cure="give the brightness of its peak, --peak")
        return cls(" ".join(words), kind, float(size), float(slope), peak, flux)

    @property
    def words(self) -> str:
        """The source in words."""
        size = angle_text(self.size)
        return {
            "point": "point source",
            "gaussian": f"Gaussian of FWHM {size}",
            "disc": f"disc of diameter {size}",
            "beta": f"beta model of core radius {size} and beta {self.slope:g}",
            "file": self.text,
        }[self.kind]  # fmt: skip

    def sky(self, survey: Survey) -> SkyMap:
        """The step that makes it, about the map's centre and of 1 K_RJ at its peak; of a file as it
        says.

        Raises InputError for a source that is larger than the map, and what `SkyMap` raises for a
        file.
        """
        if self.kind == "file":
            try:
                found = SkyMap(file=find_in(None, self.text))
            except PydanticCustomError as err:
                raise input_error(err, PLACE, f"write {FORMS}") from None
            try:
                source = found.read_input()
            except InputError as err:
                raise InputError(
                    err.message,
                    place=f"{PLACE} {self.text}",
                    cure=err.cure or "",
                ) from None
            if isinstance(source, ImageMap) and source.placeless:
                wrong = "it has no world coordinates: where it lies is not known"
                cure = "write CTYPE, CRVAL, CRPIX and CDELT of both axes into its header"
                raise InputError(wrong, place=f"{PLACE} {self.text}", cure=cure)
            return found
        grid = survey.grid
        width = min(grid.shape) * grid.pixel
        if self.size > width:
            wrong = f"a {self.words} is larger than the map, which is {angle_text(width)} wide"
            raise InputError(wrong, place=PLACE, cure="map a larger field")
        fwhm = float(survey.focalplane.fwhm.min())
        pixel = min(fwhm / PER_BEAM, max(self.size / PER_SOURCE, fwhm / FINEST))
        half = {"point": 0.0, "gaussian": WIDE * self.size, "disc": self.size / 2}.get(self.kind)
        number = 2 * math.ceil((survey.reach if half is None else half) / pixel + 0.5) + 1
        y, x = np.indices((number, number)) - number // 2
        r = pixel * np.hypot(x, y)
        if self.kind == "point" or self.size < pixel:
            image = np.where(r > 0, 0.0, 1.0)
        elif self.kind == "gaussian":
            image = np.exp(-4 * math.log(2) * (r / self.size) ** 2)
        elif self.kind == "disc":
            image = np.clip(0.5 + (self.size / 2 - r) / pixel, 0, 1)
        else:
            image = (1 + (r / self.size) ** 2) ** ((1 - 3 * self.slope) / 2)
        wcs = tangent_wcs(grid.origin, pixel, image.shape, grid.frame)
        return SkyMap(map=image, wcs=wcs, unit="K_RJ")


@dataclass(frozen=True)
class Seen:
    """A source in the map of a pipeline, see the equations of this module.

    Attributes
    ----------
    source
        What was asked for.
    sky
        The step that makes it.
    centre
        (lon, lat) of its peak [rad], in the map's frame.
    away
        Angle of the peak from the map's centre, rad.
    peak, smoothed
        K_RJ at its peak as the beam sees it, and in the map smoothed with the beam, both before the
        filters.
    seconds
        (n_scan,) integration time after each scan.
    kept
        (n_scan,) share of ``smoothed`` that the filters leave; NaN before anything is seen.
    template
        (n_scan,) equation (3) for the whole source.
    """

    source: Source
    sky: SkyMap
    centre: tuple[float, float]
    away: float
    peak: float
    smoothed: float
    seconds: Floats
    kept: Floats
    template: Floats

    def left(self, seconds: Floats | float) -> Floats:
        """K_RJ of the peak in the filtered and smoothed map after ``seconds``."""
        fine = np.isfinite(self.kept)
        kept = np.interp(seconds, self.seconds[fine], self.kept[fine])
        return np.asarray(self.smoothed * kept)

    def snr(self, depth: Depth, seconds: Floats | float, of: str = "peak") -> Floats:
        """Signal-to-noise ratio after ``seconds``: of the ``peak`` (2), or of the ``template`` (3);
        beyond the scans, and before the first, it grows as time^1/2. NaN: not forecast.

        Raises InputError for another ``of``.
        """
        if of not in OF:
            raise InputError(
                f"no S/N of {of!r}",
                place="sensitivity",
                cure=f"choose: {', '.join(OF)}",
            )
        if of == "peak":
            return abs(self.left(seconds)) / depth.total(seconds)
        wanted = np.asarray(seconds, np.float64)
        rate = np.interp(wanted, self.seconds, self.template**2 / self.seconds)
        return np.sqrt(rate * wanted)

    def reach(self, depth: Depth, sigma: float, of: str = "peak") -> float:
        """Integration time [s] after which the signal-to-noise ratio is ``sigma``; NaN: it is not
        forecast.
        """
        start, end = (float(self.seconds[k]) for k in (0, -1))
        if math.isnan(float(self.snr(depth, end, of))):
            return math.nan
        for seconds, beyond in ((end, sigma.__ge__), (start, sigma.__le__)):
            if beyond(found := float(self.snr(depth, seconds, of))):
                return seconds * (sigma / found) ** 2 if found > 0 else math.inf
        fine = np.geomspace(start, end, 2000)
        return float(fine[np.argmax(self.snr(depth, fine, of) >= sigma)])

    def lines(self, factors: Mapping[str, float]) -> list[str]:
        """The source in words, and which signal-to-noise ratios it has. ``factors``: as
        `depth.factors`.
        """
        where = "at the map's centre"
        if self.source.kind == "file":
            where = f"peak {angle_text(self.away)} from the map's centre"
        unit = next((u for u in factors if str(self.source.peak).endswith(u)), "Jy/beam")
        seen = in_unit(self.peak * factors[unit], unit)
        return [
            f"source: {self.source.words}, {where}, {seen} ({in_unit(self.peak, 'K_RJ')}) at its"
            " peak as the beam sees it",
            f"  of its peak in the map smoothed with the beam, {in_unit(self.smoothed, 'K_RJ')},"
            f" the filters leave {100 * self.kept[-1]:.3g} % (closed form)",
            "  S/N of the peak: its height behind the filters in that map, over the rms there",
            "  S/N of the template: the sum over the map of signal, weight and source as the beam"
            " sees it, unfiltered, over",
            "  the rms that all noise gives this sum (behind white noise sqrt(t^T N^-1 t), t the"
            " filtered template)",
        ]

    def draw(self, ax: Any, depth: Depth, seconds: Floats) -> None:
        """Draw the signal-to-noise ratios against time."""
        for of, color in zip(OF, ("#0072B2", "#009E73"), strict=True):
            ratio = self.snr(depth, seconds, of)
            ax.plot(seconds / 3600, ratio, lw=2, color=color, label=of)
        ax.axhline(5, color="black", lw=0.8, ls=":", label="5 sigma")
        ax.set(xscale="log", yscale="log", xlabel="integration time [h]", ylabel="S/N")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter("{x:g}")
        ax.grid(alpha=0.25, lw=0.5, which="both")
        ax.legend(frameon=False)
        kept = f"{100 * self.kept[-1]:.3g} % of its peak left"
        ax.set_title(f"{self.source.words}: {kept}", fontsize=10)


@dataclass(frozen=True)
class Placed:
    """A source on the map of a pipeline: the step that makes it, (lon, lat) of its peak [rad] in
    the map's frame, the peak's angle from the map's centre [rad], and its height as the beam sees
    it [K_RJ].
    """

    source: Source
    sky: SkyMap
    centre: tuple[float, float]
    away: float
    peak: float

    @classmethod
    def of(
        cls,
        survey: Survey,
        source: Source,
        factors: Mapping[str, float] | None = None,
    ) -> Placed:
        """Find the peak of a source on the map, and scale it to the brightness that is asked for.

        ``factors``: as `depth.factors`; None: it stays as `Source.sky` makes it.

        Raises InputError as `Source.sky`, for a peak that is not on the map, and a brightness that
        is not known.
        """
        sky = source.sky(survey)
        grid = survey.grid
        sky._label = "SkyMap"
        o = survey.observations[0]
        grid_of_sky = sky.grid_of(o)
        band = o.instrument.band
        beam = sky.with_beam(grid_of_sky, band, survey.fwhm)
        values = _values(beam)
        at = np.unravel_index(int(np.argmax(abs(values))), values.shape)
        peak = float(values[at])
        towards = directions_on(beam.matrix, *(np.array([float(k)]) for k in at[::-1]))
        found = cls(source, sky, grid.origin, 0.0, peak)
        if source.kind == "file":
            found = found._where_it_is(survey, towards[0])
        return found if factors is None else found._as_bright(survey, factors)

    def _where_it_is(self, survey: Survey, towards: Floats) -> Placed:
        """The source with the place of its peak. ``towards`` (3,): the peak's ICRS direction."""
        grid = survey.grid
        half = min(grid.shape) * grid.pixel / 2
        lon, lat = (float(v) for v in angles(frame_rotation(grid.frame) @ towards))
        away = float(angle_between(unit_vectors(lon, lat), unit_vectors(*grid.origin)))
        if self.peak == 0 or away > half:
            wrong = "nothing of it is on the map"
            if self.peak:
                wrong = (
                    f"its peak is {angle_text(away)} from the map's centre, and not on the map,"
                    f" which reaches {angle_text(half)}"
                )
            cure = "cut the file, or let the pipeline's target be its peak"
            raise InputError(wrong, place=f"{PLACE} {self.source.text}", cure=cure)
        return replace(self, centre=(lon, lat), away=away)

    def _as_bright(self, survey: Survey, factors: Mapping[str, float]) -> Placed:
        """The source with the brightness that is asked for."""
        source = self.source
        if source.peak is not None:
            units = {unit: factor for unit, factor in factors.items() if unit != "Jy"}
            ratio = read_depth(source.peak, units, "--peak", "a peak", PEAKS) / self.peak
        elif source.flux is not None:
            omega = math.pi * survey.fwhm**2 / math.log(16)
            units = {"Jy": factors["Jy/beam"] / omega}  # per K_RJ sr
            ratio = read_depth(source.flux, units, "--flux", "a flux", "'1 mJy'") / self._sum(
                survey
            )
        elif source.kind == "file":
            return self
        else:
            cure = "give --peak or --flux, e.g. --peak '1 mJy/beam'"
            raise InputError("its brightness is not given", place=PLACE, cure=cure)
        # a copy of a step keeps what it has computed, unless it is a deep one
        sky = self.sky.model_copy(update={"scale": self.sky.scale * ratio}, deep=True)
        return replace(self, sky=sky, peak=self.peak * ratio)

    def _sum(self, survey: Survey) -> float:
        """Integral of its brightness, K_RJ sr."""
        source = self.source
        o = survey.observations[0]
        if source.kind == "beta":
            return 2 * math.pi * source.size**2 / (3 * source.slope - 3)
        grid = self.sky.grid_of(o)
        values = self.sky.brightness_on(grid, o.instrument.band).planes[0]
        found = float((np.nan_to_num(values) * tangent_areas(grid.matrix, grid.shape)).sum())
        if not found * self.peak > 0:
            wrong = "the sum over its pixels has not the sign of its peak"
            raise InputError(wrong, place=f"{PLACE} {source.text}", cure="give --peak, not --flux")
        return found

    def seen(self, survey: Survey, noisy: float = 1.0, air: bool = False) -> Seen:
        """Follow it through the scans and filters of a pipeline, whose `Survey.centre` is its peak.

        ``noisy``: variance of the map's white and 1/f noise over that of a map of I alone; 0: the
        template is NaN. ``air``: the atmosphere counts. Raises InputError where nothing of it is
        seen.
        """
        sums = _sums(survey, self.sky, noisy, air)
        with np.errstate(invalid="ignore", divide="ignore"):
            kept = sums.kept / sums.whole
            smoothed = float(sums.whole[-1] / sums.weight[-1])
        if not math.isfinite(kept[-1]):
            cure = "choose a source that the scans cross"
            raise InputError("nothing of it is observed", place=PLACE, cure=cure)
        where = (self.source, self.sky, self.centre, self.away, self.peak, smoothed)
        return Seen(*where, survey.seconds, kept, sums.template)


class _Sums(NamedTuple):
    """Sums of (1) over samples up to the end of each scan, (n_scan,), and (3)."""

    kept: Floats
    whole: Floats
    weight: Floats
    template: Floats


def _sums(survey: Survey, sky: SkyMap, noisy: float, air: bool) -> _Sums:
    """Sums over some scans and detectors, which stand for all.

    What detectors have in common is the mean of the n that are followed, of N: a product of two
    series without it is too small by the factor 1 + (1 - n / N) / (n - 1).
    """
    number = len(survey.observations)
    every = len(survey.offsets)
    scans = sparse(number, detector_noise.FILTERED)
    tracks = [survey.track(k, survey.rate) for k in scans]
    most = max(len(t.index) for t in tracks)
    few = subset(every, max(FEWEST, round(SAMPLES / most)))
    comb = Comb(np.zeros(2), 1.0, np.ones((1, 1), np.bool_))
    one = np.ones((1, 1))
    stands = every / len(few)
    gain = 1.0
    if survey.common and len(few) < every:
        gain += (1 - len(few) / every) / (len(few) - 1)
    rows = []
    for scan, track in zip(scans, tracks, strict=True):
        source = series(sky, survey, track, few)
        near = detector_noise.kernels(survey, comb, one, track, few)
        left = source.copy()
        survey.filter(track, left)
        if survey.common:
            left -= left.mean(axis=0)
        frequency, energy = detector_noise.energies(left, track.rate)
        variance = 0.0
        for noise in survey.levels[scan]:
            own = noise.sample**2 * (1 - noise.shared if survey.common else 1.0)
            variance += own * float(energy @ detector_noise.over_white(noise, frequency))
        weight = survey.weights[scan] * track.step * stands
        each = [gain * _dot(near, left), _dot(near, source), float(near.sum(dtype=np.float64))]
        each += [gain * _dot(source, left), survey.weights[scan] * gain * noisy * variance]
        rows.append([weight * value for value in each])
    summed = np.array(
        [np.interp(np.arange(number), scans, column) for column in zip(*rows, strict=True)]
    )
    kept, whole, near, signal, variance = np.cumsum(summed, axis=1)
    template = np.full(number, np.nan)
    if noisy:
        with np.errstate(invalid="ignore", divide="ignore"):
            template = variance / signal**2
        if air:
            given = atmosphere_noise.Template(partial(series, sky, survey), signal)
            template += atmosphere_noise.variance(survey, survey.sigma, template=given).variance
        with np.errstate(divide="ignore"):
            template = 1 / np.sqrt(template)
    return _Sums(kept, whole, near, template)


def _values(beam: Beam) -> Floats:
    """(ny, nx) the convolved map of I at its points, of the coefficients of its cubic splines."""
    values = beam.planes[0].coefficients["float64"]
    for axis in (0, 1):
        values = correlate1d(values, np.array([1, 4, 1]) / 6, axis, mode="constant")
    return np.asarray(values, np.float64)


def _dot(a: AnyFloats, b: AnyFloats) -> float:
    return float(np.einsum("dt,dt->", a, b, dtype=np.float64))


def series(sky: SkyMap, survey: Survey, track: Track, few: Indices) -> AnyFloats:
    """(n_det, n_instant) K_RJ that some detectors (numbers) see of a source along a track, as
    `SkyMap` samples it.
    """
    o = track.observation
    offsets = survey.offsets[few]
    state = sky.prepare(o)
    out = np.zeros((len(few), len(track.index)), np.float32)
    boresight = np.ascontiguousarray(o.sky_boresight[track.index], np.float64)
    for number, beam in enumerate(state.beams):
        rows = np.flatnonzero(state.index[few] == number)
        first = beam.planes[0]
        shape = first.coefficients["float64"].shape
        chunks = pointing(boresight, beam.matrix, shape, first.bounds, np.float32)
        beam.add(0, chunks, Rows(rows, *offsets[rows].T), out, linear=False, over=False)
    return out
