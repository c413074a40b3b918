"""Plain FITS images against `astropy.io.fits`, which is asked for everything else."""

from __future__ import annotations

import pickle
import random
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from hypothesis import given, settings
from hypothesis import strategies as st

from zonda.core.storage.fits_image import BLOCK, CARD, Cards, image_pieces, read_image

COMMENTARY = ("", "COMMENT", "HISTORY")
many = settings(max_examples=300, deadline=None, derandomize=True, database=None)


def image_bytes(*arguments: Any, **named: Any) -> bytes:
    return b"".join(image_pieces(*arguments, **named))


def as_astropy(path: Path) -> tuple[dict[str, Any], np.ndarray]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with fits.open(path, memmap=False) as hdus:
            values = hdus[0].data
            return {k: v for k, v in hdus[0].header.items() if k not in COMMENTARY}, values


def agree(path: Path) -> bool:
    """True where the file is read, and then as astropy reads it: the same keys in the same order,
    values, types and pixels.
    """
    found = read_image(path)
    if found is None:
        return False
    header, values = as_astropy(path)
    assert list(found[0].items()) == list(header.items())
    assert [type(v) for v in found[0].values()] == [type(v) for v in header.values()]
    assert found[1].dtype == values.dtype
    assert found[1].shape == values.shape
    assert found[1].tobytes() == values.tobytes()
    return True


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fits") / "image.fits"


def plain(*cards: str, values: np.ndarray | None = None) -> bytes:
    """A plain image whose header goes on with ``cards``."""
    image = fits.PrimaryHDU(np.arange(6.0).reshape(2, 3) if values is None else values)
    head = "".join(
        str(c).ljust(CARD) for c in image.header.cards if c.keyword != "EXTEND"
    ) + "".join(c.ljust(CARD) for c in cards)
    head += "END".ljust(CARD)
    data = image.data.astype(image.data.dtype.newbyteorder(">")).tobytes()
    return (
        head.ljust(-(-len(head) // BLOCK) * BLOCK).encode("latin-1")
        + data
        + bytes(-len(data) % BLOCK)
    )


# -- reading --


@pytest.mark.parametrize("shape", [(7,), (4, 5), (1, 4, 5), (2, 3, 4, 5)])
@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.int64, np.float32, np.float64])
def test_types_and_shapes(file: Path, dtype: Any, shape: tuple[int, ...]) -> None:
    fits.PrimaryHDU((np.random.default_rng(1).standard_normal(shape) * 50).astype(dtype)).writeto(
        file, overwrite=True
    )
    assert agree(file)


TEXT = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=30)
NUMBERS = (
    st.integers(-(10**20), 10**20)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.booleans()
)


