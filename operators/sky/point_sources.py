"""Point sources of a catalogue, seen through each detector's Gaussian beam.

A source of flux S at the angle theta from where a detector of FWHM w looks gives

    T = S <c^2 (nu / nu_0)^alpha / (2 k nu^2)> / Omega exp(-4 ln 2 theta^2 / w^2),
    Omega = pi w^2 / (4 ln 2),   (1)

averaged over the band (equation (1) of `core.numerics.radiation`). No grid lies between catalogue
and samples: the flux in a map is the source's within the share of the beam beyond `REACH` standard
deviations, 2e-8.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import Field

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.target import GALACTIC_TO_ICRS
from zonda.core.configuration.units import RadioFrequency
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import InputError
from zonda.core.instrument import Band
from zonda.core.kernels import kernel
from zonda.core.numerics.projection import boresights, rotation_matrices
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.operator import Operator
from zonda.core.plausibility import FLUX, doubt
from zonda.core.storage.table_files import SERIALIZED, read_table
from zonda.core.types import Floats, Integers

REACH = 6.0
"""Standard deviations of the beam beyond which a source is not seen."""

ALIASES = {
    "ra": ("ra", "_ra", "_raj2000", "ra_icrs", "_ra_icrs", "raj2000", "ra_j2000", "radeg",
           "right_ascension", "alpha_j2000"),
    "dec": ("dec", "_de", "_dec", "_dej2000", "de_icrs", "_de_icrs", "dec_icrs", "dej2000",
            "decj2000", "dec_j2000", "de_j2000", "de", "dedeg", "decdeg", "declination", "decl",
            "delta_j2000"),
    "l": ("l", "glon", "gal_lon"),
    "b": ("b", "glat", "gal_lat"),
    "flux": ("flux", "flux_density", "fluxdensity", "flux_jy", "fnu", "f_nu", "s_nu", "snu", "s",
             "total_flux", "int_flux", "integrated_flux", "fint", "sint"),
    "spectral_index": ("spectral_index", "spindex", "sp_index", "spidx", "spix"),
    "frequency": ("frequency", "freq", "nu", "ref_freq", "reference_frequency"),
}  # fmt: skip
"""Names of columns in catalogues, of VizieR, astropy and others, in small letters."""

STEEPEST = 100.0
"""Largest spectral index of a source."""

PIECE = 256
"""Samples for which the sources in view are found together."""


class PointSources(Operator):
    """Point sources of a catalogue above the atmosphere (K_RJ), seen through Gaussian beams: part
    of the component ``sky``.

    The catalogue is a table (ECSV, CSV, IPAC, FITS, VOTable) with the columns `ra` and `dec` (ICRS,
    in degrees or sexagesimal; or Galactic `l` and `b`) and `flux`, with units, by these names or
    VizieR's. Columns `spectral_index` (S ~ frequency^index; otherwise 0) and `frequency` (of the
    flux) are optional, as are their cells.
    """

    requires = frozenset({"boresight"})
    provides = frozenset({"sky"})

    catalogue: InputPath
    """Table of the sources."""
    frequency: RadioFrequency | None = Field(None, gt=0)
    """Frequency of the fluxes, where the catalogue has no column of it. Default: the band's centre.
    """
    scale: float = Field(1.0, ge=-1e30, le=1e30)
    """Factor on all fluxes."""

    def check(self, data: Data) -> list[str]:
        """Number of sources, the brightest flux, columns that are not read. Raises InputError where
        the catalogue is wrong.
        """
        catalogue = Catalogue.read(self)
        for camera in data.scene.instrument.cameras.values() if data is not None else ():
            catalogue.brightness(camera.band, self.scale)
        brightest = float(np.abs(catalogue.flux).max()) * abs(self.scale)
        if text := doubt(
            f"{self.label}: the brightest source of {self.catalogue.name}",
            brightest,
            FLUX,
            "Jy",
        ):
            warnings.warn(text, stacklevel=2)
        unused = [f"not used: {', '.join(catalogue.unused)}"] if catalogue.unused else []
        return [
            (
                f"{len(catalogue.flux)} sources in {self.catalogue}, the brightest of"
                f" {brightest:.4g} Jy"
            ),
            *unused,
        ]

    def prepare(self, observation: Observation) -> Sources:
        """The sources with their brightness, and which of them are in view when."""
        found = Sources.of(self, observation)
        text = f"{len(found.in_view)} of {len(found.power)} in view"
        observation.log.state(self.label, f"{observation.name}: sources", text)
        return found

    def exec(self, block: Block, state: Sources) -> None:
        """Add the sources to ``sky``."""
        boresight = block.observation.sky_boresight[block.samples]
        matrices = rotation_matrices(np.asarray(boresight, np.float64))
        start = block.detectors.start, block.samples.start
        _add_sources(matrices, *start, *state, block.new("sky"))


@dataclass(frozen=True)
class Catalogue:
    """Sources: directions (n, 3), fluxes [Jy] at `frequency` [Hz] (NaN: the band's centre),
    spectral indices; each (n,).

    ``unused``: columns of the table that are not read.
    """

    directions: Floats
    flux: Floats
    index: Floats
    frequency: Floats
    unused: tuple[str, ...] = ()

    @classmethod
    def read(cls, step: PointSources) -> Catalogue:
        """Raises InputError for a table without the columns, or with a declination that there is
        not.
        """
        table = read_table(step.catalogue)
        table.rename(ALIASES)
        frames = [
            str(c.get("frame")) for c in table.meta.get(SERIALIZED, {}).values() if "frame" in c
        ]
        galactic = {"l", "b"} <= table.columns.keys() and "ra" not in table.columns
        for frame in {*frames} - ({"galactic"} if galactic else {"icrs", "fk5"}):
            table.note(-1, f"its positions are {frame}", "give ICRS: coord.icrs in astropy")
        found = {"flux": table.numbers("flux", "Jy")}
        for name, unit, empty in (("spectral_index", "", 0.0), ("frequency", "Hz", math.nan)):
            if name in table.columns:
                found[name] = table.numbers(name, unit, empty)
        lon, lat = ("l", "b") if galactic else ("ra", "dec")
        found["ra"] = ra = table.angles(lon, hours=not galactic)
        found["dec"] = dec = table.angles(lat)
        flux = found["flux"]
        for name, least, most, scale, unit in (
            ("ra", -360.0, 360.0, 180 / np.pi, " deg"),
            ("dec", -90.0, 90.0, 180 / np.pi, " deg"),
            ("spectral_index", -STEEPEST, STEEPEST, 1.0, ""),
            ("frequency", 1e-9, np.inf, 1.0, " Hz"),
        ):
            value = found.get(name, flux[:0]) * scale
            for row in np.flatnonzero((value < least - 1e-10) | (value > most + 1e-10)).tolist():
                text = f"{name} is {value[row]:g}{unit}"
                table.note(row, text, "mend that row, or its unit")
        table.check()
        index = found.get("spectral_index", np.zeros(len(flux)))
        frequency = found.get("frequency", np.full(len(flux), math.nan))
        if step.frequency is not None:
            if np.isfinite(frequency).any():
                raise InputError(
                    "has a column frequency",
                    place=table.place,
                    cure=f"remove {step.label}.frequency, or the column",
                )
            frequency = np.full(len(flux), step.frequency)
        directions = unit_vectors(ra, dec)
        unused = tuple(name for name in table.columns if name not in (*found, lon, lat))
        if galactic:
            directions = directions @ np.array(GALACTIC_TO_ICRS).T
        return cls(directions, flux, index, frequency, unused)

    def brightness(self, band: Band, scale: float) -> Floats:
        """(n,) S <...> of equation (1), K_RJ sr."""
        at_centre = (
            np.where(np.isnan(self.frequency), 1.0, band.centre / self.frequency) ** self.index
        )
        indices, which = np.unique(self.index, return_inverse=True)
        factors = [to_kelvin_rj("Jy/beam", band, None, alpha, 1.0) for alpha in indices.tolist()]
        return np.asarray(scale * self.flux * at_centre * np.array(factors)[which])


class Sources(NamedTuple):
    """Sources and detectors of one scan.

    Attributes
    ----------
    rays, width, per_area
        Of the detectors: (n_det, 3) unit vectors in the boresight's frame, (n_det,) 4 ln 2 / w^2,
        (n_det,) 1 / Omega.
    towards, power
        Of the sources: (n, 3) ICRS, (n,) K_RJ sr.
    first, number
        (n_piece + 1,) where the list of sources of each `PIECE` begins, and the lists.
    """

    rays: Floats
    width: Floats
    per_area: Floats
    towards: Floats
    power: Floats
    first: Integers
    number: Integers

    @classmethod
    def of(cls, step: PointSources, observation: Observation) -> Sources:
        """Sources that come into the field, widened by the beam. Raises InputError as
        `Catalogue.read`.
        """
        catalogue = Catalogue.read(step)
        power = catalogue.brightness(observation.instrument.band, step.scale)
        plane = observation.focalplane
        n = observation.n_samples
        rays = np.stack([-plane.eta, -plane.xi, np.ones(len(plane))], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        widest = float(plane.fwhm.max(initial=0.0))
        field = math.atan(plane.radius) + REACH * widest / math.sqrt(8 * math.log(2))
        lists = [np.zeros(0, np.int64)]
        first = [0]
        for begin in range(0, n, PIECE):
            looks = boresights(observation.sky_boresight[begin : begin + PIECE])
            middle = looks[:, looks.shape[1] // 2]
            reach = float(np.arccos(np.clip(middle @ looks, -1, 1)).max()) + field + 1e-9
            lists.append(
                np.flatnonzero(catalogue.directions @ middle >= math.cos(min(reach, math.pi)))
            )
            first.append(first[-1] + len(lists[-1]))
        area = np.pi * plane.fwhm**2 / (4 * math.log(2))
        lines = 4 * math.log(2) / plane.fwhm**2
        return cls(
            rays,
            lines,
            1 / area,
            catalogue.directions,
            power,
            np.array(first),
            np.concatenate(lists),
        )

    @property
    def in_view(self) -> Integers:
        """Numbers of the sources that come near the field at any time."""
        return np.unique(self.number)


@kernel
def _add_sources(  # type: ignore[no-untyped-def]
    matrices, detector, start, rays, width, per_area, towards, power, first, number, out
):
    """Add equation (1) to ``out`` (n_det, n) from ``detector`` and sample ``start`` on: each sample
    sums over the sources in their order.
    """
    rays, width, per_area = rays[detector:], width[detector:], per_area[detector:]
    farthest = REACH * REACH / 2  # of the exponent
    seen = np.empty(3)
    for t in range(out.shape[1]):
        piece = (start + t) // PIECE
        for k in range(first[piece], first[piece + 1]):
            s = number[k]
            for i in range(3):  # the source in the boresight's frame
                seen[i] = (
                    matrices[t, 0, i] * towards[s, 0]
                    + matrices[t, 1, i] * towards[s, 1]
                    + matrices[t, 2, i] * towards[s, 2]
                )
            for d in range(out.shape[0]):
                x, y, z = seen[0] - rays[d, 0], seen[1] - rays[d, 1], seen[2] - rays[d, 2]
                chord = x * x + y * y + z * z
                exponent = (
                    width[d] * chord * (1 + chord / 12)
                )  # theta^2 = chord^2 (1 + chord^2 / 12 + ...)
                if exponent < farthest:
                    out[d, t] += power[s] * per_area[d] * np.exp(-exponent)
