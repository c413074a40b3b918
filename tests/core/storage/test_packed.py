"""Small files that unpack to much: refused at a stated size; nothing is left behind, and ordinary
ones are read as before.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from astropy.io import fits

from zonda.core.errors import InputError, ZondaError
from zonda.core.instrument import Band
from zonda.core.storage import files, fits_files, hdf5_files, table_files
from zonda.operators.pointing.recording_files import read_recording
from zonda.operators.sky.read import read_map

WORLD = {
    "CTYPE1": "RA---TAN",
    "CTYPE2": "DEC--TAN",
    "CRPIX1": 3,
    "CRPIX2": 2,
    "CRVAL1": 75.0,
    "CRVAL2": 20.0,
    "CDELT1": -0.01,
    "CDELT2": 0.01,
    "CUNIT1": "deg",
    "CUNIT2": "deg",
    "BUNIT": "K_RJ",
}


def zipped(path: Path, content: bytes) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("map.fits", content)


PACK: dict[str, Callable[[Path, bytes], Any]] = {
    "gz": lambda path, content: path.write_bytes(gzip.compress(content)),
    "bz2": lambda path, content: path.write_bytes(bz2.compress(content)),
    "xz": lambda path, content: path.write_bytes(lzma.compress(content)),
    "zip": zipped,
}


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Of temporary files: empty before and after."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield
    assert not list(folder.iterdir())


def image(path: Path, side: int) -> bytes:
    hdu = fits.PrimaryHDU(np.ones((side, side), np.float32))
    hdu.header.update(WORLD)
    hdu.writeto(path)
    return path.read_bytes()


@pytest.mark.parametrize("kind", PACK)
def test_a_small_file_that_unpacks_to_much_is_refused(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"bomb.fits.{kind}"
    PACK[kind](path, image(tmp_path / "plain.fits", 1200))  # 5.8 MB
    assert path.stat().st_size < 30_000
    assert read_map(path).values.shape == (1200, 1200)
    monkeypatch.setattr(files, "UNPACKED_MAX", 5_000_000)
    with pytest.raises(
        InputError, match="unpacks to more than 5 MB, where reading stops"
    ) as caught:
        read_map(path)
    assert path.name in caught.value.place
    assert "unpack it before" in (caught.value.cure or "")
    assert read_map(tmp_path / "plain.fits").values.shape == (
        1200,
        1200,
    )  # the limit is of compressed files


def test_a_header_that_promises_petabytes_is_refused(tmp_path: Path) -> None:
    header = fits.Header(
        [
            ("SIMPLE", True),
            ("BITPIX", 8),
            ("NAXIS", 2),
            ("NAXIS1", 95_000_000),
            ("NAXIS2", 95_000_000),
        ]
    )
    path = tmp_path / "bomb.fits.gz"
    path.write_bytes(gzip.compress(header.tostring().encode() + bytes(2880)))
    with pytest.raises(InputError, match=r"needs 9\.0\de\+06 GB of memory"):
        read_map(path)


def test_zeros_after_a_map_are_not_read_without_end(tmp_path: Path) -> None:
    path = tmp_path / "bomb.fits.gz"
    path.write_bytes(
        gzip.compress(image(tmp_path / "plain.fits", 4) + bytes(fits_files.HEADER_MAX + 2880))
    )
    assert path.stat().st_size < 30_000
    with pytest.raises(InputError, match="a header is longer than 10 MB"):
        read_map(path)


def test_tiles_that_unpack_to_much_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "tiles.fits"
    hdu = fits.CompImageHDU(np.ones((1000, 1000), np.int32), compression_type="RICE_1")
    hdu.header.update(WORLD)
    hdu.writeto(path)
    assert path.stat().st_size < 60_000
    assert read_map(path).values.shape == (1000, 1000)
    monkeypatch.setattr(files, "UNPACKED_MAX", 3_000_000)
    with pytest.raises(InputError, match=r"unpacks to 0\.004 GB; reading stops at 0\.003 GB"):
        read_map(path)


@pytest.mark.parametrize("kind", ["gz", "bz2", "xz"])
def test_a_passband_that_unpacks_to_much_is_refused(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"band.txt.{kind}"
    PACK[kind](path, b"80 0\n90 1\n100 0\n")
    assert Band(name="a", file=path).centre == pytest.approx(90e9)
    PACK[kind](path, b"80 0\n90 1\n" + b"\n" * 16_000_000)
    assert path.stat().st_size < 30_000
    with pytest.raises(ZondaError, match=r"has 16000003 lines, which need 7\.84 GB of memory"):
        Band(name="a", file=path)
    monkeypatch.setattr(table_files, "LARGEST", 16_000_000)
    with pytest.raises(ZondaError, match="unpacks to more than 16 MB, where reading stops"):
        Band(name="a", file=path)
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(ZondaError, match="cannot be read as a table: it cannot be unpacked"):
        Band(name="a", file=path)


def test_a_chunk_that_unpacks_to_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    """libhdf5 unpacks a stored chunk to its end: 100 kB of zeros deflated are 100 MB, in a data set
    of eight numbers.
    """
    import zlib

    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("az", (8,), "f8", chunks=(8,), compression="gzip")
        data.attrs["unit"] = "deg"
        try:
            data.id.write_direct_chunk((0,), zlib.compress(bytes(100_000_000), 9))
        except OSError:
            pytest.skip("this libhdf5 writes no chunk larger than what it holds")
    with pytest.raises(
        InputError, match=r"a chunk of /az is stored in \d+ bytes, more than the 64 that it holds"
    ):
        read_recording(path, "unix")


def test_what_is_deflated_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with h5py.File(path, "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((1000,))
        plist.set_deflate(9)
        plist.set_deflate(9)
        space = h5py.h5s.create_simple((100_000,))
        h5py.Dataset(h5py.h5d.create(file.id, b"az", h5py.h5t.NATIVE_DOUBLE, space, plist))[...] = (
            1.0
        )
    with pytest.raises(InputError, match="/az is deflated twice over"):
        read_recording(path, "unix")


@pytest.mark.parametrize(
    "options",
    [{}, {"compression": "gzip", "shuffle": True}, {"compression": "lzf", "fletcher32": True}],
)
def test_ordinary_chunks_are_read(options: dict[str, Any], tmp_path: Path) -> None:
    values = np.random.default_rng(1).integers(0, 2**63, 5000)  # cannot be compressed
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("noise", data=values, chunks=(700,), **options)
        file.create_dataset("tiny", data=values[:1], chunks=(1,), **options)
        for data in file.values():
            hdf5_files.check_size(data, "here")