@many
@given(
    st.dictionaries(
        st.from_regex(r"[A-Z][A-Z0-9_-]{0,7}", fullmatch=True),
        st.tuples(NUMBERS | TEXT, TEXT),
        max_size=40,
    )
)
def test_headers_that_astropy_writes(file: Path, cards: dict[str, tuple[Any, str]]) -> None:
    image = fits.PrimaryHDU(np.ones((2, 3), np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for key, card in cards.items():
            if key not in (
                *image.header,
                "END",
                "CONTINUE",
                "HIERARCH",
                "GROUPS",
                "SIMPLE",
                "XTENSION",
            ):
                image.header[key] = card
        image.writeto(file, overwrite=True)
    agree(file)


VALUES = [
    "T",
    "F",
    "t",
    "0",
    "-0",
    "+7",
    "007",
    "1.",
    ".5",
    "-1.5",
    "+1.5E3",
    "1.5E+03",
    "1.5e3",
    "1.5D3",
    "1E5",
    "1.E400",
    "NaN",
    "INF",
    "'a'",
    "'a  '",
    "'  a'",
    "''",
    "'   '",
    "'it''s'",
    "'a' b",
    "'a'/b'c'",
    "'a",
    "'a&'",
    "'x: 5'",
    "'AXIS.1: 2'",
    "'12:30:05'",
    "'tab\t'",
    "(1, 2)",
    "",
    "/ only a comment",
    "5/6",
    "5 6",
    "5 /",
    "'a''/ b' / c",
    "1 2",
    "- 3",
    "99999999999999999999",
    "1_000",
    "'\xe9'",
]
NAMES = [
    "KEY",
    "K-E_Y9",
    "key",
    "A KEY",
    "CTYPE1",
    "COMMENT",
    "HISTORY",
    "",
    "HIERARCH",
    "CONTINUE",
    "NAXIS",
    "NAXIS3",
    "BITPIX",
    "BSCALE",
    "BZERO",
    "BLANK",
    "GROUPS",
    "PCOUNT",
    "END",
    "EXTEND",
    "SIMPLE",
    "XTENSION",
    "DP1",
    "ZIMAGE",
]
EQUALS = ["= ", "=", " =", "  ", " = "]


@many
@given(
    st.lists(
        st.tuples(
            st.sampled_from(NAMES),
            st.sampled_from(EQUALS),
            st.sampled_from(VALUES),
            st.integers(0, 12),
        ),
        max_size=4,
    )
)
def test_cards_of_all_kinds(file: Path, cards: list[tuple[str, str, str, int]]) -> None:
    file.write_bytes(
        plain(*(f"{name:8}{equals}{' ' * gap}{value}" for name, equals, value, gap in cards))
    )
    agree(file)


@pytest.mark.parametrize("value", VALUES)
def test_every_value(file: Path, value: str) -> None:
    read = []
    for gap in ("", " ", " " * 9):
        file.write_bytes(plain(f"KEY     = {gap}{value}"))
        read.append(agree(file))
    assert len(set(read)) == 1


def test_what_is_read_at_all(file: Path) -> None:
    """The tests above hold for a reader that reads nothing."""
    for value in (
        "T",
        "+7",
        "007",
        "1.",
        "-1.5",
        "1.5E+03",
        "'a  '",
        "''",
        "'12:30:05'",
        "5/6",
        "'a' / of it",
        "-1.5 / [deg] why",
    ):
        file.write_bytes(
            plain(f"KEY     = {value}", "COMMENT = 'x", "HISTORY of it", "", "EXTEND  = T")
        )
        assert agree(file), value


@pytest.mark.parametrize(
    "cards",
    [
        ["BSCALE  = 1.0"],
        ["BZERO   = 0"],
        ["BLANK   = -1"],
        ["GROUPS  = T"],
        ["PCOUNT  = 0"],
        ["KEY     = 1", "KEY     = 1"],
        ["KEY     = 'a&'", "CONTINUE  'b'"],
        ["HIERARCH A B = 1"],
        ["key     = 1"],
        ["KEY     = 1D3"],
        ["NAXIS3  = 1"],
        ["OBJECT  = 'AXIS.1: 2'"],
        ["KEY     ="],
        ["KEY     = 'it''s'"],
        ["KEY     = '' / '"],
        ["COMMENT \xe9"],
        ["XTENSION= 'IMAGE   '"],
    ],
)
def test_what_is_left_to_astropy(file: Path, cards: list[str]) -> None:
    file.write_bytes(plain(*cards))
    assert read_image(file) is None


def test_files_that_are_not_one_whole_image(file: Path, tmp_path: Path) -> None:
    whole = plain()
    file.write_bytes(whole)
    assert agree(file)
    no_mark, no_end, no_type = (
        (b"SIMPLE  =  ", b"SIMPLE  = T"),
        (b"END  ", b"END ="),
        (b"  -64", b"  -63"),
    )
    replaced = [whole.replace(*pair, 1) for pair in (no_mark, no_end, no_type)]
    for data in (b"", whole[:BLOCK], whole[:-1], whole[:-BLOCK], whole + bytes(BLOCK), *replaced):
        file.write_bytes(data)
        assert read_image(file) is None
    assert read_image(tmp_path / "none.fits") is None
    assert read_image(tmp_path) is None
    for hdus in ([fits.PrimaryHDU()], [fits.PrimaryHDU(), fits.ImageHDU(np.ones((2, 2)))],
                 [fits.PrimaryHDU(np.ones((2, 2))), fits.ImageHDU()], [fits.PrimaryHDU(np.ones((2, 2), np.uint16))]):  # fmt: skip
        fits.HDUList(hdus).writeto(file, overwrite=True)
        assert read_image(file) is None


@pytest.mark.parametrize("how", ["byte", "letter", "card", "cut"])
def test_damage(file: Path, how: str) -> None:
    """Whatever is still read is what astropy reads."""
    header = fits.Header(
        [
            ("CTYPE1", "RA---TAN"),
            ("CRVAL1", 75.5, "[deg]"),
            ("BUNIT", "K"),
            ("N", 3),
            ("FLAG", True),
        ]
    )
    fits.PrimaryHDU(np.arange(12, dtype=np.int16).reshape(3, 4), header).writeto(
        file, overwrite=True
    )
    whole, read = file.read_bytes(), 0
    for seed in range(400):
        rng, made = random.Random(seed), bytearray(whole)
        at = rng.randrange(12 * CARD)
        if how == "byte":
            made[at] = rng.randrange(256)
        elif how == "letter":
            made[at] = rng.choice(b"0123456789-+.'/ETFD= ")
        elif how == "card":
            first, second = (CARD * rng.randrange(12) for _ in range(2))
            made[first : first + CARD] = whole[second : second + CARD]
        else:
            del made[CARD * rng.randrange(1, 12) :][: rng.randrange(BLOCK)]
        file.write_bytes(made)
        read += agree(file)
    assert read > 20 or how == "cut"


# -- writing --


WRITABLE = st.dictionaries(
    st.from_regex(r"[A-Z][A-Z0-9_-]{0,7}", fullmatch=True),
    st.tuples(
        NUMBERS
        | st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=200)
        | st.none(),
        TEXT,
    ),
    max_size=30,
)


@many
@given(
    WRITABLE,
    st.lists(st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=150), max_size=5),
)
def test_astropy_reads_what_is_written(
    file: Path, given: dict[str, tuple[Any, str]], history: list[str]
) -> None:
    reserved = (
        "END",
        "COMMENT",
        "HISTORY",
        "CONTINUE",
        "HIERARCH",
        "SIMPLE",
        "XTENSION",
        "BITPIX",
        "GROUPS",
        "BSCALE",
        "BZERO",
    )
    rvkc = {k: v for k, v in given.items() if isinstance(v[0], str) and ": " in v[0]}
    wanted = {
        k: v
        for k, v in given.items()
        if k not in (*reserved, *rvkc) and not k.startswith(("NAXIS", "PCOUNT", "GCOUNT", "BLANK"))
    }
    cards = Cards((key, *card) for key, card in wanted.items())
    for line in history:
        cards["HISTORY"] = line
    first, second = np.arange(6.0).reshape(2, 3) - 1e300, np.arange(8, dtype=np.int32).reshape(4, 2)
    file.write_bytes(image_bytes(cards, first) + image_bytes(cards, second, extension=True))
    with fits.open(file, memmap=False) as hdus:
        hdus.verify("exception")
        for hdu, values in zip(hdus, (first, second), strict=True):
            assert np.array_equal(hdu.data, values)
            for key, (value, comment) in wanted.items():
                read = hdu.header[key]
                if value is None:
                    assert isinstance(read, fits.card.Undefined) or read is None
                else:
                    assert read == (value.rstrip() if isinstance(value, str) else value)
                    assert type(read) is type(value)
                assert comment.strip().startswith(hdu.header.comments[key].strip())
            lines = [
                line[k : k + 72].rstrip()
                for line in history
                for k in range(0, max(len(line), 1), 72)
            ]
            assert list(hdu.header.get("HISTORY", [])) == lines


