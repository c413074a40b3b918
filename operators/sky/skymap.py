"""The sky: a map convolved with each detector's beam and sampled where each detector looks."""

from __future__ import annotations

import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from zonda.core.configuration.files import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle, Kelvin
from zonda.core.data import Block, Data, Observation, percent
from zonda.core.errors import InputError
from zonda.core.knobs import Knob
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.projection import boresights, pixel_matrix, rotation_matrices, share_outside
from zonda.core.operator import Operator
from zonda.core.storage.fits_image import Cards
from zonda.core.types import Floats

from ..maps.image import Image
from .beam import PIXELS_PER_FWHM, REACH, SIGMA, Convolved, convolve, distinct
from .footprint import Footprint, footprint, off_the_map, position
from .inputs import HealpixMap, WcsMap
from .limits import check_brightness
from .linear import sample_linear
from .placement import conversion, kelvin, lost, placed, too_bright, turned
from .read import read_map
from .resample import extremes, nothing, resample_healpix, resample_image
from .sampling import Chunks, pointing, sample
from .stokes import STOKES
from .working import Working, on_a_grid, on_own_pixels

if TYPE_CHECKING:
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate, Traits

TOLD = 1 << 26
"""Bytes of a file above which the progress bar says that it is read."""
ZEROED = "pixels of the input map that are NaN or infinite, taken as zero"
LOST = "bright pixels of the input map beyond its projection, whose flux is lost"
POOR = "grid points whose neighbours determine no third-order fit, taken as their mean"


