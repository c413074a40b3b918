"""The map of a `SkyMap` converted to K_RJ, brought onto its grid and convolved with beams; each is
made once and kept.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.target import Target
from zonda.core.data import Block, Data, Log, Observation
from zonda.core.instrument import Band
from zonda.core.maps.header import exact_header
from zonda.core.maps.image import Image
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import AnyFloats, Bools, Floats, Integers

from .beam import REACH, SIGMA, Convolved, convolve, convolve_evenly, distinct
from .geometry import moved, placed
from .gridding import Grid, Gridding, gridded, interpolated, is_resolved, own_pixels, tangent_grid
from .input_map import ImageMap
from .map_header import DOUBT, check_brightness, odd_pixels
from .region import directions_on
from .sampling import Chunks, Rows, pointing, sample
from .sky_input import GAS, SkyInput

BRIGHT = 1e4
"""K_RJ, averaged over a beam, above which a map's unit is doubted: the Sun has 6000 K."""
ZEROED = "pixels of the input map that are NaN or infinite, taken as zero"
LOST = "bright pixels of the input map beyond its projection, whose flux is lost"
POOR = "grid points whose neighbours determine no third-order fit, taken as their mean"


@dataclass(frozen=True)
class Conversion:
    """Conversion from the unit of a map to K_RJ.

    Attributes
    ----------
    factor
        K_RJ per unit, (ny, nx) where pixels differ; K_RJ sr per unit where ``per_area``: then each
        pixel is divided by its own solid angle while it is resampled.
    typical
        K_RJ per unit, at the median pixel where pixels differ.
    text
        For the log.
    """

    factor: float | Floats
    per_area: bool
    typical: float
    text: str


def conversion(grid: Grid, band: Band, spectral_index: float) -> Conversion:
    """Conversion of the map of a grid, averaged over ``band``.

    Raises InputError as `core.numerics.radiation.to_kelvin_rj`.
    """
    source = grid.source
    total = to_kelvin_rj(source.unit, band, 1.0, spectral_index, source.beam_solid_angle)
    if source.unit != "Jy/pixel":
        return Conversion(total, False, total, f"{total:.6g} K_RJ per {source.unit}")
    factor: float | Floats = total
    per_area = grid.resampled and isinstance(source, ImageMap)
    if not grid.resampled:
        areas = tangent_areas(grid.matrix, grid.shape)
        factor = total / areas
    elif per_area:
        some = (
            np.unique(np.linspace(0, n - 1, min(n, 65)).astype(int))
            for n in grid.source.values.shape
        )
        areas = source.areas(tuple(np.meshgrid(*some, indexing="ij")))
    else:
        areas = source.areas((np.zeros(1, np.int64),))
        factor = total / float(areas[0])
    area = float(np.nanmedian(areas))
    text = f"{total / area:.6g} K_RJ per Jy/pixel at the median pixel, {area:.6g} sr"
    return Conversion(factor, per_area, total / area, text)


def tangent_areas(matrix: Floats, shape: tuple[int, int]) -> Floats:
    """Solid angles (ny, nx) [sr] of the pixels of a TAN grid with `pixel_matrix` ``matrix``.

    With H its inverse, a pixel p = (x, y, 1) looks along H p, and dOmega = |det H| / |H p|^3 dx dy.
    """
    inverse, (y, x) = np.linalg.inv(matrix), np.indices(shape, np.float64)
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ inverse.T
    return np.asarray(abs(np.linalg.det(inverse)) / np.linalg.norm(rays, axis=2) ** 3)


