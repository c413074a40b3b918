"""The map of a `SkyMap` on its grid, in K_RJ and convolved with beams, each made once and kept."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.target import Target
from zonda.core.types import Floats

from .beam import REACH, SIGMA, Convolved, convolve, convolve_evenly, distinct
from .brightness import Brightness, conversion, on_own_pixels, resampled, too_bright
from .geometry import moved, placed
from .grid import Grid, is_resolved, own_pixels, tangent_grid
from .gridding import Gridding
from .input_map import ImageMap
from .map_header import DOUBT, check_brightness, odd_pixels
from .scan_sampler import Beam
from .sky_input import SkyInput

if TYPE_CHECKING:
    from zonda.core.data import Data, Observation
    from zonda.core.instrument import Band

LOOKED_WHOLE = 1 << 28
"""Bytes of a file up to which `zonda check` reads its values."""
SCANS_LOOKED_AT = 8
"""Scans of which `zonda check` lays out the grid."""


class ConvolvedSky(SkyInput):
    """A map of the sky that is convolved with the beams of detectors."""

    def beam_widths(self, observation: Observation) -> tuple[Floats, NDArray[np.int64]]:
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
        if isinstance(source, ImageMap):
            centre = self.centre.icrs() if isinstance(self.centre, Target) else None
            if self.centre == "target" or (centre is None and source.placeless):
                centre = observation.centre
            wcs = placed(source, centre)
            if centre is not None:
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
                return on_own_pixels(grid, found, self.scale, self.place)
            progress = self._progress(
                f"{'interpolating' if gridding is None else 'spreading'} {self.source}"
            )
            return resampled(grid, found, self.scale, self.outside, self.place, progress, gridding)

        return cast(Brightness, self._cache.get((*grid.key, gridding), make))

    def with_beam(self, grid: Grid, band: Band, fwhm: float) -> Beam:
        """The map convolved with one beam.

        Where the map is gridded the beam is right all over it; else it is that at the
        tangent point.
        """
        linear = self.interpolation == "linear"

        def make() -> Beam:
            sky, evenly = self.brightness_on(grid, band), grid.gridding
            if evenly is not None and fwhm != evenly.fwhm and not grid.is_flat:
                evenly = Gridding(fwhm, evenly.share)
                sky = self._brightness(grid, band, evenly)

            def convolved(values: Floats, outside: float) -> Convolved:
                if evenly is not None:
                    return convolve_evenly(
                        values, grid.step, evenly.variance(fwhm), outside, linear
                    )
                jacobian = np.radians(np.asarray(sky.wcs.pixel_scale_matrix, np.float64))
                return convolve(values, jacobian, fwhm, outside, self.pixels_per_fwhm, linear)

            intensity = convolved(sky.values, self.outside)
            if text := too_bright(
                float(np.abs(intensity.coefficients["float64"]).max(initial=0.0)),
                sky.notes["conversion"],
            ):
                self.warn(text)
            more = () if sky.polarization is None else sky.polarization
            return Beam.of(sky, fwhm, (intensity, *(convolved(plane, 0.0) for plane in more)))

        return cast(
            Beam,
            self._cache.get(
                (*grid.key, "beam", self.pixels_per_fwhm, self.interpolation, fwhm), make
            ),
        )

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
                check_brightness(
                    np.array([np.abs(source.values).max(initial=0.0)]) * found.typical * self.scale,
                    self.place,
                )
        if not source.values.any() or not self.scale:
            warnings.warn(f"{self.label}: {self.source}: all of its pixels are 0", stacklevel=2)
        return [*lines, *([f"pixels taken as zero: {source.zeroed}"] if source.zeroed else [])]