class SkyMap(Operator):
    """Sky signal of a FITS or HEALPix map, averaged over the band and convolved with the beam, above the atmosphere (K_RJ).

    A TAN image is used on its own pixels; other projections and HEALPix maps are first interpolated (third order) onto a
    TAN grid about the observation. The smoothing by the input's pixels is not undone. Sampling is by cubic B-splines on at
    least `pixels_per_fwhm` points per FWHM: with 4 within 0.3 % of the peak of a point source; or linear (`interpolation`).
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset({"sky"})
    prepares_ahead: ClassVar[bool] = True
    only_tells: ClassVar[bool] = True
    same_in_all_runs: ClassVar[bool] = True
    knobs: ClassVar[tuple[Knob, ...]] = (
        Knob("pixels_per_fwhm", (2, 3, 4, 6, 8), "sky interpolated between points"),
        Knob("interpolation", ("linear", "cubic"), "sky linear between points, not by cubic splines"),
    )

    file: InputPath
    """FITS image (with or without a celestial WCS) or HEALPix table. A relative path starts at the pipeline file's folder."""
    unit: str | None = None
    """Unit of the map: Jy/pixel, Jy/beam, MJy/sr, K_RJ, K_CMB or y (Compton-y), with a prefix (mK_CMB). Default: its header's."""
    pixel_size: Angle | None = Field(None, gt=0)
    """Side of a pixel; replaces the header's scale (its orientation is kept). Default: the header's."""
    centre: Target | Literal["target"] | None = None
    """Put the map's centre here: a position fixed on the sky, or `target` for the scan's. Default: where its header says."""
    input_beam: Angle | None = Field(None, gt=0)
    """Full width at half maximum of the beam that a map in Jy/beam was made with. Default: its header's BMAJ and BMIN."""
    coordsys: Literal["icrs", "galactic", "ecliptic"] | None = None
    """Coordinates of a HEALPix map. Default: its header's COORDSYS."""
    plane: int | tuple[int, ...] | None = None
    """Plane of a cube, counted from 1; of several further axes a list: [12, 1]. Default: the only one, or Stokes I."""
    hdu: int | str | None = None
    """Extension of the file by number (0: the primary one) or name. Default: the first image or HEALPix table."""
    beam: Literal["gaussian", "none"] = "gaussian"
    """Shape of the main beam; `none` for a map that is convolved already."""
    fwhm: Angle | None = Field(None, gt=0)
    """Full width at half maximum of the beam. Default: each detector's own."""
    outside: Kelvin = quantity("0 K")
    """Brightness of the sky beyond the map's edge, K_RJ; samples there are counted."""
    missing: Literal["error", "zero"] = "error"
    """What NaN or infinite pixels do: stop with an error, or count as 0 in the map's unit (and be counted)."""
    scale: float = Field(1.0, ge=-1e30, le=1e30)
    """Factor on the whole map (not on `outside`)."""
    spectral_index: float = Field(0.0, ge=-100, le=100)
    """Slope of the flux density, S ~ frequency^index, within the band; for maps in Jy/pixel, Jy/beam and MJy/sr."""
    pixels_per_fwhm: float = Field(PIXELS_PER_FWHM, ge=2, le=16)
    """Fewest points per FWHM between which the convolved map is interpolated; a finer input is used on its own pixels."""

    interpolation: Literal["cubic", "linear"] = "cubic"
    """By cubic B-splines, or linear with its mean smoothing divided out: within 0.92 / n^2 of a point source's peak, n the points
    per FWHM (0.36 % of it for 16)."""

    _memory: Memory = PrivateAttr(default_factory=lambda: Memory())

    @model_validator(mode="after")
    def _consistent(self) -> SkyMap:
        if self.beam == "none" and self.fwhm is not None:
            raise ValueError("beam: none has no width; remove fwhm, or set beam: gaussian")
        if isinstance(self.centre, Target) and self.centre.frame == "horizontal":
            raise ValueError("centre must be fixed on the sky (ICRS or galactic), not horizontal")
        return self

    def map_centre(self) -> Target:
        """The middle of the input map, for ``target: map``. Raises InputError where it has none of its own."""
        place = f"{self.label}, sky map {self.file}"
        if self.centre == "target":
            cure = "give the target as coordinates, or remove centre: target"
            raise InputError("target: map and centre: target each refer to the other", place=place, cure=cure)
        found = self.centre if isinstance(self.centre, Target) else getattr(self._footprint(), "target", None)
        if found is None:
            cure = "give the target as coordinates"
            raise InputError("the map has no centre on the sky (HEALPix, or no WCS)", place=place, cure=cure)
        return found

    def _footprint(self) -> Footprint | None:
        return footprint(self.file, self.pixel_size, self.centre if isinstance(self.centre, Target) else None, self.hdu)

    def check(self, data: Data) -> list[str]:
        """Whether the scans are about a point of the map, by its header; the share of their samples that is outside."""
        if self.centre == "target" or (found := self._footprint()) is None:
            return []
        for text in dict.fromkeys(off_the_map(found, o.centre, self.label) for o in data.observations):
            if text:
                warnings.warn(text, stacklevel=2)
        lines = [f"centre of the input map: {position(*found.target.icrs())}"]
        if found.matrix is not None and data.observations:
            scans = ((o.boresight_radec, o.focalplane.xi, o.focalplane.eta) for o in data.observations)
            lines.append(f"samples outside the input map: about {percent(share_outside(scans, found.matrix, found.shape), 2)}")
        return lines

    def prepare(self, observation: Observation) -> State:
        widths, index = self._widths(observation)
        working = self._working(observation)
        sky = self._sky(working, observation.instrument.band)
        if not _reaches(observation, working, float(widths.max(initial=0.0))):
            observation.tally.state(self.label, f"{observation.name}: not convolved", "no detector reaches the input map")
            return State(sky, [], index)
        key = (*sky.key, "beam", self.pixels_per_fwhm, self.interpolation)
        beams = [self._memory.get((*key, w), lambda w=w: self._beam(sky, float(w))) for w in widths]  # type: ignore[misc]
        tally = observation.tally
        for what, text in sky.notes.items():
            tally.state(self.label, what, text)
        for what, number in sky.counts.items():
            if number:
                tally.count(self.label, what, number)
        for width, beam in zip(widths, beams, strict=True):
            _state_beam(tally, self.label, float(width), beam.convolved)
        return State(sky, beams, index)

    def exec(self, block: Block, state: State) -> None:
        observation, plane = block.observation, block.observation.focalplane
        over = bool(state.beams) and "sky" not in block.detdata
        stream = block.new("sky", zero=not over)
        index = state.index[block.detectors]
        xi, eta = plane.xi[block.detectors], plane.eta[block.detectors]
        beyond = behind = 0
        if not state.beams:
            beyond, behind = stream.size, _behind(state.sky, observation.boresight_radec[block.samples], xi, eta)
        for number, beam in enumerate(state.beams):
            rows = np.flatnonzero(index == number)
            if rows.size:
                coefficients = beam.convolved.coefficients[stream.dtype.name]
                chunks = state.chunks(block, number, stream.dtype.type)
                interpolate = sample_linear if self.interpolation == "linear" else sample
                found = interpolate(chunks, xi[rows], eta[rows], rows, coefficients, beam.covered, stream, over)
                beyond, behind = beyond + found[0], behind + found[1]
        if self.outside:
            stream += stream.dtype.type(self.outside)
        state.record(block, beyond, behind)

    def collect(self, data: Data, observation: Observation, state: State) -> None:
        beyond, behind = state.totals()
        total = observation.n_detectors * observation.n_samples
        observation.tally.count(self.label, "samples outside the input map", beyond, total)
        if beyond == total:
            ra, dec = np.degrees(observation.centre)
            warnings.warn(
                f"{self.label}: no sample of {observation.name} around RA {ra:.4f} deg, Dec {dec:.4f} deg falls on the input map "
                f"{self.file.name}; `centre: target` moves the map there",
                stacklevel=2,
            )
        if behind:
            observation.tally.count(self.label, "samples more than 90 deg from the input map's centre", behind, total)
        first = data.products.get("input")  # of the first observation, and of the first SkyMap in the pipeline
        key = "input" if first is None or first.header.get("OPERATOR") == self.label else f"input.{self.label}"
        if key not in data.products:
            data.products[key] = state.sky.image(self.label)

    def pack(self, data: Data, first: bool) -> Mapping[str, Any] | None:
        """The input of the very first observation."""
        for key in ("input", f"input.{self.label}"):
            image = data.products.get(key)
            if image is not None and image.header.get("OPERATOR") == self.label:
                del data.products[key]
                wanted = first and not data.run
                return {"key": key, "values": image.values, "header": dict(image.header.items())} if wanted else None
        return None

    def merge(self, data: Data, part: Mapping[str, Any]) -> None:
        """Put it among the products."""
        data.products.setdefault(part["key"], Image(part["values"], Cards(part["header"].items())))

    def memory(self, observation: Observation) -> int:
        """The map, its Fourier transform while it is convolved, and the coefficients of each beam."""
        widths, _ = self._widths(observation)
        working = self._working(observation)
        return (5 + 2 * len(widths)) * working.nbytes + (working.source.nbytes if working.resampled else 0)

    def traits(self, observation: Observation) -> Traits:
        """Largest brightness of the map before the beam."""
        from zonda.core.plan.estimate import Traits

        widths, _ = self._widths(observation)
        working, band = self._working(observation), observation.instrument.band
        if not _reaches(observation, working, float(widths.max(initial=0.0))):
            return Traits(peak=abs(self.outside))
        if not working.resampled:
            return Traits(peak=float(np.nanmax(np.abs(self._sky(working, band).values - self.outside), initial=0.0)))
        factor = self.scale * conversion(working.source, band, self.spectral_index).typical
        return Traits(peak=max(abs(v * factor - self.outside) for v in extremes(working.source, working.wcs, working.tiles)))

    def estimate(self, context: Context) -> Estimate:
        """Beam, sampling, chromaticity."""
        from .estimate import sky_estimate

        widest = float(self._widths(context.first)[0].max(initial=0.0))
        grids = [(o, self._working(o)) for o in context.observations]
        return sky_estimate(self, context, [w for _, w in grids], any(_reaches(o, w, widest) for o, w in grids))

    def _widths(self, observation: Observation) -> tuple[Floats, NDArray[np.int64]]:
        """Distinct beams [rad] and the number of each detector's."""
        fwhm = np.full(observation.n_detectors, self.fwhm) if self.fwhm is not None else observation.focalplane.fwhm
        return (np.zeros(1), np.zeros(len(fwhm), np.int64)) if self.beam == "none" else distinct(fwhm)

    def _working(self, observation: Observation) -> Working:
        """Where the map will be worked on: nothing is convolved or interpolated yet."""
        place, band = f"{self.label}, sky map {self.file}", observation.instrument.band
        widths, _ = self._widths(observation)
        widest, finest = float(widths.max(initial=0.0)), float(widths.min(initial=np.inf))
        stamp = self.file.stat() if self.file.exists() else None
        identity = ("file", stamp and (stamp.st_mtime_ns, stamp.st_size))
        source: WcsMap | HealpixMap = self._memory.get(identity, self._read)
        bandwise: tuple[Hashable, ...] = (*identity, band.frequency.tobytes(), band.transmission.tobytes())
        if isinstance(source, WcsMap):
            centre = self._centre(observation, source)
            wcs = placed(source, centre)
            if wcs is not None:
                return on_own_pixels(source, wcs, bandwise)
            if centre is not None:
                source, bandwise = turned(source, centre, place), (*bandwise, centre)
        return on_a_grid(source, observation, (REACH * SIGMA * widest, finest / self.pixels_per_fwhm), bandwise, place)

    def _sky(self, working: Working, band: Any) -> Sky:
        """The map in K_RJ there, from memory where it has it."""
        make = self._resampled if working.resampled else self._direct
        return cast(Sky, self._memory.get(working.key, lambda: make(working, band)))

    @property
    def wanted(self) -> dict[str, Any]:
        """Attributes of `inputs.Wanted`."""
        plane = (self.plane,) if isinstance(self.plane, int) else self.plane
        names = ("unit", "pixel_size", "missing", "input_beam", "coordsys", "hdu")
        return {"centred": self.centre is not None, "plane": plane} | {name: getattr(self, name) for name in names}

    def _read(self) -> WcsMap | HealpixMap:
        large = self.file.exists() and self.file.stat().st_size > TOLD
        tell = self._teller(f"reading {self.file.name}") if large else nothing
        tell(0, 1)
        source = read_map(self.file, **self.wanted)
        tell(0, 0)
        if STOKES in source.notes:
            warnings.warn(f"{self.label}: {self.file}: {source.notes[STOKES]}", stacklevel=2)
        return source

    def _centre(self, observation: Observation, source: WcsMap) -> tuple[float, float] | None:
        if isinstance(self.centre, Target):
            return self.centre.icrs()
        return observation.centre if self.centre == "target" or source.wcs is None else None

    def _direct(self, working: Working, band: Any) -> Sky:
        source, wcs = cast(WcsMap, working.source), working.wcs
        values, factor = kelvin(source, band, self.spectral_index, wcs)
        pixel = np.linalg.norm(np.asarray(wcs.pixel_scale_matrix), axis=0) * 3600
        notes = {
            **source.notes,
            "input map": f"TAN, {values.shape[1]} x {values.shape[0]} pixels of {pixel[0]:.6g} x {pixel[1]:.6g} arcsec",
            "conversion": factor,
        }
        check_brightness(values * self.scale, f"{self.label}, sky map {self.file}")
        return Sky(working.key, values * self.scale, np.zeros((0, 0), bool), wcs, notes, {ZEROED: source.zeroed})

    def _resampled(self, working: Working, band: Any) -> Sky:
        source, wcs = working.source, working.wcs
        found = conversion(source, band, self.spectral_index)
        least_and_largest = np.array([np.min(source.values, initial=0.0), np.max(source.values, initial=0.0)])
        check_brightness(least_and_largest * (found.typical * self.scale), f"{self.label}, sky map {self.file}")
        tell = self._teller(f"interpolating {self.file.name}")
        counts = {ZEROED: source.zeroed}
        if isinstance(source, HealpixMap):
            kind = f"HEALPix of nside {source.nside}"
            grid, covered, counts[POOR] = resample_healpix(source, wcs, working.tiles, tell)
        else:
            kind = f"projection {', '.join(source.wcs.wcs.ctype)}"
            grid, covered = resample_image(source, wcs, working.tiles, tell, found.per_area)
            counts[LOST] = lost(source)
        tell(0, 0)
        step = abs(float(wcs.wcs.cdelt[1])) * 3600
        part = f", of which {working.points / grid.size:.0%} is reached" if working.tiles is not None else ""
        notes = {
            **source.notes,
            "input map": f"{kind}, interpolated (third order) onto a TAN grid of {grid.shape[1]} x {grid.shape[0]} pixels of "
            f"{step:.6g} arcsec about the observation{part}; its error falls with the third power of the input's pixel size",
            "conversion": found.text,
        }
        mask = np.zeros((0, 0), bool) if covered.all() else covered
        return Sky(working.key, np.where(covered, grid * (found.factor * self.scale), self.outside), mask, wcs, notes, counts)

    def _teller(self, what: str) -> Callable[[int, int], None]:
        """Tells the progress bar."""
        from zonda.core.hooks import manager

        hook, text = manager().hook, f"{self.label}: {what}"
        return lambda done, total: hook.zonda_progress(done=done, total=total, what=text)

    def _beam(self, sky: Sky, fwhm: float) -> Beam:
        """The map convolved with one beam; the Jacobian is that at the tangent point."""
        jacobian = np.radians(np.asarray(sky.wcs.pixel_scale_matrix, np.float64))
        linear = self.interpolation == "linear"
        convolved = convolve(sky.values, jacobian, fwhm, self.outside, self.pixels_per_fwhm, linear)
        if text := too_bright(float(np.abs(convolved.coefficients["float64"]).max(initial=0.0)), sky.notes["conversion"]):
            warnings.warn(f"{self.label}: {self.file}: {text}", stacklevel=2)
        return Beam(convolved, convolved.to_grid @ pixel_matrix(sky.wcs), _on_grid(sky.covered, convolved))