@dataclass(frozen=True)
class Brightness:
    """A map in K_RJ on the points of a `Grid`.

    Attributes
    ----------
    planes
        (1 or 3, ny, nx) I, or I, Q and U from the meridians through `Grid.axis`; Q and U are 0
        where nothing is known.
    covered
        (ny, nx), or (0, 0): everywhere.
    notes, counts
        What was chosen, and what was taken for something else, for the log.
    resolution
        FWHM [rad] of the Gaussians with which pixels were gridded; 0: they were not.
    """

    planes: Floats
    covered: Bools
    notes: dict[str, str]
    counts: dict[str, int]
    resolution: float = 0.0

    @property
    def nbytes(self) -> int:
        return self.planes.nbytes + self.covered.nbytes

    def image(self, label: str, grid: Grid) -> Image:
        """The map for pictures and comparisons; NaN where nothing is known. ``label``: the
        operator's.
        """
        header = exact_header(grid.wcs)
        header["BUNIT"], header["TEMPSCAL"], header["OPERATOR"] = "K", "K_RJ", label
        if GAS in self.notes:
            header["GASTEMP"] = self.notes[GAS]
        if self.resolution:
            header["BMAJ"] = header["BMIN"] = float(np.degrees(self.resolution))
        values = self.planes[0]
        if self.covered.size:
            values = np.where(self.covered, values, np.nan)
        polarization = self.planes[1:] if len(self.planes) > 1 else None
        return Image(values, header, "K_RJ", polarization, grid.axis)


@dataclass(frozen=True)
class Beam:
    """A map convolved with one beam.

    Attributes
    ----------
    fwhm
        rad; 0: no beam.
    planes
        I, or I, Q and U, on one grid.
    matrix
        (3, 3) from ICRS directions to the points of the convolved grid.
    covered
        `Brightness.covered` on those points.
    """

    fwhm: float
    planes: tuple[Convolved, ...]
    matrix: Floats
    covered: NDArray[np.uint8]

    @property
    def nbytes(self) -> int:
        return self.covered.nbytes + sum(plane.nbytes for plane in self.planes)

    def tell(self, log: Log, label: str) -> None:
        """State its width and how finely it is sampled."""
        if self.fwhm == 0.0:
            log.state(label, "beam", "none")
            return
        first = self.planes[0]
        text = f"Gaussian, {' x '.join(str(q) for q in first.steps)} grid steps per input pixel"
        if first.coarse:
            text += (
                "; the input has fewer than 2 pixels per FWHM: it is taken as smooth between its"
                " pixels"
            )
        log.state(label, f"beam of {np.degrees(self.fwhm) * 3600:.6g} arcsec", text)

    def pointing(self, block: Block, kind: Any) -> Chunks:
        """`sampling.pointing` of a block, for samples of the type ``kind``."""
        boresight = block.observation.sky_boresight[block.samples]
        quaternions = np.ascontiguousarray(boresight, np.float64)
        first = self.planes[0]
        shape = first.coefficients["float64"].shape
        return pointing(quaternions, self.matrix, shape, first.bounds, kind)

    def add(
        self,
        plane: int,
        chunks: Chunks,
        rows: Rows,
        out: AnyFloats,
        linear: bool,
        over: bool,
    ) -> tuple[int, int]:
        """Add the plane of this number to ``out``, see `sampling.sample`; ``chunks`` by
        `pointing`.
        """
        values = self.planes[plane].coefficients[out.dtype.name]
        return sample(chunks, rows, values, self.covered, out, linear=linear, over=over)


LOOKED_WHOLE = 1 << 28
"""Bytes of a file up to which `zonda check` reads its values."""
SCANS_LOOKED_AT = 8
"""Scans of which `zonda check` lays out the grid."""


