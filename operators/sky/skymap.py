"""The sky: a map convolved with each detector's beam and sampled where each detector looks; base of
the steps that make HEALPix maps of the whole sky.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from zonda.core.data import Block, Data, Log, Observation
from zonda.core.maps.image import Image
from zonda.core.operator import Operator
from zonda.core.polarization import PolarizationAngles
from zonda.core.product import Product
from zonda.core.storage.fits_files import header_of
from zonda.core.types import AnyFloats, Floats, Integers

from .convolved import Beam, Brightness, ConvolvedSky
from .gridding import Grid
from .input_map import HealpixMap
from .sampling import Rows
from .sky_input import Cache

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


@dataclass
class ScanSampler:
    """State for `SkyMap.exec`: samples the convolved maps in the blocks of a scan.

    Attributes
    ----------
    beams
        None where no detector reaches the map.
    index
        (n_det,) number of each detector's beam.
    angles
        Polarization angles of the detectors on the sky, from the meridians of the grid's Q and U;
        None: there are no Q and U.
    """

    grid: Grid
    sky: Brightness
    beams: list[Beam]
    index: Integers
    angles: PolarizationAngles | None = None
    _counts: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    _chunks: Cache = field(default_factory=lambda: Cache(2**22))

    def tell(self, log: Log, label: str) -> None:
        """State what was chosen, and count what was taken for something else."""
        for what, text in self.sky.notes.items():
            log.state(label, what, text)
        for what, number in self.sky.counts.items():
            if number:
                log.count(label, what, number)
        for beam in self.beams:
            beam.tell(log, label)

    def sample(self, block: Block, out: AnyFloats, linear: bool, over: bool) -> None:
        """Add the sky to a block's stream (`sampling.sample`), and count the samples that see
        none.
        """
        plane = block.observation.focalplane
        index = self.index[block.detectors]
        xi = plane.xi[block.detectors]
        eta = plane.eta[block.detectors]
        efficiency = plane.polarization_efficiency[block.detectors]
        beyond = behind = 0
        if not self.beams:
            boresight = block.observation.sky_boresight[block.samples]
            beyond = out.size
            behind = self.grid.behind(boresight, xi, eta)
        for number, beam in enumerate(self.beams):
            rows = np.flatnonzero(index == number)
            if not rows.size:
                continue
            kind = out.dtype.type
            key = block.samples.start, block.samples.stop, number, kind
            # detectors share it
            chunks = self._chunks.get(key, partial(beam.pointing, block, kind))
            found = beam.add(0, chunks, Rows(rows, xi[rows], eta[rows]), out, linear, over)
            beyond = beyond + found[0]
            behind = behind + found[1]
            rows = rows[efficiency[rows] > 0]
            if self.angles is None or not rows.size:
                continue
            # p (Q cos 2 psi + U sin 2 psi), equation (1) of core.polarization
            own = Rows(np.arange(rows.size), xi[rows], eta[rows])
            q, u = (block.buffer(f"sky {name}", (rows.size, out.shape[1])) for name in "QU")
            beam.add(1, chunks, own, q, linear, True)
            beam.add(2, chunks, own, u, linear, True)
            detectors = rows + block.detectors.start
            start = block.samples.start
            self.angles.add(detectors, start, efficiency[rows], (q, u), rows, out)
        if not block.again:  # a block that is made again is counted once
            self._counts[block.detectors.start, block.samples.start] = (beyond, behind)

    def totals(self) -> tuple[int, int]:
        """Samples (outside the input map, more than 90 deg from its centre)."""
        counts = list(self._counts.values())
        return sum(c[0] for c in counts), sum(c[1] for c in counts)


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

    requires = frozenset({"boresight"})
    provides = frozenset({"sky"})

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
        if len(sky.planes) > 1:
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
            image = state.sky.image(self.label, state.grid)
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
                self.label,
                "samples more than 90 deg from the input map's centre",
                behind,
                total,
            )


def show_input(label: str, data: Data) -> None:
    """Make the partial product of the step ``label`` a product (`SkyMap.finalize`)."""
    found = data.take(label)
    if found is not None:
        _show(label, data, found.image)


def _show(label: str, data: Data, image: Image) -> None:
    taken = "input" in data.products and data.products["input"].header.get("OPERATOR") != label
    data.products.setdefault(f"input.{label}" if taken else "input", image)


def _power_of_two(value: int) -> int:
    if value & (value - 1):
        raise ValueError(f"nside is a power of two, not {value}")
    return value


Nside = Annotated[int, Field(ge=16, le=8192), AfterValidator(_power_of_two)]
"""Resolution of a HEALPix map of the whole sky."""


class FullSky(Operator):
    """Base of steps that make HEALPix maps of the whole sky, which a `SkyMap` samples: the state is
    that `SkyMap` and its own state.
    """

    requires = frozenset({"boresight"})
    provides = frozenset({"sky"})

    def exec(self, block: Block, state: tuple[SkyMap, ScanSampler]) -> None:
        """See `SkyMap`."""
        state[0].exec(block, state[1])

    def collect(
        self,
        data: Data,
        observation: Observation,
        state: tuple[SkyMap, ScanSampler],
    ) -> None:
        """See `SkyMap`."""
        state[0].collect(data, observation, state[1])

    def finalize(self, data: Data) -> None:
        """See `SkyMap`."""
        show_input(self.label, data)

    def sampler(self, maps: Floats, unit: str, coordsys: str) -> SkyMap:
        """The step that samples maps (1 or 3, n_pix) of I, or I, Q and U: ring order, COSMO's
        convention, ``coordsys`` C or G.
        """
        found = SkyMap(map=_table(maps, unit, coordsys))
        found._label = self.label
        return found


def _table(maps: Floats, unit: str, coordsys: str) -> Any:
    """The maps as a HEALPix table."""
    import healpy
    from astropy.io import fits

    columns = [
        fits.Column(name, "D", unit=unit, array=values)
        for name, values in zip("IQU", maps, strict=False)
    ]
    table = fits.BinTableHDU.from_columns(columns)
    table.header.update(
        PIXTYPE="HEALPIX",
        ORDERING="RING",
        NSIDE=healpy.npix2nside(maps.shape[1]),
        COORDSYS=coordsys,
    )
    table.header.update(INDXSCHM="IMPLICIT", POLCCONV="COSMO")
    return table
