"""`zonda.read_map`: a map of a FITS file as the object that a run makes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import registry
from ..errors import InputError
from ..instrument import Band
from ..numerics.sphere import angles
from ..storage.fits_files import check_size, opened
from .grid import HealpixPixels, wcs_grid
from .header import FileHeader, exact_header
from .map_arrays import NOISE_MODELS
from .map_file import Provenance
from .map_product import MapProduct
from .map_reading import HealpixTable, celestial, chosen, is_healpix, q_and_u
from .planes import ELSEWHERE, KNOWN, Plane, ScanHits
from .units import KNOWN_UNITS, written_unit

ABOUT = (
    *("ORIGIN", "CREATOR", "PIPELINE", "SEED", "DATE-OBS", "MJD-OBS", "EXPTIME", "NSCANS"),
    *("TELESCOP", "INSTRUME", "SITE", "OBJECT", "RESTFRQ", "BAND"),
)
"""Cards that `MapProduct.write` writes again."""
OF_U = frozenset({"half_difference_u", "cov_iu", "cov_qu", "template_weights_u"})
"""Rows whose sign is that of U."""
SAME_BAND = 1e-9
"""Relative difference of the centres of one band."""


def read_map(
    path: str | Path,
    *,
    hdu: int | str | None = None,
    plane: int | tuple[int, ...] | None = None,
    coordsys: str | None = None,
    column: int | str | None = None,
    unit: str | None = None,
    band: Band | str | None = None,
) -> MapProduct:
    """The map of a FITS file: an image in any projection that astropy reads, or a HEALPix table.

    What `SaveMap` and `MapProduct.write` wrote comes back with its planes, grid and headers; not
    in the file are the sample rate, and the weights of Q and U, which are those of I times
    COV_II / COV_QQ (COV_UU). In other files, extensions (or columns) that are like the map are
    planes under their names; each finite pixel counts as one sample where there are no HITS, and
    weighs 1 / NOISE^2, or 1, where there are no WEIGHTS: `MapProduct.write` writes no such plane.
    ``centre`` is the reference point of a TAN image, else the middle of the pixels.

    Parameters
    ----------
    path
        May be packed (gzip, bzip2, xz, zip).
    hdu
        Extension, by name or number; default: the first map.
    plane
        Of a cube, counted from 1; one number for each axis behind the first two.
    coordsys, column
        Of a HEALPix table: C, G or E where it has no COORDSYS, and the column of I.
    unit
        In place of BUNIT (TUNIT), as `MapProduct.to` takes it.
    band
        For conversions, or the name of one; default: the known one that BAND, RESTFRQ and INSTRUME
        name, else none.

    Raises
    ------
    InputError
        Unreadable; no map in the file; position, unit or temperature scale missing; a cube of which
        no plane is wanted; Q and U in an image without POLCCONV.
    """
    path = Path(path).expanduser()
    with opened(path, str(path), "check the file, e.g. with fitsverify, or copy it again") as hdus:
        found, _ = chosen(hdus, hdu, str(path))
        reader = _Reader(found, hdus, str(path))
        if is_healpix(found):
            if plane is not None:
                raise reader.error(
                    "plane is for images",
                    "leave plane out: of a HEALPix table column is chosen",
                )
            reader.read_table(coordsys, column)
        else:
            given = {"coordsys": coordsys, "column": column}
            for name in (name for name, value in given.items() if value is not None):
                raise reader.error(f"{name} is for HEALPix maps", f"leave {name} out")
            reader.read_images(hdu is None, (plane,) if isinstance(plane, int) else plane)
        return reader.product(unit, band)


class _Reader(FileHeader):
    """The map of an extension, and what stands beside it.

    Attributes
    ----------
    rows
        Values and unit of each row of a plane, by its name in files; ``i``, ``q`` and ``u`` are
        those of the map.
    where
        What `MapProduct` says of the pixels.
    """

    def __init__(self, hdu: Any, hdus: Any, place: str) -> None:
        check_size(hdu, place)
        super().__init__(hdu.header, place)
        self.hdu = hdu
        self.hdus = hdus
        self.rows: dict[str, tuple[NDArray[Any], str]] = {}
        self.where: dict[str, Any] = {}

    def read_images(self, all_of_them: bool, plane: tuple[int, ...] | None) -> None:
        """Read an image or the planes of its cube, and the images beside it."""
        shape = self.hdu.shape
        cube, wcs, _ = celestial(self.hdu, self.place)
        index, _ = cube.plane(plane)
        first = "hits" if self.hdu.name == "HITS" else "i"
        places = {first: index, **dict(zip("qu", cube.q_and_u(index), strict=False))}
        unit = self.text("BUNIT")
        self.rows = {name: (_native(self.hdu.data[at]), unit) for name, at in places.items()}
        beside = [h for h in self.hdus if h is not self.hdu and h.is_image and h.shape == shape]
        if all_of_them and len(shape) == 2:
            names = [h.name.lower() for h in beside]
            letters = dict(zip(q_and_u(names), "qu", strict=False))
            for k, other in enumerate(beside):
                name = letters.get(k, names[k])
                about = FileHeader(other.header, self.place)
                self.rows.setdefault(name or "i", (_native(other.data), about.text("BUNIT")))
        grid = wcs_grid(wcs, shape[-2:])
        across, along = np.sqrt((grid.matrix**2).sum(axis=0))
        middle = grid.at((shape[-1] - 1) / 2, (shape[-2] - 1) / 2)
        if grid.kind == "TAN" or not np.isfinite(middle).all():
            lon, lat = np.radians(wcs.wcs.crval[[wcs.wcs.lng, wcs.wcs.lat]])
        else:
            lon, lat = angles(middle)
        self.where = {
            "header": exact_header(wcs),
            "centre": (float(lon), float(lat)),
            "square": math.isclose(across, along, rel_tol=1e-9),
            "pixel": float(np.sqrt(across * along)),
            "frame": "galactic" if str(wcs.wcs.ctype[0]).startswith("G") else "icrs",
        }

    def read_table(self, coordsys: str | None, column: int | str | None) -> None:
        """Read the columns of a HEALPix table."""
        table = HealpixTable(self.hdu, self.place)
        names = table.names
        pixel = table.pixel_column
        frame, _ = table.frame(coordsys)
        plain = {
            k: name.lower()
            for k, name in enumerate(names)
            if k != pixel and self.hdu.columns[k].format[-1:] in "IJKED"
        }
        if list(plain.values()) != ["hits"]:
            first = table.intensity(column)
            plain[first] = "i"
            plain |= dict(zip(q_and_u(names), "qu", strict=False))
        first = min(plain, key=lambda k: plain[k] != "i")
        columns = {plain[k]: k for k in sorted(plain, key=lambda k: k != first)}
        values, pixels, nside = table.read(columns)
        for name, k in columns.items():
            whole = self.hdu.columns[k].format[-1:] in "IJK"
            unit = str(self.header.get(f"TUNIT{k + 1}", "") or "").strip()
            self.rows[name] = values[name].astype(np.int64) if whole else values[name], unit
        pixels = np.arange(len(values[plain[first]])) if pixels is None else pixels
        grid = HealpixPixels(nside, table.nest, pixels, frame)
        lon, lat = angles(grid.directions().sum(axis=0))
        self.where = {
            "nside": nside,
            "nest": table.nest,
            "pixels": pixels,
            "frame": frame,
            "pixel": grid.pixel,
            "centre": (float(lon) % (2 * math.pi), float(lat)),
        }

    def product(self, unit: str | None, band: Band | str | None) -> MapProduct:
        """The map of the `rows`."""
        contents = "hits" if "i" not in self.rows else "all"
        if contents == "hits":
            self.rows["i"] = np.full(self.rows["hits"][0].shape, np.nan), "K_RJ"
        own = self.rows["i"][1]
        planes = self._planes(own)
        major, minor = (self.number(key) or 0.0 for key in ("BMAJ", "BMIN"))
        low, high = (math.radians(self.number(k) or major) for k in ("BEAMLOW", "BEAMHIGH"))
        known = self._band(band)
        noise = self.text("NOISEMOD")
        kept = [key for key in ABOUT if known is None or key not in ("RESTFRQ", "BAND")]
        made = MapProduct(
            planes=planes,
            unit=self._unit(unit, own),
            weighting="inverse_variance" if planes["weights"].scale else "uniform",
            fwhm=math.radians(math.sqrt(major * (minor or major))),
            beams=(low, high),
            band=known,
            spectral_index=self.number("SPECINDX"),
            taken_off=self.text("TAKENOFF"),
            chi2=(self.number("CHI2") or 0.0, self.number("CHI2ERR") or 0.0),
            noise_from=next((k for k, v in NOISE_MODELS.items() if v == noise), "net"),
            contents=contents,
            **self.where,
        )
        headers = [FileHeader(each.header, self.place) for each in self.hdus]
        made.difference = next(filter(None, (h.text("JACKKNIF") for h in headers)), made.difference)
        made.origin = Provenance(
            [
                (key, header[key], header.comments[key])
                for key in kept  # of a table OBJECT is PARTIAL
                for header in [h.header for h in headers if key in h.header][:1]
                if header[key] not in ("PARTIAL", "FULLSKY")
            ],
            [str(line) for line in self.header.get("HISTORY", [])],
            product=self.text("PRODUCT") or "map",
            quiet=any(h.text("NOISEOF") == ELSEWHERE for h in headers),
        )
        tables = {each.name: each.data for each in self.hdus if not each.is_image}
        if {"SCANS", "SCAN_HITS"} <= set(tables):
            made.scans = [str(name) for name in tables["SCANS"]["NAME"]]
            made.scan_hits = _scan_hits(tables["SCAN_HITS"], made)
        return made

    def _planes(self, own: str) -> dict[str, Plane]:
        """The planes of the rows; ``own``: the unit of I as it is written."""
        iqu = {"q", "u"} <= set(self.rows)
        if iqu and self._is_iau():
            for name in {"u", *OF_U} & set(self.rows):
                self.rows[name] = -self.rows[name][0], self.rows[name][1]
        planes: dict[str, Plane] = {}
        for name, plane in KNOWN.items():
            of = list((plane.stokes if iqu else None) or plane.names)
            of = ["i"] if of == ["signal"] else of
            if all(row in self.rows for row in of):
                values, units = zip(*(self.rows.pop(row) for row in of), strict=True)
                scale = self._scale(units[0], own) if name == "weights" else plane.scale
                planes[name] = replace(plane, values=np.stack(values), scale=scale)
        for name, (values, unit) in self.rows.items():
            scale = self._scale(unit, own)
            planes[name] = Plane(values[None], {name: name.replace("_", " ")}, scale)
        signal = planes["signal"].values

        def unsaid(name: str, values: Any, **more: Any) -> None:
            if name not in planes:
                no_rows: Any = {"names": {}, "stokes": {}, "values": values}
                planes[name] = replace(KNOWN[name], **no_rows, **more)

        unsaid("hits", np.isfinite(signal[:1]).astype(np.int64))
        if iqu:
            unsaid("covariance", np.full((6, *signal.shape[1:]), np.nan))
            unsaid("condition", np.full((1, *signal.shape[1:]), np.nan))
            with np.errstate(invalid="ignore"):
                errors = np.sqrt(planes["covariance"].values[[0, 3, 5]])
            planes.pop("noise", None)
            unsaid("noise", errors)
            planes["noise"] = replace(planes["noise"], names=KNOWN["noise"].names)
        unsaid("noise", np.full(signal.shape, np.nan))
        noise = planes["noise"].values
        stated = bool(np.isfinite(noise).any())
        with np.errstate(invalid="ignore", divide="ignore"):
            weights = np.where(noise > 0, noise**-2.0, 0.0) if stated else np.isfinite(signal)
            if iqu and "weights" in planes:
                share = (noise[:1] / noise) ** 2
                of_each = planes["weights"].values * np.where(np.isfinite(share), share, 0.0)
                planes["weights"] = replace(planes["weights"], values=of_each)
        unsaid("weights", weights.astype(np.float64), scale=-2 if stated else 0)
        return planes

    @staticmethod
    def _scale(unit: str, own: str) -> int:
        """Power of the map's unit ``own`` that a plane's unit is."""
        plain = unit.replace("(", "").replace(")", "") if own else ""
        return {own: 1, f"{own}2": 2, f"{own}-2": -2}.get(plain, 0) if plain else 0

    def _is_iau(self) -> bool:
        """True where U is that of IAU. Raises InputError where the file does not say it."""
        written = self.text("POLCCONV").upper() or ("COSMO" if "nside" in self.where else "")
        if written not in ("COSMO", "IAU"):
            message = "its header does not say in which convention U is (POLCCONV)"
            raise self.error(message, "set POLCCONV to COSMO or IAU")
        return written == "IAU"

    def _unit(self, given: str | None, own: str) -> str:
        try:
            if not (given or own):
                raise InputError("the unit of the map is missing")
            scale = self.text("TEMPSCAL") or None
            return written_unit(given or own, place=self.place, temperature_scale=scale)
        except InputError as error:
            cure = f"give unit=, one of {KNOWN_UNITS}, or set BUNIT, of kelvin TEMPSCAL too"
            raise self.error(error.message, cure) from None

    def _band(self, given: Band | str | None) -> Band | None:
        if isinstance(given, Band):
            return given
        if given is not None:
            return registry.bands.create(given)  # type: ignore[no-any-return]
        name = self.text("BAND")
        centre = self.number("RESTFRQ") or 0.0
        camera, _, _ = self.text("INSTRUME").partition(" ")
        known: list[Band] = []
        if camera in registry.instruments:
            known = [one.band for one in registry.instruments.create(camera).cameras.values()]
        if name in registry.bands:
            known.append(registry.bands.create(name))
        alike = (b for b in known if math.isclose(b.centre, centre, rel_tol=SAME_BAND))
        return next((band for band in alike if band.name == name), None)


def _native(values: Any) -> NDArray[Any]:
    """Whole numbers as int64, others as float64."""
    return np.array(values, np.int64 if np.asarray(values).dtype.kind in "iu" else np.float64)


def _scan_hits(table: Any, product: MapProduct) -> ScanHits:
    """Hits of each scan (`MapFile`)."""
    number, pixel = (np.asarray(table[key], np.int64) for key in ("SCAN", "PIXEL"))
    if product.pixels is not None:
        pixel = np.searchsorted(product.pixels, pixel)
    each = [number == k for k in range(len(product.scans))]
    hits = np.asarray(table["HITS"], np.int32)
    return ScanHits(
        list(product.scans),
        [pixel[k].astype(np.int32) for k in each],
        [hits[k] for k in each],
    )
