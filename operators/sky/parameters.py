"""The parameters of `SkyMap`, and the checks that need the map's header alone."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, Literal, Self, cast

from pydantic import Field, PrivateAttr, model_validator

from zonda.core.configuration.files import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle, Kelvin
from zonda.core.data import Data, percent
from zonda.core.errors import InputError
from zonda.core.numerics.projection import share_outside
from zonda.core.operator import Operator
from zonda.core.storage.files import atomic_path

from .array import ArrayMap, WorldCoordinates, check_shape, checked_unit
from .beam import PIXELS_PER_FWHM
from .footprint import Footprint, footprint, header_of, off_the_map, position
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
            check_shape(self.map, self.wcs)
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

    def map_centre(self) -> Target:
        """The middle of the input map, for ``target: map``. Raises InputError where it has none of
        its own.
        """
        if self.centre == "target":
            cure = "give the target as coordinates, or remove centre: target"
            raise InputError(
                "target: map and centre: target each refer to the other",
                place=self.place,
                cure=cure,
            )
        found = (
            self.centre
            if isinstance(self.centre, Target)
            else getattr(self._footprint(), "target", None)
        )
        if found is None:
            cure = "give the target as coordinates"
            raise InputError(
                "the map has no centre on the sky (HEALPix, or no WCS)", place=self.place, cure=cure
            )
        return found

    def _header(self) -> tuple[Any, tuple[int, int]] | None:
        """Header and (ny, nx) of an image; None of a HEALPix map."""
        array = self.array()
        if array is not None:
            return (
                None
                if array.table is not None
                else (array.header, (array.values.shape[-2], array.values.shape[-1]))
            )
        return header_of(cast(Path, self.file), self.hdu, self.place)

    def _footprint(self) -> Footprint | None:
        found, centre = self._header(), self.centre if isinstance(self.centre, Target) else None
        return None if found is None else footprint(*found, self.pixel_size, centre, self.place)

    def _copies(self, data: Data) -> str:
        """Warning about a map that goes with the target, if there are several targets, or empty."""
        found, targets = self._header(), len({o.centre for o in data.observations})
        placeless = self.centre is None and found is not None and "CTYPE1" not in found[0]
        if targets < 2 or not (self.centre == "target" or placeless):
            return ""
        cure = "give centre a position, or remove it for a map that knows its own"
        return (
            f"{self.label}: the map {self.source} is put on each of {targets} targets, as a copy of"
            f" its own; {cure}"
        )

    def check(self, data: Data) -> list[str]:
        """Check that scans are about a point of the map, by its header; states the share of samples
        outside.
        """
        if text := self._copies(data):
            warnings.warn(text, stacklevel=2)
        if self.centre == "target" or (found := self._footprint()) is None:
            return []
        for text in dict.fromkeys(
            off_the_map(found, o.centre, self.label) for o in data.observations
        ):
            if text:
                warnings.warn(text, stacklevel=2)
        lines = [f"centre of the input map: {position(*found.target.icrs())}"]
        if found.matrix is not None and data.observations:
            scans = (
                (o.boresight_radec, o.focalplane.xi, o.focalplane.eta) for o in data.observations
            )
            lines.append(
                "samples outside the input map: about"
                f" {percent(share_outside(scans, found.matrix, found.shape), 2)}"
            )
        return lines
