"""The parameters of `SkyMap`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self, cast

from pydantic import Field, PrivateAttr, model_validator

from zonda.core.configuration.files import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle, Kelvin
from zonda.core.operator import Operator
from zonda.core.storage.files import atomic_path

from .array_map import ArrayMap, WorldCoordinates, checked_unit
from .beam import PIXELS_PER_FWHM
from .state import Cache


class SkyParameters(Operator):
    """Parameters of `SkyMap`. What is computed of the map is kept from observation to
    observation.
    """

    file: InputPath | None = None
    """FITS image (with or without a celestial WCS) or HEALPix table. A relative path starts at the
    pipeline file's folder.
    """
    map: ArrayMap | None = None
    """In Python, in place of `file`: a numpy array (ny, nx), or (3, ny, nx) of I, Q and U, an
    astropy Quantity, or an HDU. Row 0 is the southern one."""
    wcs: WorldCoordinates | None = None
    """World coordinates of `map`: an astropy WCS, or FITS keywords. Without: give pixel_size and
    centre.
    """
    unit: str | None = None
    """Unit of the map: Jy/pixel, Jy/beam, MJy/sr, K_RJ, K_CMB or y (Compton-y), with a prefix
    (mK_CMB). Default: its header's.
    """
    pixel_size: Angle | None = Field(None, gt=0)
    """Side of a pixel; replaces the header's scale (its orientation is kept). Default: the
    header's.
    """
    centre: Target | Literal["target"] | None = None
    """Put the map's centre here: a position fixed on the sky, or `target` for the scan's.
    Directions there keep their angles from ICRS north. Default: where its header says."""
    input_beam: Angle | None = Field(None, gt=0)
    """Full width at half maximum of the beam that a map in Jy/beam was made with. Default: its
    header's BMAJ and BMIN.
    """
    coordsys: Literal["icrs", "galactic", "ecliptic"] | None = None
    """Coordinates of a HEALPix map. Default: its header's COORDSYS."""
    column: int | str | None = None
    """Column of a HEALPix table, by name or counted from 1. Default: that of I (I_STOKES,
    TEMPERATURE, SIGNAL ...).
    """
    plane: int | tuple[int, ...] | None = None
    """Plane of a cube, counted from 1; of several further axes a list: [12, 1]. Default: the only
    one, or Stokes I.
    """
    polarization_convention: Literal["cosmo", "iau"] | None = None
    """Sign of U in a map of I, Q, U: `cosmo` (angles from south to east) or `iau` (from north to
    east). Default: its header's POLCCONV; where there is none, `cosmo` for HEALPix maps. Read for
    polarized cameras only."""
    hdu: int | str | None = None
    """Extension of the file by number (0: the primary one) or name. Default: the first image or
    HEALPix table.
    """
    missing: Literal["error", "zero"] = "error"
    """What NaN or infinite pixels do: stop with an error, or count as 0 in the map's unit (and be
    counted).
    """
    beam: Literal["gaussian", "none"] = "gaussian"
    """Shape of the main beam; `none` for a map that is convolved already."""
    fwhm: Angle | None = Field(None, gt=0)
    """Full width at half maximum of the beam. Default: each detector's own."""
    outside: Kelvin = quantity("0 K")
    """Brightness of the sky beyond the map's edge, K_RJ; samples there are counted."""
    scale: float = Field(1.0, ge=-1e30, le=1e30)
    """Factor on the whole map (not on `outside`)."""
    spectral_index: float = Field(0.0, ge=-100, le=100)
    """Slope of the flux density, S ~ frequency^index, within the band; for maps in Jy/pixel,
    Jy/beam and MJy/sr.
    """
    pixels_per_fwhm: float = Field(PIXELS_PER_FWHM, ge=2, le=16)
    """Fewest points per FWHM between which the convolved map is interpolated; a finer input is used
    on its own pixels.
    """
    interpolation: Literal["cubic", "linear"] = "cubic"
    """By cubic B-splines, or linear with its mean smoothing divided out: within 0.92 / n^2 of a
    point source's peak, n the points per FWHM (0.36 % of it for 16)."""

    _cache: Cache = PrivateAttr(default_factory=Cache)

    @model_validator(mode="after")
    def _one_map(self) -> SkyParameters:
        if (self.file is None) == (self.map is None):
            raise ValueError("give either file, the path of a FITS map, or in Python map, an array")
        if self.map is None:
            if self.wcs is not None:
                raise ValueError(
                    "wcs belongs to map, an array; a file has world coordinates of its own"
                )
            return self
        if self.hdu is not None:
            raise ValueError("hdu is for files; give that HDU as map")
        if self.wcs is not None:
            self.wcs.check(self.map)
        checked_unit(self.map, self.unit)
        return self

    @model_validator(mode="after")
    def _consistent(self) -> SkyParameters:
        if isinstance(self.centre, Target) and self.centre.frame == "horizontal":
            raise ValueError("centre must be fixed on the sky (ICRS or galactic), not horizontal")
        if self.beam == "none" and self.fwhm is not None:
            raise ValueError("beam: none has no width; remove fwhm, or set beam: gaussian")
        return self

    @property
    def place(self) -> str:
        """Name of the map in messages."""
        return f"{self.label}, sky map {self.map.name if self.map else self.file}"

    @property
    def source(self) -> str:
        """The map in one word: the name of its file, or what array it is."""
        return self.map.name if self.map else cast(Path, self.file).name

    def array(self) -> ArrayMap | None:
        """The map in memory with its world coordinates; None: it is in `file`."""
        return self.map.with_wcs(self.wcs) if self.map and self.wcs else self.map

    def in_files(self, path: Path) -> Self:
        """The map in memory as a file at ``path`` (`core.configuration.files.InMemory`). Raises
        `OutputError`.
        """
        if (array := self.array()) is None:
            return self
        with atomic_path(path) as temporary:
            array.write(temporary)
        return self.model_copy(update={"file": path, "map": None, "wcs": None})
