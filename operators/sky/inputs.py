"""Sky maps as their files have them (images and HEALPix maps), and the user's options for reading
them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zonda.core.maps.map_reading import Frame
from zonda.core.types import Floats


@dataclass(frozen=True)
class Wanted:
    """Parameters of `SkyMap` that say how a file is read, angles in rad.

    Attributes
    ----------
    centred
        True where the caller says where the map's centre lies: then the header's position is not
        needed.
    plane
        Of a cube, counted from 1; one number for each axis that is longer than one. None: the only
        one, or that of Stokes I.
    polarized
        True where Q and U are read, too.
    convention
        Of them: `SkyMap.polarization_convention`.
    column
        Of a HEALPix table, by name or counted from 1: the column of I.
    header_alone
        True for a look at a large file: everything but its values is read and checked; they are
        zeros.
    """

    unit: str | None = None
    pixel_size: float | None = None
    centred: bool = False
    missing: Literal["error", "zero"] = "error"
    input_beam: float | None = None
    coordsys: Literal["icrs", "galactic", "ecliptic"] | None = None
    plane: tuple[int, ...] | None = None
    hdu: int | str | None = None
    polarized: bool = False
    convention: Literal["cosmo", "iau"] | None = None
    column: int | str | None = None
    header_alone: bool = False


@dataclass
class WcsMap:
    """An image as its file has it.

    Attributes
    ----------
    values
        (ny, nx) float64 in `unit`; row 0 is the file's first row.
    unit
        ``Jy/pixel``, ``Jy/beam``, ``MJy/sr``, ``K_RJ``, ``K_CMB`` or ``y``.
    wcs
        Two-dimensional celestial `astropy.wcs.WCS`; None where the file has none: then `scale` says
        how large pixels are.
    scale
        (2, 2) rad, where there is no WCS: a step of one pixel along (x, y) moves (east, north) by
        its columns.
    beam_solid_angle
        sr, of the beam of a ``Jy/beam`` map.
    notes
        What was chosen or changed, for the tally.
    zeroed
        Missing pixels set to zero on request.
    turn
        (3, 3) a direction on the sky (ICRS) to the one in the frame of `wcs` at which the image is
        looked up; None: the same one.
    polarization
        (2, ny, nx) Q and U in `unit`, COSMO, from the meridians of the frame of `wcs`; None: there
        are none, or none are wanted.
    beam
        FWHM (major, minor) [rad] of the beam that it was made with; None: the file names none.
    """

    values: Floats
    unit: str
    wcs: Any
    scale: Floats | None
    beam_solid_angle: float | None = None
    notes: dict[str, str] = field(default_factory=dict)
    zeroed: int = 0
    turn: Floats | None = None
    polarization: Floats | None = None
    beam: tuple[float, float] | None = None

    @property
    def nbytes(self) -> int:
        return self.values.nbytes + (0 if self.polarization is None else self.polarization.nbytes)


@dataclass
class HealpixMap:
    """A HEALPix map: ``values[k]`` float64 belongs to pixel ``pixels[k]`` (sorted; the others are
    not covered); None: to pixel k.

    ``pixels`` are numbers in the ordering ``nest``; ``frame`` is an astropy frame name. Other
    attributes as `WcsMap`.
    """

    values: Floats
    pixels: NDArray[np.int64] | None
    nside: int
    nest: bool
    frame: Frame
    unit: str
    beam_solid_angle: float | None = None
    notes: dict[str, str] = field(default_factory=dict)
    zeroed: int = 0
    polarization: Floats | None = None
    beam: tuple[float, float] | None = None

    @property
    def nbytes(self) -> int:
        return self.values.nbytes + sum(
            0 if part is None else part.nbytes for part in (self.pixels, self.polarization)
        )
