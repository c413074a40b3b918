"""The sky: a map convolved with each detector's beam and sampled where each detector looks."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from zonda.core.data import Block, Data, Observation
from zonda.core.maps.image import Image
from zonda.core.polarization import PolarizationAngles
from zonda.core.product import Product
from zonda.core.storage.fits_files import header_of

from .convolved import ConvolvedSky
from .input_map import HealpixMap
from .scan_sampler import ScanSampler

POLARIZED = ("polarization", "axis")
"""Fields of an `Image` of I, Q and U."""


class InputImage(Product):
    """The input of the first observation."""

    def __init__(self, image: Image) -> None:
        self.image = image

    def __iadd__(self, other: InputImage) -> InputImage:
        return self

    def arrays(self) -> Mapping[str, Any]:
        """See `Product.arrays`."""
        known = POLARIZED if self.image.polarization is not None else ()
        polarized = {key: getattr(self.image, key) for key in known}
        return {"values": self.image.values, "header": dict(self.image.header.items()), **polarized}

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> InputImage:
        """See `Product.of`."""
        polarized = {key: arrays[key] for key in POLARIZED if key in arrays}
        return cls(Image(arrays["values"], header_of(arrays["header"].items()), **polarized))


class SkyMap(ConvolvedSky):
    """Signal of the sky above the atmosphere (K_RJ), from a FITS or HEALPix map: averaged over the
    band, convolved with the beam.

    Pixels are points, each with its own solid angle: a detector sees their sum under its beam. A
    TAN image is convolved on its own pixels as far as they have one size; the pixels of other
    projections, wider TAN images and HEALPix maps are spread over a TAN grid about the observation
    (without a beam, and with fewer than 2 pixels per FWHM: interpolated, third order). The
    smoothing by the input's pixels is not undone. Sampling is by cubic B-splines on at least
    `pixels_per_fwhm` points per FWHM: with 4 within 0.3 % of the peak of a point source; or linear
    (`interpolation`).

    Polarized detectors see I + p (Q cos 2 psi + U sin 2 psi) of maps of I, Q and U
    (`core.polarization`), whose Q and U are turned to common axes before they are convolved and
    interpolated.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset({"sky"})

    def check(self, data: Data) -> list[str]:
        """See `SkyInput.check`; adds the lines about the map that reading it gives."""
        return [*super().check(data), *self._looked_at(data)]

    def prepare(self, observation: Observation) -> ScanSampler:
        grid, (widths, index) = self.grid_of(observation), self.beam_widths(observation)
        if stated := self.warn_of_beams(grid.source, observation.focalplane.fwhm):
            observation.log.state(self.label, "resolution", stated)
        sky = self.brightness_on(grid, observation.instrument.band)
        state = ScanSampler(grid, sky, [], index)
        if not grid.reached(observation, float(widths.max(initial=0.0))):
            what = f"{observation.name}: not convolved"
            observation.log.state(self.label, what, "no detector reaches the input map")
            return state
        band = observation.instrument.band
        state.beams = [self.with_beam(grid, band, float(fwhm)) for fwhm in widths]
        if sky.polarization is not None:
            state.angles = PolarizationAngles.of(observation, observation.sky_boresight, grid.axis)
        state.tell(observation.log, self.label)
        return state

    def exec(self, block: Block, state: ScanSampler) -> None:
        over = bool(state.beams) and "sky" not in block.detdata
        stream = block.new("sky", zero=not over)
        state.sample(block, stream, self.interpolation == "linear", over)
        if self.outside:
            stream += stream.dtype.type(self.outside)

    def collect(self, data: Data, observation: Observation, state: ScanSampler) -> None:
        self._count(observation, state)
        if self.label not in data.partial:
            image = state.sky.image(self.label, state.grid.axis)
            data.add(self.label, InputImage(image))
            if not data.laid_out:  # pictures of it may be begun
                _show(self.label, data, image)

    def finalize(self, data: Data) -> None:
        """Keep the input of the first observation as the product ``input``, or ``input.LABEL`` of a
        further map.
        """
        show_input(self.label, data)

    def _count(self, observation: Observation, state: ScanSampler) -> None:
        """Count the samples that see no sky, and warn where all of them are."""
        beyond, behind = state.totals()
        total = observation.n_detectors * observation.n_samples
        observation.log.count(self.label, "samples outside the input map", beyond, total)
        if beyond == total:
            ra, dec = np.degrees(observation.centre)
            cure = (
                ""
                if isinstance(state.grid.source, HealpixMap)
                else "; `centre: target` moves the map there"
            )
            warnings.warn(
                f"{self.label}: no sample of {observation.name} around RA {ra:.4f} deg,"
                f" Dec {dec:.4f} deg falls on the input map {self.source}{cure}",
                stacklevel=3,
            )
        if behind:
            observation.log.count(
                self.label, "samples more than 90 deg from the input map's centre", behind, total
            )


def show_input(label: str, data: Data) -> None:
    """Make the partial product of the step ``label`` a product (`SkyMap.finalize`)."""
    found = data.take(label)
    if found is not None:
        _show(label, data, found.image)


def _show(label: str, data: Data, image: Image) -> None:
    taken = "input" in data.products and data.products["input"].header.get("OPERATOR") != label
    data.products.setdefault(f"input.{label}" if taken else "input", image)