class Memory:
    """What an operator has computed, kept for its next observation. Thread-safe; copies and pickles are empty."""

    def __init__(self, limit: int = 2**30) -> None:
        """``limit``: bytes kept; the values least recently used go first (an observation that needs them holds them itself)."""
        self._limit = limit
        self._lock = threading.RLock()
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The value of ``key``, made where it is not there. Values have ``nbytes``."""
        with self._lock:
            if key not in self._kept:
                self._kept[key] = make()
                while len(self._kept) > 1 and sum(v.nbytes for v in self._kept.values()) > self._limit:
                    self._kept.popitem(last=False)
            value = self._kept[key]
            self._kept.move_to_end(key)
            return value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Memory)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[type[Memory], tuple[int]]:
        return Memory, (self._limit,)


@dataclass(frozen=True)
class Sky:
    """A map in K_RJ, ``values`` (ny, nx), on the TAN grid ``wcs``; ``covered`` (ny, nx), or (0, 0): everywhere."""

    key: tuple[Hashable, ...]
    values: Floats
    covered: NDArray[np.bool_]
    wcs: Any
    notes: dict[str, str]
    counts: dict[str, int]
    """What was taken for something else, for the tally."""

    @property
    def nbytes(self) -> int:
        return self.values.nbytes + self.covered.nbytes

    def image(self, label: str) -> Image:
        """As a product for pictures and comparisons; NaN where nothing is known. ``label``: the operator's."""
        header = self.wcs.to_header(relax=True)
        header["BUNIT"], header["TEMPSCAL"], header["OPERATOR"] = "K", "K_RJ", label
        values = np.where(self.covered, self.values, np.nan) if self.covered.size else self.values
        return Image(values, header, "K_RJ")


