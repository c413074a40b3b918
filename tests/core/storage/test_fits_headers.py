"""Headers and images that zonda writes, read by astropy."""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from zonda.core.storage.fits_files import card, header_of, joined, write_image


@pytest.mark.parametrize(
    "value", [1 / 1800, -1 / 3600, -1.2345678901234567e-105, 1e300, 2.0, 0.1 + 0.2, 5, True, "it's"]
)
def test_a_card_keeps_every_digit(value: Any) -> None:
    made = header_of([("KEY", value, "a comment of some forty letters, no more")])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = fits.Header.fromstring(made.tostring())
    assert read["KEY"] == made["KEY"] == value
    assert made.copy()["KEY"] == value
    assert read.comments["KEY"] == "a comment of some forty letters, no more"


def test_long_texts_and_comments() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = header_of(
            [("LONG", "x" * 200), ("CUT", "y" * 50, "a comment of some forty letters, no more")],
            ["history", ""],
        )
        read = fits.Header.fromstring(made.tostring())
    assert read["LONG"] == "x" * 200
    assert read["CUT"] == "y" * 50
    assert [line.strip() for line in read["HISTORY"]] == ["history", ""]


@pytest.mark.parametrize("value", [np.nan, np.inf, "\u00e9", "line\nline"])
def test_no_card_holds_it(value: Any) -> None:
    with pytest.raises(ValueError, match="FITS"):
        card("KEY", value)


def test_the_last_of_a_key_holds_and_history_stays() -> None:
    one = header_of([("A", 1), ("B", 1 / 1800)], ["first"])
    both = joined(one, header_of([("A", 2, "new")], ["second"]))
    assert dict(both.items()) | {"HISTORY": ""} == {"A": 2, "B": 1 / 1800, "HISTORY": ""}
    assert list(both["HISTORY"]) == ["first", "second"]
    assert one["A"] == 1
    assert fits.Header.fromstring(both.tostring())["B"] == 1 / 1800


@pytest.mark.parametrize("kind", ["u1", "i2", "i4", "i8", "f4", "f8"])
@pytest.mark.parametrize("shape", [(7, 5), (2, 3, 4), (1, 1)])
def test_astropy_reads_what_is_written(kind: str, shape: tuple[int, ...]) -> None:
    values = np.arange(np.prod(shape)).reshape(shape).astype(kind)
    file = io.BytesIO()
    for name in ("ONE", "TWO"):
        write_image(file, header_of([("EXTNAME", name)]), values)
    write_image(file, header_of([("EXTNAME", "THREE")]), values, np.float64)
    file.seek(0)
    with fits.open(file) as hdus:
        hdus.verify("exception")
        assert [hdu.name for hdu in hdus] == ["ONE", "TWO", "THREE"]
        for hdu in hdus:
            np.testing.assert_array_equal(hdu.data, values)
        assert hdus[1].data.dtype.itemsize == values.dtype.itemsize
        assert hdus[2].header["BITPIX"] == -64