def test_every_type_is_written(file: Path) -> None:
    for kind in ("u1", "i2", "i4", "i8", "f4", "f8"):
        values = (np.random.default_rng(0).standard_normal((5, 3)) * 100).astype(kind)
        file.write_bytes(image_bytes(Cards([("KEY", 1.5, "[m]")]), values))
        with fits.open(file) as hdus:
            hdus.verify("exception")
            assert hdus[0].data.dtype == np.dtype(kind).newbyteorder(">")
            assert np.array_equal(hdus[0].data, values)
            assert hdus[0].header.comments["KEY"] == "[m]"
        assert agree(file)


@pytest.mark.parametrize(
    ("key", "value"),
    [("KEY", "\xe9"), ("KEY", float("nan")), ("key", 1), ("LONGERKEY", 1), ("A B", 1)],
)
def test_what_no_card_holds(key: str, value: Any) -> None:
    with pytest.raises(ValueError, match="FITS"):
        Cards([(key, value)]).tostring()


def test_cards_are_a_header_for_astropy() -> None:
    cards = Cards(
        [("CTYPE1", "RA---TAN", "axis"), ("CTYPE2", "DEC--TAN"), ("CRVAL1", 75.0), ("CRVAL2", 20.0)]
    )
    assert list(WCS(cards).wcs.crval) == [75.0, 20.0]
    assert fits.Header(cards)["CTYPE1"] == "RA---TAN"
    assert fits.Header.fromstring(cards.tostring()).comments["CTYPE1"] == "axis"
    for made in (cards.copy(), pickle.loads(pickle.dumps(cards))):
        assert made == cards
        assert made.tostring() == cards.tostring()
    made["CRVAL1"] = 1.0
    assert cards["CRVAL1"] == 75.0