@dataclass(frozen=True)
class Beam:
    """A convolved map with the matrix from ICRS directions to its grid."""

    convolved: Convolved
    matrix: Floats
    covered: NDArray[np.uint8]

    @property
    def nbytes(self) -> int:
        return self.covered.nbytes + sum(c.nbytes for c in self.convolved.coefficients.values())


@dataclass(frozen=True)
class _Held:
    chunks: Chunks

    @property
    def nbytes(self) -> int:
        return sum(part.nbytes for part in self.chunks)


@dataclass
class State:
    """What `SkyMap.exec` needs; ``index`` (n_det,) numbers each detector's beam."""

    sky: Sky
    beams: list[Beam]
    index: NDArray[np.int64]
    _counts: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    _chunks: Memory = field(default_factory=lambda: Memory(2**22))

    def chunks(self, block: Block, number: int, kind: Any) -> Chunks:
        """`pointing` of a block for a beam, which blocks of other detectors share."""

        def make() -> _Held:
            quaternions = np.ascontiguousarray(block.observation.boresight_radec[block.samples], np.float64)
            beam = self.beams[number]
            shape = beam.convolved.coefficients["float64"].shape
            return _Held(pointing(quaternions, beam.matrix, shape, beam.convolved.bounds, kind))

        held: _Held = self._chunks.get((block.samples.start, block.samples.stop, number, kind), make)
        return held.chunks

    def record(self, block: Block, beyond: int, behind: int) -> None:
        """Keep a block's counts under its place; a block that is made again is counted once."""
        if not block.again:
            self._counts[block.detectors.start, block.samples.start] = (beyond, behind)

    def totals(self) -> tuple[int, int]:
        counts = list(self._counts.values())
        return sum(c[0] for c in counts), sum(c[1] for c in counts)


