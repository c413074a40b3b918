"""Files of scans and focal planes in which one value is another (text for a number, NaN, another
shape or type, or nothing), or bytes are others. They are mapped, or refused with a clean error.
"""

from __future__ import annotations

import json
import random
import shutil
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from astropy.io import fits

import zonda
from zonda.core.array_table import read_array
from zonda.core.errors import ZondaError
from zonda.core.numerics.quaternions import from_angles

from ..axismanagers import saved
from ..core.test_detector_files import hardware, toast_file
from ..operators.io.test_axismanager import INSTRUMENT
from .test_corpus import fuzzer

NUMBERS: tuple[Any, ...] = (np.nan, np.inf, -np.inf, 1e308, -1.0, 0, -1, 2**62, True, 1j)
TEXTS: tuple[Any, ...] = ("x", "", "nan", "-1e999", "\u00e9", "{}", "[1]", "2024-13-45T99:00")
ARRAYS: tuple[Any, ...] = (
    np.zeros(0),
    np.arange(3.0),
    np.full((2, 2), np.nan),
    np.array([b"a", b"\xff"]),
    np.array([(1, 2.0)], "i4, f8"),
)
JSONS = ("_axisman", "_scalars", "_units", "observation_detectors", "observation_detector_flags")
JSON = (None, -1, 2**70, 1e308, float("nan"), "x", "", [], [[]], {}, {"a": 1}, True)


def in_json(value: Any, rng: random.Random) -> Any:
    """A JSON value in which one leaf or branch is another."""
    keys: list[Any] = []
    if isinstance(value, dict | list):
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
    if not keys or rng.random() < 0.2:
        return rng.choice(JSON)
    key = rng.choice(keys)
    made = dict(value) if isinstance(value, dict) else list(value)
    if rng.random() < 0.15:
        del made[key]
    else:
        made[key] = in_json(made[key], rng)
    return made


def in_array(values: Any, rng: random.Random) -> Any:
    """An array of another shape or type, or with a value that is none."""
    how = rng.randrange(8)
    if values.dtype.names and how < 6:
        name = rng.choice(values.dtype.names)
        made, column = np.array(values), np.array(values[name])
        row = rng.randrange(column.size)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wrong: Any = rng.choice(NUMBERS[:6]) if column.dtype.kind in "fiu" else b"x"
            column.flat[row] = np.array(wrong).astype(column.dtype)
        made[name] = column
        return made
    if how < 3 and values.dtype.kind in "fiu" and values.size:
        made = np.array(values, np.float64)
        made.flat[rng.randrange(made.size)] = rng.choice(NUMBERS[:6])
        return made
    if how == 3:
        return np.full(values.shape, rng.choice(NUMBERS))
    if how == 4:
        return np.full(values.shape, b"x")
    if how == 5:
        return values[..., :-1] if values.ndim else np.zeros(2)
    if how == 6:
        return np.concatenate([values, values]) if values.ndim else values
    return rng.choice((*ARRAYS, *NUMBERS, *TEXTS))


def spoil_hdf5(path: Path, rng: random.Random) -> str:
    """Change an attribute or a data set; which it was."""
    with h5py.File(path, "a") as file:
        places: list[tuple[str, str]] = [("/", name) for name in file.attrs]

        def visit(name: str, item: Any) -> None:
            places.extend((name, key) for key in item.attrs)
            places.append((name, ""))

        file.visititems(visit)
        name, key = rng.choice(places)
        if key:
            before, made = file[name].attrs[key], rng.choice((*NUMBERS, *TEXTS, *ARRAYS))
            del file[name].attrs[key]
            if key in JSONS:
                made = rng.choice((made, *[json.dumps(in_json(json.loads(before), rng))] * 3))
            elif rng.random() < 0.1:
                return f"{name} without {key}"
            file[name].attrs[key] = made
            return f"{name}, {key} = {made!r}"[:200]
        item = file[name]
        made = in_array(item[()], rng) if isinstance(item, h5py.Dataset) else np.zeros(3)
        kept = dict(item.attrs)
        del file[name]
        if rng.random() < 0.1:
            return f"without {name}"
        if rng.random() < 0.1:
            file.create_group(name)
            return f"{name} as a group"
        file[name] = made
        for each, value in kept.items():
            file[name].attrs[each] = value
        return f"{name} = {made!r}"[:200]


CARDS = (*TEXTS[:4], 1e30, -1.0, 0, -1, True, 2**60, "1E400")


def spoil_fits(path: Path, rng: random.Random) -> str:
    """Change a card of a header or a value of a table; which it was."""
    with fits.open(path) as file:
        hdus = [hdu.copy() for hdu in file]
    hdu = rng.choice(hdus)
    names = getattr(hdu, "columns", None) and hdu.columns.names
    if names and rng.random() < 0.5:
        name = rng.choice(names)
        values = hdu.data[name]
        if values.dtype.kind in "fiu" and values.size:
            made: Any = rng.choice((np.nan, np.inf, -1, 0, 255))
            with np.errstate(all="ignore"):
                values.flat[rng.randrange(values.size)] = np.array(made).astype(values.dtype)
        elif len(values):
            made = rng.choice(("x", "", "nan", "[", "NaN", "{}"))
            values[rng.randrange(len(values))] = made
        what = f"{hdu.name}.{name} {made!r}" if len(values) else "nothing"
    else:
        keys = [k for k in hdu.header if k and k not in ("COMMENT", "SIMPLE", "XTENSION", "END")]
        key = rng.choice(keys)
        made = rng.choice(CARDS)
        hdu.header[key] = made
        what = f"{hdu.name}: {key} = {made!r}"
    raw = b""
    for each in hdus:  # as it stands: astropy would mend a header
        data = b"" if each.data is None else each.data.tobytes()
        raw += each.header.tostring().encode() + data + bytes(-len(data) % 2880)
    path.write_bytes(raw)
    return what


