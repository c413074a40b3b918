"""The parameters of `SkyMap`, its map, read once and kept by the step, the place of the map by its
header alone, and the cache of what is computed of a map.
"""

from __future__ import annotations

import re
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, cast

import numpy as np
from pydantic import Discriminator, Field, PrivateAttr, Tag, model_validator

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle, Kelvin, ThermalEnergy, Unit
from zonda.core.data import Data, percent
from zonda.core.errors import InputError
from zonda.core.hooks import manager
from zonda.core.instrument import Band
from zonda.core.maps.map_reading import STOKES
from zonda.core.numerics.projection import share_outside
from zonda.core.numerics.radiation import HOTTEST_GAS, sz_of_band, sz_per_y
from zonda.core.operator import Operator
from zonda.core.storage.files import atomic_path
from zonda.core.types import Floats

from .beam import PIXELS_PER_FWHM
from .geometry import Footprint, off_the_map, position
from .input_map import ImageMap, InputMap
from .map_header import DOUBT, seen_twice
from .read import ArrayMap, WorldCoordinates, checked_unit, read_map
from .region import Progress, no_progress

T = TypeVar("T")


class Cache:
    """Computed values by key. Thread-safe; copies and pickles are empty.

    Parameters
    ----------
    limit
        Bytes kept; the values least recently used go first (an observation that needs them holds
        them itself).
    """

    def __init__(self, limit: int = 2**30) -> None:
        self._limit = limit
        self._lock = threading.RLock()
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """The value of ``key``, made where it is not there. Values have ``nbytes``."""
        with self._lock:
            if key not in self._kept:
                self._kept[key] = make()
                while (
                    len(self._kept) > 1 and sum(v.nbytes for v in self._kept.values()) > self._limit
                ):
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            found: T = self._kept[key]
            return found

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Cache)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[type[Cache], tuple[int]]:
        return Cache, (self._limit,)


_A_QUANTITY = re.compile(r"[-+]?\.?\d[\d.eE+-]*\s*[a-zA-Z]*")
GasTemperature = Annotated[
    Annotated[ThermalEnergy, Field(ge=0, le=HOTTEST_GAS), Tag("value")]
    | Annotated[InputPath, Tag("map")],
    Discriminator(
        lambda given: (
            "map"
            if isinstance(given, Path)
            or (isinstance(given, str) and not _A_QUANTITY.fullmatch(given.strip()))
            else "value"
        )
    ),
]
"""k T_e [J] of the gas of a map in y, or a FITS map of it."""
GAS = "electron temperature"
"""Key of the note about `SkyInput.te`."""
LARGE = 1 << 26
"""Bytes of a file above which the progress bar shows that it is read."""


