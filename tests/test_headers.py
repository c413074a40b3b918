"""Headers of input maps with each card removed or set to what it is not: `zonda check` and a run
agree, in clean words.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

import zonda
from zonda.core.assembly.checks import looks
from zonda.core.errors import ZondaError

WORLD = {
    "CTYPE1": "RA---TAN",
    "CTYPE2": "DEC--TAN",
    "CRPIX1": 6.0,
    "CRPIX2": 6.0,
    "CRVAL1": 75.0,
    "CRVAL2": 20.0,
    "CDELT1": -1 / 60,
    "CDELT2": 1 / 60,
    "CUNIT1": "deg",
    "CUNIT2": "deg",
    "RADESYS": "ICRS",
}
KELVIN = {"BUNIT": "K", "TEMPSCAL": "K_RJ"}
JANSKY = {"BUNIT": "Jy/beam", "BMAJ": 0.05, "BMIN": 0.05}
STOKES = {"CTYPE3": "STOKES", "CRPIX3": 1.0, "CRVAL3": 1.0, "CDELT3": 1.0, "POLCCONV": "COSMO"}
OTHER = {"CTYPE1": "RA---SIN", "CTYPE2": "DEC--SIN", "EQUINOX": 2000.0, "RADESYS": "FK5"}
IMAGES = {
    "kelvin": ((11, 11), WORLD | KELVIN),
    "jansky": ((11, 11), WORLD | JANSKY),
    "stokes": ((3, 11, 11), WORLD | KELVIN | STOKES),
    "slanted": ((11, 11), WORLD | KELVIN | OTHER),
}
SKY = {
    "PIXTYPE": "HEALPIX",
    "ORDERING": "RING",
    "NSIDE": 64,
    "COORDSYS": "C",
    "BAD_DATA": -1.6375e30,
    "INDXSCHM": "IMPLICIT",
}
TABLES = {
    "full": (["TEMPERATURE"], SKY),
    "partial": (
        ["PIXEL", "I_STOKES", "Q_STOKES", "U_STOKES"],
        SKY | {"INDXSCHM": "EXPLICIT", "POLCCONV": "IAU"},
    ),
}
VALUES = [None, "x", 0, -1, 1e30, True]
"""None: the card is removed."""
NUMBERS = {
    *(f"{key}{k}" for key in ("CRPIX", "CRVAL", "CDELT") for k in (1, 2, 3)),
    "EQUINOX",
    "BMAJ",
    "BMIN",
    "NSIDE",
    "BAD_DATA",
}
"""Cards that are numbers: a text or a logical value is named in the message."""


def write(path: Path, name: str, changes: dict[str, Any]) -> None:
    """A file with some cards changed."""
    if name in IMAGES:
        shape, cards = IMAGES[name]
        hdus = [fits.PrimaryHDU(np.random.default_rng(0).normal(size=shape))]
    else:
        names, cards = TABLES[name]
        pixels = np.arange(12 * 64**2) if name == "full" else np.arange(16000, 20000)
        values = np.random.default_rng(0).normal(size=len(pixels))
        columns = [
            (
                fits.Column(n, "K", array=pixels)
                if n == "PIXEL"
                else fits.Column(n, "D", unit="K_RJ", array=values)
            )
            for n in names
        ]
        hdus = [fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]
        cards = cards | {f"TUNIT{k}": "K_RJ" for k, n in enumerate(names, 1) if n != "PIXEL"}
        cards |= {f"TTYPE{k}": n for k, n in enumerate(names, 1)}
    hdus[-1].header.update(cards)
    fits.HDUList(hdus).writeto(path, overwrite=True)
    for key, value in changes.items():  # as they are: astropy would write those of columns anew
        if value is None:
            fits.delval(path, key, ext=len(hdus) - 1)
        else:
            fits.setval(path, key, value=value, ext=len(hdus) - 1)


def verdicts(path: Path) -> tuple[str, str]:
    """What a look and a run say, each in the first line of its error; empty: they accept the
    file.
    """
    camera = {"like": "mustang2", "detectors": 8, "sample_rate": "10 Hz", "polarization": "pairs"}
    scene = zonda.Scene(
        site="green_bank", instrument=camera, time="2024-11-25T07:00", target="05h +20d", seed=1
    )
    steps = [
        zonda.PointingDaisy(radius="1 arcmin", speed="20 arcsec/s", scan_duration="1 s"),
        zonda.SkyMap(file=path),
    ]
    pipeline, said = zonda.Pipeline([*steps, zonda.Efficiency()]), []
    for act in (
        lambda: [str(err) for _, err in looks(pipeline.operators, scene)[1]],
        lambda: run(pipeline, scene),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = act()
        said.append(found[0].splitlines()[0] if found else "")
    return said[0], said[1]


def run(pipeline: zonda.Pipeline, scene: zonda.Scene) -> list[str]:
    """Without a look before it."""
    fresh = zonda.Pipeline([operator.model_copy(deep=True) for operator in pipeline.operators])
    try:
        sky = fresh.run(scene, keep=("sky",)).observations[0].detdata["sky"]
    except ZondaError as err:
        return [str(err)]
    assert np.isfinite(sky).all()
    return []


def cards_of(name: str) -> list[str]:
    """What is its own."""
    if name in TABLES:
        names, cards = TABLES[name]
        columns = [
            f"{key}{k}"
            for k, n in enumerate(names, 1)
            for key in ("TTYPE", "TUNIT")
            if (n, key) != ("PIXEL", "TUNIT")
        ]
        return [*cards, *columns] if name == "full" else [*columns, "INDXSCHM", "POLCCONV"]
    return list(
        {"kelvin": WORLD | KELVIN, "jansky": JANSKY, "stokes": STOKES, "slanted": OTHER}[name]
    )


@pytest.mark.parametrize(
    ("name", "card"), [(name, card) for name in (*IMAGES, *TABLES) for card in cards_of(name)]
)
def test_check_and_run_agree(tmp_path: Path, name: str, card: str) -> None:
    """Whatever a card is; what either raises that is no `ZondaError` fails the test."""
    write(tmp_path / "map.fits", name, {})
    assert verdicts(tmp_path / "map.fits") == ("", "")
    for value in VALUES:
        path = tmp_path / f"{str(value).replace('.', '_')}.fits"
        write(path, name, {card: value})
        look, ran = verdicts(path)
        assert bool(look) == bool(ran), f"{card} = {value!r}: check says {look!r}, run {ran!r}"
        if isinstance(value, str | bool) and card in NUMBERS:
            assert f"{card} = " in look