def _state_beam(tally: Any, label: str, width: float, convolved: Convolved) -> None:
    if width == 0.0:
        tally.state(label, "beam", "none")
        return
    arcsec = np.degrees(width) * 3600
    grid = " x ".join(str(q) for q in convolved.steps)
    text = f"Gaussian, {grid} grid steps per input pixel"
    if convolved.coarse:
        text += "; the input has fewer than 2 pixels per FWHM: it is taken as smooth between its pixels"
    tally.state(label, f"beam of {arcsec:.6g} arcsec", text)


def _on_grid(covered: NDArray[np.bool_], convolved: Convolved) -> NDArray[np.uint8]:
    """`Sky.covered` on the points of the convolved grid."""
    if not covered.size:
        return np.zeros((0, 0), np.uint8)
    shape = convolved.coefficients["float64"].shape
    whole = np.zeros(shape, np.uint8)
    (qx, qy), (x0, _, y0, _) = convolved.steps, convolved.bounds
    x, y = np.floor((np.arange(shape[1]) - x0) / qx).astype(int), np.floor((np.arange(shape[0]) - y0) / qy).astype(int)
    in_x, in_y = (x >= 0) & (x < covered.shape[1]), (y >= 0) & (y < covered.shape[0])
    whole[np.ix_(in_y, in_x)] = covered[np.ix_(y[in_y], x[in_x])]
    return whole


