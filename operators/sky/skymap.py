"""The sky: a map convolved with each detector's beam and sampled where each detector looks."""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Mapping
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
from zonda.core.hooks import manager
from zonda.core.maps.image import Image
from zonda.core.numerics.projection import share_outside
from zonda.core.operator import Operator
from zonda.core.product import Product
from zonda.core.storage.fits_image import Cards
from zonda.core.types import Floats

from .beam import PIXELS_PER_FWHM, REACH, SIGMA, convolve, distinct
from .brightness import Brightness, conversion, interpolated, on_own_pixels, too_bright
from .cache import Cache
from .footprint import Footprint, footprint, off_the_map, position
from .grid import Grid, own_pixels, tangent_grid
from .inputs import HealpixMap, WcsMap
from .placement import placed, turned
from .read import read_map
from .resample import Progress, no_progress
from .state import Beam, SkyState
from .stokes import STOKES

if TYPE_CHECKING:
    from zonda.core.instrument import Band

LARGE = 1 << 26
"""Bytes of a file above which the progress bar shows that it is read."""


class InputImage(Product):
    """The input of the first observation."""

    def __init__(self, image: Image) -> None:
        self.image = image

    def __iadd__(self, other: InputImage) -> InputImage:
        return self

    def arrays(self) -> Mapping[str, Any]:
        """See `Product.arrays`."""
        return {"values": self.image.values, "header": dict(self.image.header.items())}

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> InputImage:
        """See `Product.of`."""
        return cls(Image(arrays["values"], Cards(arrays["header"].items())))


