"""The sky: a map convolved with each detector's beam and sampled where each detector looks."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, Kelvin
from zonda.core.data import Block, Data, Observation
from zonda.core.maps.image import Image
from zonda.core.product import Product
from zonda.core.storage.fits_image import Cards
from zonda.core.types import Floats

from .beam import PIXELS_PER_FWHM, REACH, SIGMA, convolve, distinct
from .brightness import Brightness, conversion, interpolated, on_own_pixels, too_bright
from .grid import Grid
from .map_file import MapFile
from .state import Beam, SkyState

if TYPE_CHECKING:
    from zonda.core.instrument import Band


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


class SkyMap(MapFile):
    """Signal of the sky above the atmosphere (K_RJ), from a FITS or HEALPix map: averaged over the band, convolved with the beam.

    A TAN image is used on its own pixels; other projections and HEALPix maps are first interpolated (third order) onto a
    TAN grid about the observation. The smoothing by the input's pixels is not undone. Sampling is by cubic B-splines on at
    least `pixels_per_fwhm` points per FWHM: with 4 within 0.3 % of the peak of a point source; or linear (`interpolation`).
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset({"sky"})

    beam: Literal["gaussian", "none"] = "gaussian"
    """Shape of the main beam; `none` for a map that is convolved already."""
    fwhm: Angle | None = Field(None, gt=0)
    """Full width at half maximum of the beam. Default: each detector's own."""
    outside: Kelvin = quantity("0 K")
    """Brightness of the sky beyond the map's edge, K_RJ; samples there are counted."""
    scale: float = Field(1.0, ge=-1e30, le=1e30)
    """Factor on the whole map (not on `outside`)."""
    spectral_index: float = Field(0.0, ge=-100, le=100)
    """Slope of the flux density, S ~ frequency^index, within the band; for maps in Jy/pixel, Jy/beam and MJy/sr."""
    pixels_per_fwhm: float = Field(PIXELS_PER_FWHM, ge=2, le=16)
    """Fewest points per FWHM between which the convolved map is interpolated; a finer input is used on its own pixels."""
    interpolation: Literal["cubic", "linear"] = "cubic"
    """By cubic B-splines, or linear with its mean smoothing divided out: within 0.92 / n^2 of a point source's peak, n the points
    per FWHM (0.36 % of it for 16)."""

    @model_validator(mode="after")
    def _no_beam_has_no_width(self) -> SkyMap:
        if self.beam == "none" and self.fwhm is not None:
            raise ValueError("beam: none has no width; remove fwhm, or set beam: gaussian")
        return self

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

    def beams(self, observation: Observation) -> tuple[Floats, NDArray[np.int64]]:
        """Distinct widths (FWHM, rad; 0: no beam) and the number of each detector's."""
        fwhm = np.full(observation.n_detectors, self.fwhm) if self.fwhm is not None else observation.focalplane.fwhm
        return (np.zeros(1), np.zeros(len(fwhm), np.int64)) if self.beam == "none" else distinct(fwhm)

    def grid(self, observation: Observation) -> Grid:
        """Where the map will be convolved: nothing is convolved or interpolated yet."""
        widths, _ = self.beams(observation)
        reach = REACH * SIGMA * float(widths.max(initial=0.0))
        return self.grid_for(observation, (reach, float(widths.min(initial=np.inf)) / self.pixels_per_fwhm))

    def sky(self, grid: Grid, band: Band) -> Brightness:
        """The map there in K_RJ."""

        def make() -> Brightness:
            found = conversion(grid, band, self.spectral_index)
            if not grid.resampled:
                return on_own_pixels(grid, found, self.scale, self.place)
            progress = self._progress(f"interpolating {self.file.name}")
            return interpolated(grid, found, self.scale, self.outside, self.place, progress)

        return cast(Brightness, self._cache.get(grid.key, make))

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