class SkyInput(Operator):
    """Parameters of `SkyMap`, and the map of the sky that it reads from a file or an array. What is
    computed of the map is kept from observation to observation.
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
    pixel_size: Angle | None = Field(None, gt=0, examples=["2 arcsec"])
    """Side of a pixel; replaces the header's scale (its orientation is kept). Default: the
    header's.
    """
    centre: Target | Literal["target"] | None = None
    """Put the map's centre here: a position fixed on the sky, or `target` for the scan's.
    Directions there keep their angles from ICRS north. Default: where its header says."""
    input_beam: Angle | None = Field(None, gt=0, examples=["18 arcsec"])
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
    fwhm: Angle | None = Field(None, gt=0, examples=["9 arcsec"])
    """Full width at half maximum of the beam. Default: each detector's own."""
    outside: Kelvin = quantity("0 K", examples=["1 mK"])
    """Brightness of the sky beyond the map's edge, K_RJ; samples there are counted."""
    scale: float = Field(1.0, ge=-1e30, le=1e30)
    """Factor on the whole map (not on `outside`)."""
    spectral_index: float = Field(0.0, ge=-100, le=100)
    """Slope of the flux density, S ~ frequency^index, within the band; for maps in Jy/pixel,
    Jy/beam and MJy/sr.
    """
    te: GasTemperature | None = None
    """Electron temperature k T_e of a map in y, up to 15 keV: a value (8 keV), or a FITS map in keV
    on the pixels of the map, of the mean weighted by y. The thermal Sunyaev-Zel'dovich effect is
    then relativistic (Itoh et al. 1998); default: non-relativistic, of cold gas."""
    pixels_per_fwhm: float = Field(PIXELS_PER_FWHM, ge=2, le=16)
    """Fewest points per FWHM between which the convolved map is interpolated; a finer input is used
    on its own pixels.
    """
    interpolation: Literal["cubic", "linear"] = "cubic"
    """By cubic B-splines, or linear with its mean smoothing divided out: within 0.92 / n^2 of a
    point source's peak, n the points per FWHM (0.36 % of it for 16)."""

    _cache: Cache = PrivateAttr(default_factory=Cache)

    @model_validator(mode="after")
    def _one_map(self) -> SkyInput:
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
    def _consistent(self) -> SkyInput:
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
        """The map in memory as a file at ``path`` (`core.configuration.input_paths.InMemory`).

        Raises `OutputError`.
        """
        if (array := self.array()) is None:
            return self
        with atomic_path(path) as temporary:
            array.write(temporary)
        return self.model_copy(update={"file": path, "map": None, "wcs": None})

    def _input(self, polarized: bool) -> tuple[InputMap, tuple[Hashable, ...]]:
        """The map, read once for all observations, and its key in the cache."""
        key = (*self._identity(), *(["polarized"] if polarized else []))
        return self._cache.get(key, lambda: self.read_input(polarized)), key

    def _in_band(self, source: InputMap, key: tuple[Hashable, ...], band: Band) -> InputMap:
        """The map in K_RJ of the ``band`` where its gas has a temperature, otherwise as it is."""
        if self.te is None:
            return source
        return self._cache.get((*key, "te"), lambda: self._of_hot_gas(source, band))

    def _of_hot_gas(self, source: InputMap, band: Band) -> InputMap:
        """A map in y times the relativistic thermal Sunyaev-Zel'dovich effect of its pixels' gas,
        in K_RJ. Raises InputError if it is not in y.
        """
        if source.unit != "y":
            message = f"te is for maps in y, and this one is in {source.unit}"
            raise InputError(message, place=self.place, cure="remove te")
        terms = sz_of_band(band)
        if isinstance(self.te, Path):
            weight = np.abs(source.values)
            value = self._temperatures(source, self.te)
            mean = float(np.sum(value * weight) / max(weight.sum(), 1e-300))
            factor = sz_per_y(terms, value)
            text = f"{self.te.name}, mean weighted by y "
        else:
            mean = cast(float, self.te)
            text = ""
            factor = sz_per_y(terms, mean)
        kev = Unit("J").write_in_unit_of(mean, "1 keV")
        text += f"{kev}: {sz_per_y(terms, mean):.5g} K_RJ per y"
        notes = source.notes | {GAS: f"{text} (cold gas {terms[0]:.5g})"}
        q_and_u = None if source.polarization is None else source.polarization * factor
        values = source.values * factor
        return replace(source, values=values, polarization=q_and_u, unit="K_RJ", notes=notes)

    def _temperatures(self, source: InputMap, path: Path) -> Floats:
        """k T_e [J] of the pixels of ``source``.

        Raises InputError for a map that cannot be read, of other pixels, or of temperatures that
        `sz_terms` do not serve.
        """
        place = f"{self.label}, te {path}"
        options = {name: getattr(self, name) for name in ("missing", "pixel_size", "coordsys")}
        found = read_map(path, centred=self.centre is not None, temperature=True, **options)
        if not source.has_pixels_of(found):
            message = f"it has other pixels than {self.source}"
            raise InputError(message, place=place, cure="give both maps on the same pixels")
        low, high = (float(end(found.values, initial=0.0)) for end in (np.min, np.max))
        if low < 0 or high > HOTTEST_GAS * (1 + 1e-6):  # float32 of 15 keV is served
            ends = (Unit("J").write_in_unit_of(end, "1 keV") for end in (low, high))
            message = (
                f"its values are {' to '.join(ends)}; the relativistic series serves 0 to 15 keV"
            )
            raise InputError(message, place=place, cure="correct them, or the header's unit")
        return found.values

    def read_input(self, polarized: bool = False, header_alone: bool = False) -> InputMap:
        """The map of the file or the array, with Q and U if the camera is ``polarized``; warns of
        what is doubtful.
        """
        found = self._read(polarized, header_alone)
        for what in (STOKES, DOUBT):
            if what in found.notes:
                self.warn(found.notes[what])
        return found

    def _read(self, polarized: bool = False, header_alone: bool = False) -> InputMap:
        names = ("unit", "pixel_size", "missing", "input_beam", "coordsys", "column", "hdu")
        progress: Progress = no_progress
        if self._bytes > LARGE and not header_alone:
            progress = self._progress(f"reading {self.source}")
        progress(0, 1)
        found = read_map(
            self.array() or cast(Path, self.file),
            plane=(self.plane,) if isinstance(self.plane, int) else self.plane,
            centred=self.centre is not None,
            polarized=polarized,
            convention=self.polarization_convention,
            header_alone=header_alone,
            **{name: getattr(self, name) for name in names},
        )
        progress(0, 0)
        return found

    def warn(self, text: str) -> None:
        """Warn about the map."""
        warnings.warn(f"{self.label}: {self.file or self.source}: {text}", stacklevel=3)

    def warn_of_beams(self, source: InputMap, telescope: Floats) -> str:
        """Warn if a map that was made with a beam is convolved with those of detectors, FWHM (n,)
        [rad]. Returns the statement about it, empty if there is none.
        """
        if self.beam == "none":
            return ""
        stated, text = seen_twice(source.beam, self.fwhm, telescope)
        if text:
            self.warn(text)
        return stated

    def _progress(self, what: str) -> Progress:
        """Callback that moves the progress bar."""
        hook = manager().hook
        text = f"{self.label}: {what}"
        return lambda done, total: hook.zonda_progress(done=done, total=total, what=text)

    @property
    def _bytes(self) -> int:
        """Size of the file; 0 of an array."""
        return self.file.stat().st_size if self.file and self.file.exists() else 0

    def _identity(self) -> tuple[Hashable, ...]:
        """Key of the map: an array's hash, a file's size and time of change."""
        gas = self.te.stat().st_mtime_ns if isinstance(self.te, Path) else 0
        if (array := self.array()) is not None:
            return ("array", array.digest, gas)
        assert self.file is not None  # one of the two is given
        return ("file", self._bytes and self.file.stat().st_mtime_ns, self._bytes, gas)

    def _header(self) -> InputMap:
        """The map without its values."""
        key = *self._identity(), "header"
        return self._cache.get(key, lambda: self._read(header_alone=True))

    def _footprint(self) -> Footprint | None:
        centre = self.centre if isinstance(self.centre, Target) else None
        return Footprint.of(self._header(), centre, self.place)

    def map_centre(self) -> Target:
        """The middle of the input map, for ``target: map``. Raises InputError where it has none of
        its own.
        """
        if self.centre == "target":
            message = "target: map and centre: target each refer to the other"
            cure = "give the target as coordinates, or remove centre: target"
            raise InputError(message, place=self.place, cure=cure)
        if isinstance(self.centre, Target):
            return self.centre
        if (found := self._footprint()) is None:
            message = "the map has no centre on the sky (HEALPix, or no WCS)"
            raise InputError(message, place=self.place, cure="give the target as coordinates")
        return found.target

    def check(self, data: Data) -> list[str]:
        """Check that scans are about a point of the map, by its header; states the share of samples
        outside.
        """
        header = self._header()
        targets = dict.fromkeys(o.centre for o in data.observations)
        placeless = isinstance(header, ImageMap) and header.placeless and self.centre is None
        if len(targets) > 1 and (self.centre == "target" or placeless):
            warnings.warn(
                f"{self.label}: the map {self.source} is put on each of {len(targets)} targets, as"
                " a copy of its own; give centre a position, or remove it for a map that knows its"
                " own",
                stacklevel=2,
            )
        if self.centre == "target" or (found := self._footprint()) is None:
            return []
        for centre in targets:
            if text := off_the_map(found, centre, self.label):
                warnings.warn(text, stacklevel=2)
        lines = [f"centre of the input map: {position(*found.target.icrs())}"]
        if found.matrix is not None and data.observations:
            scans = (
                (o.boresight_radec, o.focalplane.xi, o.focalplane.eta) for o in data.observations
            )
            share = percent(share_outside(scans, found.matrix, found.shape), 2)
            lines.append(f"samples outside the input map: about {share}")
        return lines
