"""Base of the steps that make HEALPix maps of the whole sky."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field

from zonda.core.block import Block
from zonda.core.data import Data
from zonda.core.observation import Observation
from zonda.core.operator import Operator
from zonda.core.types import Floats

from .scan_sampler import ScanSampler
from .skymap import SkyMap, show_input


def _power_of_two(value: int) -> int:
    if value & (value - 1):
        raise ValueError(f"nside is a power of two, not {value}")
    return value


Nside = Annotated[int, Field(ge=16, le=8192), AfterValidator(_power_of_two)]
"""Resolution of a HEALPix map of the whole sky."""


class FullSky(Operator):
    """A step whose maps a `SkyMap` samples: that and what it knows of the scan are the state."""

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset({"sky"})

    def exec(self, block: Block, state: tuple[SkyMap, ScanSampler]) -> None:
        """See `SkyMap`."""
        state[0].exec(block, state[1])

    def collect(
        self, data: Data, observation: Observation, state: tuple[SkyMap, ScanSampler]
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
