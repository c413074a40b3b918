"""FITS files that claim what cannot be, and HDF5 files likewise: refused before anything is read or
counted.
"""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from astropy.io import fits

from zonda.core import machine
from zonda.core.errors import InputError
from zonda.core.storage import fits_files, hdf5_files
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


def image(path: Path, **cards: Any) -> Path:
    hdu = fits.PrimaryHDU(np.ones((4, 5)))
    hdu.header.update(WORLD | cards)
    hdu.writeto(path)
    return path


def table(path: Path, values: Any, code: str, **cards: Any) -> Path:
    hdu = fits.BinTableHDU.from_columns([fits.Column("T", code, unit="K_CMB", array=values)])
    hdu.header.update(
        {"PIXTYPE": "HEALPIX", "ORDERING": "RING", "NSIDE": 1, "COORDSYS": "C"} | cards
    )
    hdu.writeto(path)
    return path


def changed(path: Path, key: str, value: str, instead: str = "") -> Path:
    """Replace the first card of a key, bytes for bytes."""
    content = path.read_bytes()
    at = next(k for k in range(0, len(content), 80) if content[k : k + 8] == key.ljust(8).encode())
    path.write_bytes(
        content[:at] + f"{instead or key:8}= {value:>20}".ljust(80).encode() + content[at + 80 :]
    )
    return path


def refused(path: Path, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_map(path)
    assert path.name in caught.value.place
    assert caught.value.cure


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("NAXIS1", "1000000000", "needs .* GB of memory|truncated"),
        ("NAXIS1", "999999999999999999999", "needs .* GB of memory|cannot be read"),
        ("NAXIS1", "-5", "cannot be read|cube|negative length"),
        ("NAXIS1", "-   5", "cannot be read|cube|negative length"),
        ("NAXIS", "1000000000", "more than the 999 that FITS allows"),
        ("NAXIS", "999", "incomplete or corrupt: NAXIS3"),
        ("BITPIX", "7", "incomplete or corrupt: 7"),
        ("NAXIS2", "'four'", "cannot be read"),
    ],
)
def test_headers_that_claim_too_much(tmp_path: Path, key: str, value: str, words: str) -> None:
    refused(changed(image(tmp_path / "map.fits"), key, value), words)


def test_a_table_of_a_billion_columns(tmp_path: Path) -> None:
    refused(
        changed(table(tmp_path / "map.fits", np.ones(12), "D"), "TFIELDS", "1000000000"),
        "TFIELDS = 1000000000",
    )


def test_texts_instead_of_numbers(tmp_path: Path) -> None:
    refused(table(tmp_path / "map.fits", ["warm"] * 12, "4A"), "column T holds no numbers")


@pytest.mark.parametrize("unit", ["NaN", "1E400", "T", "''"])
def test_units_that_are_none(tmp_path: Path, unit: str) -> None:
    refused(changed(image(tmp_path / "map.fits"), "BUNIT", unit), "unit|cannot be read")


def test_a_small_file_that_unpacks_to_a_large_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = changed(changed(image(tmp_path / "map.fits"), "NAXIS1", "20000"), "NAXIS2", "20000")
    with gzip.open(tmp_path / "bomb.fits.gz", "wb") as packed:
        packed.write(path.read_bytes())
    monkeypatch.setattr(machine, "available_memory", lambda: 1 << 30)
    refused(tmp_path / "bomb.fits.gz", "needs 3.2 GB of memory, 1.07 GB are free")


def test_a_header_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fits_files, "HEADER_MAX", 50_000)
    path = image(tmp_path / "map.fits")
    first = path.read_bytes()[:2880].replace(b"END".ljust(80), b"COMMENT".ljust(80))
    path.write_bytes(first + b"COMMENT more".ljust(80) * 10_000)
    refused(path, "a header is longer than 0.05 MB")


def test_sound_files_pass(tmp_path: Path) -> None:
    assert read_map(image(tmp_path / "map.fits")).values.shape == (4, 5)
    assert len(read_map(table(tmp_path / "healpix.fits", np.ones(12), "D")).values) == 12


def test_a_data_set_that_claims_more_than_the_file(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.create_dataset("times", (10**9,), "f8")
        file["small"] = np.zeros(100)
    with hdf5_files.opened(tmp_path / "x.h5", "file", "HDF5", "copy it") as file:
        hdf5_files.check_size(file["small"], "file")
        times = file["times"]
        with pytest.raises(InputError, match="/times claims 8 GB"):
            hdf5_files.check_size(times, "file")


def test_what_the_disk_refuses_is_told_after_libhdf5_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It crashes when it closes a file that it could not write."""
    import errno

    disk = hdf5_files.Disk(tmp_path / "x.h5")
    file = h5py.File(disk, "w")
    file["a"] = np.arange(1000.0)

    class Full:
        closed = False

        def __init__(self, real: Any) -> None:
            self.real = real

        def __getattr__(self, name: str) -> Any:
            return getattr(self.real, name)

        def write(self, data: Any) -> int:
            raise OSError(errno.ENOSPC, "full")

    disk._file = Full(disk._file)  # type: ignore[assignment]
    file["b"] = np.arange(1e6)
    file.close()
    with pytest.raises(OSError, match="full"):
        disk.close()