class SkyMap(Operator):
    """Signal of the sky above the atmosphere (K_RJ), from a FITS or HEALPix map: averaged over the band, convolved with the beam.

    A TAN image is used on its own pixels; other projections and HEALPix maps are first interpolated (third order) onto a
    TAN grid about the observation. The smoothing by the input's pixels is not undone. Sampling is by cubic B-splines on at
    least `pixels_per_fwhm` points per FWHM: with 4 within 0.3 % of the peak of a point source; or linear (`interpolation`).
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset({"sky"})

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

    _cache: Cache = PrivateAttr(default_factory=Cache)

    @model_validator(mode="after")
    def _consistent(self) -> SkyMap:
        if self.beam == "none" and self.fwhm is not None:
            raise ValueError("beam: none has no width; remove fwhm, or set beam: gaussian")
        if isinstance(self.centre, Target) and self.centre.frame == "horizontal":
            raise ValueError("centre must be fixed on the sky (ICRS or galactic), not horizontal")
        return self

    def map_centre(self) -> Target:
        """The middle of the input map, for ``target: map``. Raises InputError where it has none of its own."""
        if self.centre == "target":
            cure = "give the target as coordinates, or remove centre: target"
            raise InputError("target: map and centre: target each refer to the other", place=self.place, cure=cure)
        found = self.centre if isinstance(self.centre, Target) else getattr(self._footprint(), "target", None)
        if found is None:
            cure = "give the target as coordinates"
            raise InputError("the map has no centre on the sky (HEALPix, or no WCS)", place=self.place, cure=cure)
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

    def prepare(self, observation: Observation) -> SkyState:
        grid, (widths, index) = self.grid(observation), self.beams(observation)
        sky, tally = self.sky(grid, observation.instrument.band), observation.tally
        if not grid.reached(observation, float(widths.max(initial=0.0))):
            tally.state(self.label, f"{observation.name}: not convolved", "no detector reaches the input map")
            return SkyState(grid, sky, [], index)
        beams = [self._beam(sky, float(fwhm)) for fwhm in widths]
        for what, text in sky.notes.items():
            tally.state(self.label, what, text)
        for what, number in sky.counts.items():
            if number:
                tally.count(self.label, what, number)
        for beam in beams:
            beam.tell(tally, self.label)
        return SkyState(grid, sky, beams, index)

    def exec(self, block: Block, state: SkyState) -> None:
        over = bool(state.beams) and "sky" not in block.detdata
        stream = block.new("sky", zero=not over)
        state.sample(block, stream, self.interpolation == "linear", over)
        if self.outside:
            stream += stream.dtype.type(self.outside)

    def collect(self, data: Data, observation: Observation, state: SkyState) -> None:
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
        if self.label not in data.partial:
            image = state.sky.image(self.label)
            data.add(self.label, InputImage(image))
            if not data.laid_out:  # pictures of it may be begun
                self._show(data, image)

    def finalize(self, data: Data) -> None:
        """Keep the input of the first observation as the product ``input``, or ``input.LABEL`` of a further map."""
        found = data.take(self.label)
        if found is not None:
            self._show(data, found.image)

    def _show(self, data: Data, image: Image) -> None:
        taken = "input" in data.products and data.products["input"].header.get("OPERATOR") != self.label
        data.products.setdefault(f"input.{self.label}" if taken else "input", image)

    # -- what planning looks at, too --

    @property
    def place(self) -> str:
        """The map in messages."""
        return f"{self.label}, sky map {self.file}"

    def beams(self, observation: Observation) -> tuple[Floats, NDArray[np.int64]]:
        """Distinct widths (FWHM, rad; 0: no beam) and the number of each detector's."""
        fwhm = np.full(observation.n_detectors, self.fwhm) if self.fwhm is not None else observation.focalplane.fwhm
        return (np.zeros(1), np.zeros(len(fwhm), np.int64)) if self.beam == "none" else distinct(fwhm)

    def grid(self, observation: Observation) -> Grid:
        """Where the map will be convolved: nothing is convolved or interpolated yet."""
        band, (widths, _) = observation.instrument.band, self.beams(observation)
        stamp = self.file.stat() if self.file.exists() else None
        identity = ("file", stamp and (stamp.st_mtime_ns, stamp.st_size))
        source: WcsMap | HealpixMap = self._cache.get(identity, self._read)
        key: tuple[Hashable, ...] = (*identity, band.frequency.tobytes(), band.transmission.tobytes())
        if isinstance(source, WcsMap):
            centre = self.centre.icrs() if isinstance(self.centre, Target) else None
            if self.centre == "target" or (centre is None and source.wcs is None):
                centre = observation.centre
            wcs = placed(source, centre)
            if wcs is not None:
                return own_pixels(source, wcs, key)
            if centre is not None:
                source, key = turned(source, centre, self.place), (*key, centre)
        reach = REACH * SIGMA * float(widths.max(initial=0.0))
        step = float(widths.min(initial=np.inf)) / self.pixels_per_fwhm
        return tangent_grid(source, observation, (reach, step), key, self.place)

    def sky(self, grid: Grid, band: Band) -> Brightness:
        """The map there in K_RJ."""

        def make() -> Brightness:
            found = conversion(grid, band, self.spectral_index)
            if not grid.resampled:
                return on_own_pixels(grid, found, self.scale, self.place)
            progress = self._progress(f"interpolating {self.file.name}")
            return interpolated(grid, found, self.scale, self.outside, self.place, progress)

        return cast(Brightness, self._cache.get(grid.key, make))

    def _read(self) -> WcsMap | HealpixMap:
        large = self.file.exists() and self.file.stat().st_size > LARGE
        progress = self._progress(f"reading {self.file.name}") if large else no_progress
        progress(0, 1)
        given = {name: getattr(self, name) for name in ("unit", "pixel_size", "missing", "input_beam", "coordsys", "hdu")}
        plane = (self.plane,) if isinstance(self.plane, int) else self.plane
        source = read_map(self.file, centred=self.centre is not None, plane=plane, **given)
        progress(0, 0)
        if STOKES in source.notes:
            warnings.warn(f"{self.label}: {self.file}: {source.notes[STOKES]}", stacklevel=2)
        return source

    def _progress(self, what: str) -> Progress:
        """Moves the progress bar."""
        hook, text = manager().hook, f"{self.label}: {what}"
        return lambda done, total: hook.zonda_progress(done=done, total=total, what=text)

    def _beam(self, sky: Brightness, fwhm: float) -> Beam:
        """The map convolved with one beam; the Jacobian is that at the tangent point."""

        def make() -> Beam:
            jacobian = np.radians(np.asarray(sky.wcs.pixel_scale_matrix, np.float64))
            linear = self.interpolation == "linear"
            convolved = convolve(sky.values, jacobian, fwhm, self.outside, self.pixels_per_fwhm, linear)
            if text := too_bright(float(np.abs(convolved.coefficients["float64"]).max(initial=0.0)), sky.notes["conversion"]):
                warnings.warn(f"{self.label}: {self.file}: {text}", stacklevel=2)
            return Beam.of(sky, fwhm, convolved)

        return cast(Beam, self._cache.get((*sky.key, "beam", self.pixels_per_fwhm, self.interpolation, fwhm), make))