class ConvolvedSky(SkyInput):
    """A map of the sky that is convolved with the beams of detectors."""

    def beam_widths(self, observation: Observation) -> tuple[Floats, Integers]:
        """Distinct widths (FWHM, rad; 0: no beam) and the number of each detector's."""
        fwhm = (
            np.full(observation.n_detectors, self.fwhm)
            if self.fwhm is not None
            else observation.focalplane.fwhm
        )
        return (
            (np.zeros(1), np.zeros(len(fwhm), np.int64)) if self.beam == "none" else distinct(fwhm)
        )

    def grid_of(self, observation: Observation) -> Grid:
        """The grid on which the map will be convolved; nothing is computed on it yet."""
        found, _ = self.beam_widths(observation)
        widths = float(found.min(initial=np.inf)), float(found.max(initial=0.0))
        source, identity = self._input(observation.focalplane.polarized)
        band = observation.instrument.band
        key = (*identity, band.frequency.tobytes(), band.transmission.tobytes())
        source = self._in_band(source, key, band)
        if isinstance(source, ImageMap):
            centre = self.centre.icrs() if isinstance(self.centre, Target) else None
            if self.centre == "target" or (centre is None and source.placeless):
                centre = observation.centre
            wcs = placed(source, centre)
            source = moved(source, centre, self.place)
            if wcs is not None:
                own = own_pixels(source, wcs, key)
                reach = REACH * SIGMA * widths[1]
                if not is_resolved(source, widths[0]) or own.is_flat_under(observation, reach):
                    return own
            key = key if centre is None else (*key, centre)
        return tangent_grid(source, observation, widths, self.pixels_per_fwhm, key, self.place)

    def brightness_on(self, grid: Grid, band: Band) -> Brightness:
        """The map on the grid, in K_RJ."""
        return self._brightness(grid, band, grid.gridding)

    def _brightness(self, grid: Grid, band: Band, gridding: Gridding | None) -> Brightness:
        """`brightness_on`, with another gridding of the map's pixels."""

        def make() -> Brightness:
            found = conversion(grid, band, self.spectral_index)
            if not grid.resampled:
                return self._on_own_pixels(grid, found)
            return self._resampled(grid, found, gridding)

        return self._cache.get((*grid.key, gridding), make)

    def _on_own_pixels(self, grid: Grid, found: Conversion) -> Brightness:
        """The values of a TAN image times `scale`. Raises InputError as `check_brightness`."""
        source = grid.source
        planes = [source.values * found.factor * self.scale]
        if source.polarization is not None:
            y, x = np.indices(grid.shape, np.float64)
            turn = between_meridians(directions_on(grid.matrix, x, y), source.turn[2], grid.axis)
            planes += list(turned_by(source.polarization * (found.factor * self.scale), turn))
        made = np.array(planes)
        check_brightness(made, self.place)
        sides = np.linalg.norm(np.asarray(grid.wcs.pixel_scale_matrix), axis=0) * 3600
        what = f"TAN, {grid.size} pixels of {sides[0]:.6g} x {sides[1]:.6g} arcsec"
        notes = {**source.notes, "input map": what, "conversion": found.text}
        return Brightness(made, np.zeros((0, 0), bool), notes, {ZEROED: source.zeroed})

    def _resampled(self, grid: Grid, found: Conversion, gridding: Gridding | None) -> Brightness:
        """The map on a TAN grid, gridded or interpolated; `outside` where it has no data. Raises as
        `_on_own_pixels`.
        """
        assert isinstance(found.factor, float)  # of own pixels alone there is one for each
        source = grid.source
        factor = found.factor * self.scale
        ends = np.array([np.min(source.values, initial=0.0), np.max(source.values, initial=0.0)])
        check_brightness(ends * (found.typical * self.scale), self.place)
        axis = None if source.polarization is None else grid.axis
        counts = {ZEROED: source.zeroed, LOST: source.lost}
        resolution = 0.0
        side = np.degrees(grid.step) * 3600
        where = f"TAN grid of {grid.size} pixels of {side:.6g} arcsec about the observation"
        if grid.tiles is not None:
            where += f", of which {grid.tiles.mean():.0%} is reached"
        progress = self._progress(
            f"{'interpolating' if gridding is None else 'spreading'} {self.source}"
        )
        if gridding is not None:
            how = "its pixels spread, by their own solid angles, over"
            resolution = gridding.resolution
            planes, covered = gridded(
                source,
                grid.wcs,
                gridding,
                factor,
                per_area=found.per_area,
                outside=self.outside,
                tiles=grid.tiles,
                progress=progress,
                axis=axis,
            )
            planes[0] += self.outside
        else:
            how = "interpolated (third order) onto"
            where += "; its error falls with the third power of the input's pixel size"
            planes, covered, counts[POOR] = interpolated(
                source,
                grid.wcs,
                grid.tiles,
                progress,
                found.per_area,
                axis,
            )
            planes *= factor
            planes[0, ~covered] = self.outside
        progress(0, 0)
        what = f"{source.kind}, {how} a {where}"
        notes = {**source.notes, "input map": what, "conversion": found.text}
        mask = np.zeros((0, 0), bool) if covered.all() else covered
        return Brightness(planes, mask, notes, counts, resolution)

    def with_beam(self, grid: Grid, band: Band, fwhm: float) -> Beam:
        """The map convolved with one beam.

        Where the map is gridded the beam is right all over it; else it is that at the
        tangent point.
        """
        linear = self.interpolation == "linear"

        def make() -> Beam:
            sky = self.brightness_on(grid, band)
            evenly = grid.gridding
            if evenly is not None and fwhm != evenly.fwhm and not grid.is_flat:
                evenly = Gridding(fwhm, evenly.share)
                sky = self._brightness(grid, band, evenly)

            def convolved(values: Floats, outside: float) -> Convolved:
                if evenly is not None:
                    return convolve_evenly(
                        values,
                        grid.step,
                        evenly.variance(fwhm),
                        outside,
                        linear,
                    )
                jacobian = np.radians(np.asarray(grid.wcs.pixel_scale_matrix, np.float64))
                return convolve(values, jacobian, fwhm, outside, self.pixels_per_fwhm, linear)

            intensity = convolved(sky.planes[0], self.outside)
            peak = float(np.abs(intensity.coefficients["float64"]).max(initial=0.0))
            if peak > BRIGHT:
                self.warn(
                    f"in the beam the sky is as bright as {peak:.3g} K_RJ, and the Sun has 6000 K;"
                    f" is the map's unit right ({sky.notes['conversion']}), or are its pixels"
                    " counts? `unit` replaces the header's, `scale` multiplies the map"
                )
            planes = intensity, *(convolved(plane, 0.0) for plane in sky.planes[1:])
            covered = intensity.covered(sky.covered)
            return Beam(fwhm, planes, intensity.to_grid @ grid.matrix, covered)

        key = *grid.key, "beam", self.pixels_per_fwhm, self.interpolation, fwhm
        return self._cache.get(key, make)

    def _looked_at(self, data: Data) -> list[str]:
        """Lines of `zonda check` about the map, which the code of a run reads.

        Raises InputError as `SkyMap.prepare`, but for mistakes that convolution alone finds. Of a
        file of more than `LOOKED_WHOLE` bytes the header alone is read.
        """
        instrument = data.scene.instrument
        polarized = (
            any(o.focalplane.polarized for o in data.observations)
            or instrument.focalplane().polarized
        )
        large = self._bytes > LOOKED_WHOLE
        source = (
            self.read_input(polarized, header_alone=True) if large else self._input(polarized)[0]
        )
        if isinstance(source, ImageMap) and self.beam != "none":
            beam = instrument.beam_fwhm if self.fwhm is None else self.fwhm
            if text := odd_pixels(source.sides, source.shape, beam):
                self.warn(text)
        beams = np.array([camera.beam_fwhm for camera in instrument.cameras.values()])
        self.warn_of_beams(source, beams)
        lines = [f"{what}: {text}" for what, text in source.notes.items() if what != DOUBT]
        if large:
            text = f"the values of {self.source} are read by the run alone"
            return [*lines, f"{text}: more than {LOOKED_WHOLE >> 20} MB"]
        for whole in data.observations[:SCANS_LOOKED_AT]:
            for observation in whole.of_each_band():
                grid = self.grid_of(observation)
                found = conversion(grid, observation.instrument.band, self.spectral_index)
                if (gas := grid.source.notes.get(GAS)) and (text := f"{GAS}: {gas}") not in lines:
                    lines.append(text)
                check_brightness(
                    np.abs(grid.source.values).max(initial=0.0, keepdims=True)
                    * (found.typical * self.scale),
                    self.place,
                )
        if not source.values.any() or not self.scale:
            warnings.warn(f"{self.label}: {self.source}: all of its pixels are 0", stacklevel=2)
        return [*lines, *([f"pixels taken as zero: {source.zeroed}"] if source.zeroed else [])]
