"""Base of a step that reads a map of the sky: its file, how it is read, and where it lies."""

from __future__ import annotations

import warnings
from typing import Literal

from pydantic import Field, PrivateAttr, model_validator

from zonda.core.configuration.files import InputPath
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle
from zonda.core.data import Data, Observation, percent
from zonda.core.errors import InputError
from zonda.core.hooks import manager
from zonda.core.numerics.projection import share_outside
from zonda.core.operator import Operator

from .cache import Cache
from .footprint import Footprint, footprint, off_the_map, position
from .grid import Grid, own_pixels, tangent_grid
from .inputs import HealpixMap, WcsMap
from .placement import placed, turned
from .read import read_map
from .resample import Progress, no_progress
from .stokes import STOKES

LARGE = 1 << 26
"""Bytes of a file above which the progress bar shows that it is read."""


class MapFile(Operator):
    """Base of a step that reads a map of the sky. What is computed of the map is kept from observation to observation."""

    file: InputPath
    """FITS image (with or without a celestial WCS) or HEALPix table. A relative path starts at the pipeline file's folder."""
    unit: str | None = None
    """Unit of the map: Jy/pixel, Jy/beam, MJy/sr, K_RJ, K_CMB or y (Compton-y), with a prefix (mK_CMB). Default: its header's."""
    pixel_size: Angle | None = Field(None, gt=0)
    """Side of a pixel; replaces the header's scale (its orientation is kept). Default: the header's."""
    centre: Target | Literal["target"] | None = None
    """Put the map's centre here: a position fixed on the sky, or `target` for the scan's. Default: where its header says."""
    input_beam: Angle | None = Field(None, gt=0)
    """Full width at half maximum of the beam that a map in Jy/beam was made with. Default: its header's BMAJ and BMIN."""
    coordsys: Literal["icrs", "galactic", "ecliptic"] | None = None
    """Coordinates of a HEALPix map. Default: its header's COORDSYS."""
    plane: int | tuple[int, ...] | None = None
    """Plane of a cube, counted from 1; of several further axes a list: [12, 1]. Default: the only one, or Stokes I."""
    hdu: int | str | None = None
    """Extension of the file by number (0: the primary one) or name. Default: the first image or HEALPix table."""
    missing: Literal["error", "zero"] = "error"
    """What NaN or infinite pixels do: stop with an error, or count as 0 in the map's unit (and be counted)."""

    _cache: Cache = PrivateAttr(default_factory=Cache)

    @model_validator(mode="after")
    def _centre_is_on_the_sky(self) -> MapFile:
        if isinstance(self.centre, Target) and self.centre.frame == "horizontal":
            raise ValueError("centre must be fixed on the sky (ICRS or galactic), not horizontal")
        return self

    @property
    def place(self) -> str:
        """The map in messages."""
        return f"{self.label}, sky map {self.file}"

    def map_centre(self) -> Target:
        """The middle of the input map, for ``target: map``. Raises InputError where it has none of its own."""
        if self.centre == "target":
            cure = "give the target as coordinates, or remove centre: target"
            raise InputError("target: map and centre: target each refer to the other", place=self.place, cure=cure)
        found = self.centre if isinstance(self.centre, Target) else getattr(self._footprint(), "target", None)
        if found is None:
            cure = "give the target as coordinates"
            raise InputError("the map has no centre on the sky (HEALPix, or no WCS)", place=self.place, cure=cure)
        return found

    def _footprint(self) -> Footprint | None:
        return footprint(self.file, self.pixel_size, self.centre if isinstance(self.centre, Target) else None, self.hdu)

    def check(self, data: Data) -> list[str]:
        """Whether the scans are about a point of the map, by its header; the share of their samples that is outside."""
        if self.centre == "target" or (found := self._footprint()) is None:
            return []
        for text in dict.fromkeys(off_the_map(found, o.centre, self.label) for o in data.observations):
            if text:
                warnings.warn(text, stacklevel=2)
        lines = [f"centre of the input map: {position(*found.target.icrs())}"]
        if found.matrix is not None and data.observations:
            scans = ((o.boresight_radec, o.focalplane.xi, o.focalplane.eta) for o in data.observations)
            lines.append(f"samples outside the input map: about {percent(share_outside(scans, found.matrix, found.shape), 2)}")
        return lines

    def grid_for(self, observation: Observation, beam: tuple[float, float]) -> Grid:
        """Where the map will be convolved: nothing is convolved or interpolated yet.

        ``beam``: how far it reaches, and the step of the grid that it needs [rad].
        """
        stamp = self.file.stat() if self.file.exists() else None
        identity = ("file", stamp and (stamp.st_mtime_ns, stamp.st_size))
        source: WcsMap | HealpixMap = self._cache.get(identity, self._read)
        band = observation.instrument.band
        key = (*identity, band.frequency.tobytes(), band.transmission.tobytes())
        if isinstance(source, WcsMap):
            centre = self.centre.icrs() if isinstance(self.centre, Target) else None
            if self.centre == "target" or (centre is None and source.wcs is None):
                centre = observation.centre
            wcs = placed(source, centre)
            if wcs is not None:
                return own_pixels(source, wcs, key)
            if centre is not None:
                return tangent_grid(turned(source, centre, self.place), observation, beam, (*key, centre), self.place)
        return tangent_grid(source, observation, beam, key, self.place)

    def _read(self) -> WcsMap | HealpixMap:
        large = self.file.exists() and self.file.stat().st_size > LARGE
        progress = self._progress(f"reading {self.file.name}") if large else no_progress
        progress(0, 1)
        given = {name: getattr(self, name) for name in ("unit", "pixel_size", "missing", "input_beam", "coordsys", "hdu")}
        plane = (self.plane,) if isinstance(self.plane, int) else self.plane
        source = read_map(self.file, centred=self.centre is not None, plane=plane, **given)
        progress(0, 0)
        if STOKES in source.notes:
            warnings.warn(f"{self.label}: {self.file}: {source.notes[STOKES]}", stacklevel=2)
        return source

    def _progress(self, what: str) -> Progress:
        """Callback that moves the progress bar."""
        hook, text = manager().hook, f"{self.label}: {what}"
        return lambda done, total: hook.zonda_progress(done=done, total=total, what=text)
