"""`CompareMaps`: a map of a run beside another one, or beside a FITS file."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import InputError, PipelineError
from zonda.core.instrument import Band
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import Noise, is_quiet, maps_of, matched, noise_alone
from zonda.core.maps.smoothing import smoother
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.numerics.sphere import beam_area
from zonda.core.output import Output, about
from zonda.core.storage.files import product_path

from .comparison.files import (
    Wanted,
    on_meridians_of,
    plane_of,
    planes_of,
    products_of,
    read_planes,
    write_comparison,
)
from .comparison.planes import EMPTY, NOT_EMPTY, Plane
from .comparison.statistics import THRESHOLD, Comparison, compare
from .series import check_map, key_of, plane_key
from .transfer_function import window_of

if TYPE_CHECKING:
    from .comparison.files import ReadMap


class CompareMaps(Output):
    """Comparison of a map with a reference: difference, fidelity, signal-to-noise ratio, radial
    spectra and profiles.

    Both are brought to one beam (the wider one) and one grid (that of the map with the smaller
    pixels), see `comparison.planes`. Fidelity is \\|reference\\| / max(\\|difference\\|,
    `threshold` x rms of the difference), as for ALMA. Of maps of I, Q and U each plane is compared,
    Q and U from the meridians of the map's frame (`comparison.files`): ``comparison_Q`` and
    ``comparison_U`` stand beside ``comparison``, which is of I. Where one of the two has no Q and
    U, I alone is compared.

    Makes the product ``comparison`` (a `Comparison`), or one under this step's own name where it
    has one; where there is an output folder, it is written there as ``comparison.fits`` and as
    tables of spectra and profiles (ECSV). `Plots` and `Report` show it.
    """

    requires = frozenset({"map"})
    provides = frozenset({"comparison"})
    one_band = True

    map: str = "map"
    """Which map, by its name among the products, e.g. noiseless/map."""
    reference: str = "input"
    """What it is compared with, by its name among the products: the input of `SkyMap`, or another
    map.
    """
    file: InputPath | None = None
    """FITS image or HEALPix map to compare with, instead of a product. A relative path starts at
    the pipeline file's folder.
    """
    hdu: int | str | None = None
    """Which extension of the `file`, by name or number. Default: its first image or HEALPix table.
    """
    plane: int | list[int] | None = None
    """Plane of a cube in the `file`, counted from 1; of one with several axes of planes a list, in
    FITS's order.
    """
    coordsys: str | None = None
    """Coordinate system of a HEALPix `file` whose header has no COORDSYS: C (ICRS), G (galactic) or
    E (ecliptic).
    """
    column: int | str | None = None
    """Column of a HEALPix `file` that is the map, by name or counted from 1. Default: that of a
    known name, or the only possible one.
    """
    beam: Angle | None = Field(None, gt=0, examples=["9 arcsec"])
    """Common resolution (FWHM). Default: that of the map with the wider beam, once more smoothed
    with it if it was not yet.
    """
    least_coverage: float = Field(0.1, ge=0, lt=1)
    """Map pixels with fewer (beam-smoothed) samples than this share of their 99th percentile are
    left out.
    """
    threshold: float = Field(THRESHOLD, gt=0, le=100)
    """Least difference that the fidelity divides by, in units of the rms of the difference."""
    noise: Literal["measured", "half_difference", "map"] = "measured"
    """Noise of the SNR: that of the map, brought to the rms, at the resolution of the comparison,
    of the map of all but the sky (signal ``source_free``) or else of half the difference of the
    scans; of the latter alone; or as it is (`map`)."""
    bins: int = Field(24, ge=2, le=500)
    """Number of rings of the spectra, of equal width in the logarithm of the scale."""

    def check(self, data: Data) -> list[str]:
        """Read the `file`, and tell what it holds. Raises InputError where it cannot be read as a
        map.
        """
        check_map(data, self.map, self.label)
        if self.file is None:
            check_map(data, self.reference, self.label)
            return []
        read = self._read()
        if not np.isfinite(read.planes["I"].values).any():
            raise InputError(EMPTY, place=f"{self.label}, {self.file}", cure=NOT_EMPTY)
        for camera in data.scene.instrument.cameras.values():
            for plane in read.planes.values():
                _in_kelvin(plane, camera.band)
        unit = read.planes["I"].unit or "K_RJ, as it states no unit"
        return [f"{self.file.name}: {', '.join(read.planes)} in {unit}", *read.notes]

    def finalize(self, data: Data) -> None:
        """Raises PipelineError where a map is missing, InputError where the two cannot be
        compared.
        """
        references = self._references(data)
        maps = products_of(_product(data, self.map, self.label), self.map)
        both = [plane for plane in maps if plane in references]
        if len(both) < max(len(maps), len(references)):
            which = "reference" if len(references) == 1 else "map"
            data.log.state(self.label, "Q and U", f"not compared: the {which} has none")
        reference = data.products.get(self.reference)
        if self.file is None and isinstance(reference, MapProduct):
            for what, text in template_rows(reference, _product(data, self.map, self.label)):
                data.log.state(self.label, what, text)
        first = plane_of(maps["I"][1], self.map)
        references = on_meridians_of(first, {plane: references[plane] for plane in both})
        runs = data.provenance.get("runs", {})
        for which in both:
            name, found = maps[which]
            plane = self._with_noise(data, which, plane_of(found, name))
            plane = replace(
                covered(plane, found, self.least_coverage),
                quiet=is_quiet(runs, self.map),
            )
            reference = references[which]
            if self.file is None:
                reference = replace(reference, quiet=is_quiet(runs, self.reference))
            fwhm = self.beam or resolution(plane, reference, found) or None
            made = compare(reference, plane, fwhm, self.threshold, self.bins, self.label)
            _tell(self.label, "" if which == "I" else f"{which}: ", data, made)
            key = plane_key(key_of(self, "comparison"), which)
            data.products[key] = made
            if data.output is not None:
                write_comparison(made, product_path(data.output, data.named(key)), about(data))

    def _with_noise(self, data: Data, which: str, plane: Plane) -> Plane:
        """A plane with the noise of the complete map, also of a signal without noise, and with the
        map of the noise alone.
        """
        complete = self.map.rpartition("/")[2]
        whole = data.products.get(complete)
        if self.noise == "map" or not isinstance(whole, MapProduct) or whole.contents != "all":
            return plane
        name = plane_key(complete, which) if whole.polarization is not None else complete
        maps = maps_of(data.products)
        sources: tuple[Noise, ...] = ("source_free", "half_difference")
        alone = noise_alone(maps, name, sources[self.noise != "measured" :])
        noisy = plane_of(maps[name], name, alone)
        if noisy.values.shape != plane.values.shape:
            return plane
        fields = ("noise", "blurred", "alone", "alone_of")
        return replace(plane, **{field: getattr(noisy, field) for field in fields})

    def _references(self, data: Data) -> dict[str, Plane]:
        """The planes of the reference, K_RJ."""
        if self.file is None:
            return planes_of(_product(data, self.reference, self.label), self.reference)
        read = self._read()
        band = data.scene.instrument.band
        for what, _, note in (note.partition(": ") for note in read.notes):
            data.log.state(self.label, what, note)
        return {which: _in_kelvin(plane, band) for which, plane in read.planes.items()}

    def _read(self) -> ReadMap:
        """The file. Raises InputError as `read_planes`."""
        assert self.file is not None
        plane = None if self.plane is None else tuple(np.atleast_1d(self.plane).tolist())
        return read_planes(self.file, wanted=Wanted(self.hdu, plane, self.coordsys, self.column))


def _in_kelvin(plane: Plane, band: Band) -> Plane:
    if plane.unit in ("K_RJ", ""):
        return replace(plane, unit="K_RJ")
    factor: Any = to_kelvin_rj(plane.unit, band, 1.0, 0.0, beam_area(plane.fwhm or 0.0))
    if plane.unit == "Jy/pixel":
        factor = factor / np.broadcast_to(plane.grid.areas, plane.values.shape)
    return plane.scaled(factor, "K_RJ")


def resolution(plane: Plane, reference: Plane, product: Any) -> float:
    """FWHM [rad] of the map with the wider beam; sqrt(2) times that of a map which is not smoothed
    yet. 0: not known.
    """
    own = plane.fwhm or 0.0
    if isinstance(product, MapProduct) and not product.smoothed_by:
        own *= math.sqrt(2)
    return max(own, reference.fwhm or 0.0)


def covered(plane: Plane, product: Any, least: float) -> Plane:
    """The plane without the pixels that `window_of` leaves out."""
    if not isinstance(product, MapProduct):
        return plane
    if product.projection == "TAN":
        enough = window_of(product, least=least) > 0
    else:
        seen = product.known
        depth = product.known_hits / np.broadcast_to(plane.grid.areas, seen.shape)
        if product.fwhm > 0:  # samples per solid angle, under the beam
            depth = smoother(plane.grid, product.fwhm)(np.nan_to_num(depth))
        enough = depth >= least * np.percentile(depth[seen], 99) if seen.any() else seen
    return replace(plane, values=np.where(enough, plane.values, np.nan))


def _product(data: Data, name: str, place: str) -> Any:
    found = data.products.get(name)
    if isinstance(found, Image) or (isinstance(found, MapProduct) and found.contents == "all"):
        return found
    maps = ((key, p) for key, p in data.products.items() if isinstance(p, Image | MapProduct))
    cure = f"name one of these: {', '.join(key for key, _ in maps if not key.startswith('_'))}"
    raise PipelineError(f"there is no map {name!r}", place=place, cure=cure)


def template_rows(reference: Any, other: Any) -> list[tuple[str, str]]:
    """Signal-to-noise ratio of a reference that is a template (`matched`), and its amplitude in the
    map if that is of the same samples; nothing of others.
    """
    rows = []
    with suppress(InputError):
        _, error = matched(reference, reference)
        rows.append(("S/N of the reference as a template", f"{1 / error:.4g}"))
        amplitude, error = matched(reference, other)
        rows.append(("its amplitude in the map", f"{amplitude:.4g} +- {error:.2g}"))
    return rows


def _tell(label: str, of: str, data: Data, found: Comparison) -> None:
    f = found.values
    told = [note.split(": ", 1) if ": " in note else ("grid", note) for note in found.notes]
    told += [
        ("gain of the map", f"{f['gain']:.4g} +- {f['gain error']:.2g}"),
        ("correlation", f"{f['correlation']:.4f}"),
        ("rms of the difference", f"{f['rms difference']:.3e} {found.unit}"),
    ]
    if f.get("chi2 values"):
        ratio = f["chi2"] / f["chi2 pixels"]
        error = math.sqrt(2 / f["chi2 values"])
        told.append(("chi2 of the difference / pixels", f"{ratio:.4g} +- {error:.2g}"))
    for what, text in told:
        data.log.state(label, of + what, text)