def spoil_text(path: Path, rng: random.Random) -> str:
    """Change a value of TOML."""
    lines = path.read_text().splitlines()
    row = rng.randrange(len(lines))
    begin, mark, _ = lines[row].partition(" = ")
    made = rng.choice(("nan", "inf", "-1", "0", '"x"', "[]", "{}", "[nan, 0, 0, 1]", "1e308", "="))
    lines[row] = f"{begin}{mark}{made}" if mark else made
    path.write_text("\n".join(lines))
    return lines[row]


def mapped(path: Path) -> None:
    """A run of a pipeline that a user would write, to its files."""
    steps = [zonda.HighpassFilter(frequency="0.5 Hz"), zonda.BinMap(pixel="10 arcmin")]
    recorded = zonda.LoadTOD(file=path, unit="K_RJ")
    scene = recorded.scene(instrument=INSTRUMENT, seed=1)
    steps = [recorded, zonda.Efficiency(), *steps, zonda.SaveMap()]
    data = zonda.Pipeline(steps).run(scene, output=path.with_suffix(""), threads=1)
    for found in data.products.values():
        if hasattr(found, "hits"):
            assert np.isfinite(found.signal[found.hits > 0]).all()


def laid_out(path: Path) -> None:
    """The detectors of a focal plane are finite."""
    table = read_array(path)
    for name, values in table.columns.items():
        assert np.isfinite(values).all(), name
    assert len(table.names)


@cache
def scan() -> Any:
    """A small scan of a detector of 93 GHz and a dead one, with all that a file may have."""
    tod = fuzzer("hdf5").tiny_scan(2, 60)
    moving = from_angles(np.linspace(0, 0.02, 60), np.full(60, 0.8))
    tod.boresight_azel = tod.boresight_radec = moving
    tod.columns["band_width"] = np.full(2, 2e10)
    tod.metadata |= {"centre_ra": 0.01, "centre_dec": 0.8, "band": "f090", "telescope": "dish"}
    tod.metadata |= {"telescope_diameter": 6.0}
    tod.intervals = {"throw": [(0.0, 5.9)]}
    tod.hwp_angle = np.linspace(0, 6, 60)
    tod.azimuth = -np.linspace(0, 0.02, 60) % (2 * np.pi)
    return tod


def scan_file(path: Path) -> Path:
    from zonda.operators.io.save_tod import save_tod

    return save_tod(path, scan())


Spoil = Callable[[Path, random.Random], str]
KINDS: dict[str, tuple[Callable[[Path], Path], str, Spoil, Callable[[Path], None]]] = {
    "AxisManager": (saved, "a.h5", spoil_hdf5, mapped),
    "TOAST": (scan_file, "t.h5", spoil_hdf5, mapped),
    "FITS": (scan_file, "f.fits", spoil_fits, mapped),
    "focal plane": (toast_file, "p.h5", spoil_hdf5, laid_out),
    "hardware": (hardware, "hw.toml", spoil_text, laid_out),
}


def flip(path: Path, rng: random.Random) -> str:
    """Change a byte, or some."""
    made = bytearray(path.read_bytes())
    at = [rng.randrange(len(made)) for _ in range(rng.choice((1, 3, 30)))]
    for place in at:
        made[place] = rng.randrange(256)
    path.write_bytes(made)
    return f"bytes {at}"


def tried(kind: str, folder: Path, seeds: range, spoil: Spoil | None = None) -> int:
    """Spoil a file in as many ways as there are seeds, and read it; how many were refused."""
    make, name, usual, use = KINDS[kind]
    whole, refused = make(folder / f"whole-{name}"), 0
    use(whole)
    for seed in seeds:
        path = folder / str(seed) / name
        path.parent.mkdir()
        shutil.copy(whole, path)
        what = (spoil or usual)(path, random.Random(seed))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                use(path)
        except ZondaError:
            refused += 1
        except Exception as err:
            raise AssertionError(f"seed {seed}: {what}: {type(err).__name__}: {err}") from err
        shutil.rmtree(path.parent)
    return refused


@pytest.mark.parametrize("kind", KINDS)
def test_another_value(kind: str, tmp_path: Path) -> None:
    assert tried(kind, tmp_path, range(6)) > 0


@pytest.mark.parametrize("kind", ["FITS", "hardware"])
def test_other_bytes(kind: str, tmp_path: Path) -> None:
    tried(kind, tmp_path, range(6), flip)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_many_other_values(kind: str, tmp_path: Path) -> None:
    assert tried(kind, tmp_path, range(1000, 1300)) > 50


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_many_other_bytes(kind: str, tmp_path: Path) -> None:
    """HDF5's too: what is left of a file that libhdf5 opens."""
    tried(kind, tmp_path, range(1000, 1060), flip)
