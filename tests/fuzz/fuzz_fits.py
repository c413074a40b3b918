"""FITS files of any bytes, as sky maps and as time-ordered data: finite values in the promised
form, or an `InputError`.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from engine import fuzz, guided_by, scratch, told

with guided_by(
    "zonda.operators.sky",
    "zonda.operators.io",
    "zonda.core.maps",
    "zonda.core.numerics.projection",
    "zonda.core.storage.fits_files",
    "astropy.io.fits",
):
    import numpy as np
    from astropy.io import fits
    from fuzz_hdf5 import tiny_scan, whole

    from zonda import read_map as read_product
    from zonda.core.errors import ZondaError
    from zonda.operators.diagnostics.comparison.files import read_planes
    from zonda.operators.io.save_tod import load_tod, save_tod
    from zonda.operators.sky.input_map import HealpixMap
    from zonda.operators.sky.read import read_map

FILE = scratch(".fits")
CARD = 80


def target(data: bytes) -> None:
    """The first bit of the last byte chooses the reader."""
    FILE.write_bytes(data)
    if data[-1:] == b"\1":
        try:
            tod = load_tod(FILE)
        except ZondaError as err:
            told(err)
            return
        whole(tod)
        return
    for read in (read_product, read_planes):
        try:
            read(FILE)  # type: ignore[operator]
        except ZondaError as err:
            told(err)
    by_header = {"header_alone": True}
    for options in (
        {},
        {"centred": True, "unit": "K_RJ", "pixel_size": 1e-5, "missing": "zero"},
        {"polarized": True},
        by_header,
    ):
        try:
            found = read_map(FILE, **options)  # type: ignore[arg-type]
        except ZondaError as err:
            told(err)
            continue
        assert np.isfinite(found.values).all()
        if options is by_header:
            continue
        if isinstance(found, HealpixMap):
            pixels = (
                np.arange(12 * found.nside**2) if found.pixels is None else found.pixels
            )  # None: of all the sky
            assert len(pixels) == len(found.values)
            assert not len(pixels) or (pixels.min() >= 0 and pixels.max() < 12 * found.nside**2)
        else:
            assert found.values.ndim == 2
            assert np.isfinite(found.sides).all()


VALUES = [
    "T",
    "F",
    "0",
    "-1",
    "1",
    "2",
    "3",
    "8",
    "-32",
    "-64",
    "10**9",
    "1000000000",
    "999999999999999999999",
    "1E308",
    "NaN",
    "'x'",
    "'deg'",
    "'RA---TAN'",
    "'DEC--TAN'",
    "'GLON-CAR'",
    "'RA---ZPN'",
    "'HPX'",
    "''",
    "' '",
    "90.0",
    "-91.0",
    "1E-300",
    "'K_CMB'",
    "'Jy/beam'",
    "'P()'",
    "'PE(9)'",
    "'1PD(9)'",
    "'999999999D'",
    "'0D'",
    "'L'",
    "'5X'",
    "'I'",
    "'nested'",
    "'J2000'",
    "'HITS'",
    "'I_STOKES'",
    "'STOKES'",
    "'COSMO'",
    "-1.6375E+30",
]
KEYS = [
    "SIMPLE",
    "BITPIX",
    "NAXIS",
    "NAXIS1",
    "NAXIS2",
    "NAXIS3",
    "EXTEND",
    "PCOUNT",
    "GCOUNT",
    "GROUPS",
    "XTENSION",
    "TFIELDS",
    "TFORM1",
    "TTYPE1",
    "TFORM2",
    "TDIM1",
    "TSCAL1",
    "TZERO1",
    "TNULL1",
    "THEAP",
    "BSCALE",
    "BZERO",
    "BLANK",
    "BUNIT",
    "TUNIT1",
    "TEMPSCAL",
    "CTYPE1",
    "CTYPE2",
    "CUNIT1",
    "CRVAL1",
    "CRVAL2",
    "CRPIX1",
    "CDELT1",
    "CDELT2",
    "CD1_1",
    "CD1_2",
    "PC1_1",
    "PV2_1",
    "LONPOLE",
    "EQUINOX",
    "RADESYS",
    "NSIDE",
    "ORDERING",
    "PIXTYPE",
    "COORDSYS",
    "INDXSCHM",
    "BMAJ",
    "BMIN",
    "CONTINUE",
    "END",
    "ZIMAGE",
    "ZCMPTYPE",
    "ZBITPIX",
    "ZNAXIS",
    "ZNAXIS1",
    "ZTILE1",
    "BAD_DATA",
    "TTYPE1",
    "TTYPE2",
    "TUNIT2",
    "POLCCONV",
    "CTYPE3",
    "CRVAL3",
    "CRPIX3",
    "CDELT3",
    "LONPOLE",
    "CD2_2",
    "PC2_2",
    "A_ORDER",
    "A_0_2",
    "CPDIS1",
    "D2IM1",
    "CHECKSUM",
]


def mutate(data: bytes, longest: int, seed: int) -> bytes:
    """Half of the time a card is replaced or put in, else libFuzzer's own ways."""
    rng = random.Random(seed)
    if rng.random() < 0.5:
        import atheris

        return bytes(atheris.Mutate(data, longest))
    card = f"{rng.choice(KEYS):8}= {rng.choice(VALUES):>20}".ljust(CARD)[:CARD].encode()
    ends = [k for k in range(0, min(len(data), 20_000), CARD) if data[k : k + 3] == b"END"] or [0]
    end = rng.choice(ends)
    same = [k for k in range(0, len(data), CARD) if data[k : k + 8] == card[:8]]
    if same and rng.random() < 0.8:
        at = rng.choice(same)
    elif (
        data[end + CARD : end + 2 * CARD].strip(b" ") == b"" and rng.random() < 0.8
    ):  # a free card behind END
        return (data[:end] + card + data[end : end + CARD] + data[end + 2 * CARD :])[:longest]
    else:
        at = CARD * rng.randrange(max(1, min(end, len(data)) // CARD))
    return (data[:at] + card + data[at + CARD :])[:longest]


def seeds() -> Iterator[bytes]:
    rng = np.random.default_rng(0)
    image = fits.PrimaryHDU(rng.standard_normal((4, 5)).astype(np.float32))
    world = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CRPIX1": 3,
        "CRPIX2": 2,
        "CRVAL1": 75.0,
        "CRVAL2": 20.0,
        "CUNIT1": "deg",
    }
    image.header.update(
        {
            **world,
            "CDELT1": -1 / 60,
            "CDELT2": 1 / 60,
            "CUNIT2": "deg",
            "BUNIT": "K",
            "TEMPSCAL": "K_RJ",
        }
    )
    table = fits.BinTableHDU.from_columns(
        [fits.Column("T", "D", unit="K_CMB", array=np.arange(12.0))]
    )
    table.header.update({"PIXTYPE": "HEALPIX", "ORDERING": "RING", "NSIDE": 1, "COORDSYS": "C"})
    columns = [
        fits.Column("PIXEL", "J", array=np.arange(4)),
        fits.Column("T", "E", unit="y", array=np.arange(4.0)),
    ]
    partial = fits.BinTableHDU.from_columns(columns)
    partial.header.update(
        {
            "PIXTYPE": "HEALPIX",
            "ORDERING": "NESTED",
            "NSIDE": 2,
            "COORDSYS": "G",
            "INDXSCHM": "EXPLICIT",
        }
    )
    packed = fits.ImageHDU(
        (rng.standard_normal((4, 5)) * 100).astype(np.int16), header=image.header
    )
    packed.header.update({"BSCALE": 0.1, "BZERO": 3.0, "BLANK": -32768})
    squeezed = fits.CompImageHDU(
        rng.integers(0, 100, (8, 8)).astype(np.int32),
        header=image.header,
        compression_type="RICE_1",
    )
    plate_carree = fits.PrimaryHDU(image.data, image.header)
    plate_carree.header.update(
        {"CTYPE1": "GLON-CAR", "CTYPE2": "GLAT-CAR", "CRVAL2": 0.0, "CRPIX2": -1198.0}
    )
    for hdus in (
        [image],
        [fits.PrimaryHDU(), table],
        [fits.PrimaryHDU(), partial],
        [fits.PrimaryHDU(), packed],
        [fits.PrimaryHDU(), squeezed],
        [plate_carree],
    ):
        fits.HDUList(hdus).writeto(FILE, overwrite=True)
        yield FILE.read_bytes()
    FILE.unlink()
    yield save_tod(FILE, tiny_scan()).read_bytes() + b"\1"


if __name__ == "__main__":
    fuzz("fits", target, seeds, mutate, longest=60_000)