def _reaches(observation: Observation, working: Working, widest: float) -> bool:
    """Whether any detector comes within the beam's reach of the map."""
    ny, nx = working.shape
    corners = [[-0.5, -0.5], [-0.5, ny - 0.5], [nx - 0.5, -0.5], [nx - 0.5, ny - 0.5], [(nx - 1) / 2, (ny - 1) / 2]]
    lon, lat = np.radians(working.wcs.celestial.wcs_pix2world(corners, 0).T)
    if not np.isfinite([lon, lat]).all():
        return True
    *rim, centre = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]).T
    radius = max(float(np.arccos(np.clip(r @ centre, -1, 1))) for r in rim)
    _, cosine = _cosines(observation, centre)
    nearest = float(np.arccos(np.clip(cosine, -1, 1))) - float(np.arctan(observation.focalplane.radius))
    return bool(nearest <= radius + REACH * SIGMA * widest)


def _cosines(observation: Observation, centre: Floats) -> tuple[float, float]:
    """The least and the largest cosine between the boresight and a direction (3,)."""
    boresight, n = observation.boresight_radec, observation.n_samples
    parts = [centre @ boresights(boresight[some]) for some in chunks(n)]
    return min(float(part.min()) for part in parts), max(float(part.max()) for part in parts)


def _behind(sky: Sky, quaternions: Floats, xi: Floats, eta: Floats) -> int:
    """Samples more than 90 deg from the map's tangent point."""
    lon, lat = np.radians(sky.wcs.wcs.crval)
    tangent = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    along = np.einsum("nij,i->nj", rotation_matrices(quaternions), tangent)  # the tangent point in the boresight's frame
    return int((along @ np.array([-eta, -xi, np.ones(len(xi))]) <= 0).sum())
