"""Plain FITS images (FITS 4.0, sections 3.3, 4 and 7.1) without `astropy.io.fits`, which takes 0.2
s to import: its only reason.

Read is what can be read in one way only: a file that is one uncompressed, unscaled image.
Everything else, errors too, is for astropy (`core.storage.fits_files`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Value = bool | int | float | str | None
BLOCK, CARD = 2880, 80
LARGEST = 1 << 26
"""Bytes of a file above which the import of astropy is no matter."""
LONGEST = 100
"""Blocks of a header."""
PIECE = 1 << 20
"""Bytes of an image that are converted at a time."""

_TYPES = {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}
_BEGIN, _END = b"SIMPLE  =                    T", b"END".ljust(CARD)
_KEY = re.compile(rb"[A-Z0-9_-]+")
_VALUE = re.compile(
    rb" *(?:'(?P<text>[^']*)'|(?P<truth>[TF])|(?P<whole>[+-]?\d{1,18})"
    rb"|(?P<real>[+-]?\d+\.\d*(?:E[+-]?\d+)?))"
    rb" *(?:/[^']*)?"
)
_READ: dict[str, Callable[[str], Value]] = {
    "text": str.rstrip,
    "truth": "T".__eq__,
    "whole": int,
    "real": float,
}
_OTHER = {
    "XTENSION",
    "GROUPS",
    "PCOUNT",
    "GCOUNT",
    "BSCALE",
    "BZERO",
    "BLANK",
    "ZIMAGE",
    "CONTINUE",
    "HIERARCH",
    "END",
}
"""Keys of what is no plain image."""


class Cards(dict[str, Value]):
    """The keywords of a FITS header; `astropy.io.fits.Header` and `astropy.wcs.WCS` take it as it
    is.

    ``cards[key] = value, comment`` sets both; ``cards["HISTORY"] = text`` adds a line to `history`.
    """

    def __init__(self, cards: Iterable[tuple[Any, ...]] = ()) -> None:
        super().__init__()
        self.comments: dict[str, str] = {}
        self.history: list[str] = []
        for key, *value in cards:
            self[key] = tuple(value) if len(value) > 1 else value[0]

    def __setitem__(self, key: str, value: Value | tuple[Value, str]) -> None:
        if key == "HISTORY":
            self.history.append(str(value))
            return
        if isinstance(value, tuple):
            value, self.comments[key] = value
        super().__setitem__(key, value)

    def copy(self) -> Cards:
        return Cards().add(self)

    def add(self, other: Cards) -> Cards:
        """Itself, with the keywords, comments and history of another."""
        for key, value in other.items():
            self[key] = value, other.comments.get(key, "")
        self.history += other.history
        return self

    def tostring(self) -> str:
        """As in a file, END and padding too. Raises ValueError for what a card does not hold."""
        lines = [_card(key, value, self.comments.get(key, "")) for key, value in self.items()]
        for text in self.history:
            lines += [f"HISTORY {text[k : k + 72]}" for k in range(0, max(len(text), 1), 72)]
        whole = "".join(line.ljust(CARD) for line in [*lines, "END"])
        if not re.fullmatch("[ -~]*", whole):
            raise ValueError("FITS headers hold printable ASCII")
        return whole.ljust(-(-len(whole) // BLOCK) * BLOCK)


def read_image(path: Path) -> tuple[Cards, NDArray[Any]] | None:
    """Header and pixels (ny, nx), or with more axes, of a file that is one plain image; None where
    it may be anything else.

    COMMENT, HISTORY and the cards' comments are left out.
    """
    try:
        with open(path, "rb") as file:
            size = file.seek(0, 2)
            file.seek(0)
            head = file.read(BLOCK)
            if size % BLOCK or size > LARGEST or not head.startswith(_BEGIN):
                return None
            while (end := _end(head)) is None and len(head) < LONGEST * BLOCK:
                if not (more := file.read(BLOCK)):
                    return None
                head += more
            cards = None if end is None else _parsed(head, end)
            shape = () if cards is None else _shape(cards)
            if cards is None or not shape:
                return None
            dtype = np.dtype(_TYPES[int(cards["BITPIX"] or 0)])
            length = math.prod(shape) * dtype.itemsize
            if len(head) + -(-length // BLOCK) * BLOCK != size:
                return None
            data = file.read(length)
    except OSError:
        return None
    return (cards, np.frombuffer(data, dtype).reshape(shape)) if len(data) == length else None


def image_pieces(
    cards: Cards, values: NDArray[Any], *, extension: bool = False, dtype: Any = None
) -> Iterator[bytes]:
    """An image HDU, the file's first or an ``extension``, piece by piece: ``values`` (ny, nx), or
    with more axes, as ``dtype`` (uint8, int16 ... int64, float32, float64; default: as they
    are)."""
    dtype = np.dtype(values.dtype if dtype is None else dtype)
    bits = dtype.itemsize * (-8 if dtype.kind == "f" else 8)
    first = (
        ("XTENSION", "IMAGE", "image extension")
        if extension
        else ("SIMPLE", True, "conforms to FITS standard")
    )
    made = Cards(
        [
            first,
            ("BITPIX", bits, "array data type"),
            ("NAXIS", values.ndim, "number of array dimensions"),
        ]
    )
    for k, n in enumerate(reversed(values.shape), 1):
        made[f"NAXIS{k}"] = n
    for key, value in {"PCOUNT": 0, "GCOUNT": 1}.items() if extension else [("EXTEND", True)]:
        made[key] = value
    yield made.add(cards).tostring().encode("ascii")
    rows = max(1, PIECE // max(1, dtype.itemsize * math.prod(values.shape[1:])))
    for k in range(0, values.shape[0], rows):
        yield values[k : k + rows].astype(_TYPES[bits]).tobytes()
    yield bytes(-values.size * dtype.itemsize % BLOCK)


# -- reading --


def _end(head: bytes) -> int | None:
    """Where END stands; None where it does not."""
    return next(
        (
            k
            for k in range(max(0, len(head) - BLOCK), len(head), CARD)
            if head[k : k + CARD] == _END
        ),
        None,
    )


def _parsed(head: bytes, end: int) -> Cards | None:
    """The cards before ``end``, or None where one can be read in more than one way."""
    if not re.fullmatch(rb"[ -~]*", head) or head[end + CARD :].strip(b" "):
        return None
    cards = Cards()
    for card in (head[k : k + CARD] for k in range(0, end, CARD)):
        name = card[:8].rstrip(b" ")
        if name in (b"", b"COMMENT", b"HISTORY"):
            continue
        found = _VALUE.fullmatch(card, 10)
        key = name.decode()
        if (
            found is None
            or card[8:10] != b"= "
            or not _KEY.fullmatch(name)
            or key in cards
            or key in _OTHER
        ):
            return None
        kind, text = found.lastgroup or "", found[found.lastgroup or 0].decode()
        if kind == "text" and ": " in text:  # a record-valued card (FITS WCS Paper IV)
            return None
        cards[key] = _READ[kind](text)
    return cards


def _shape(cards: Cards) -> tuple[int, ...]:
    """Of the array, slowest axis first; () where the mandatory cards are not in their order, or the
    type or a length is none.
    """
    axes = cards.get("NAXIS")
    if (
        type(axes) is not int
        or not 0 < axes < 10
        or type(cards.get("BITPIX")) is not int
        or cards["BITPIX"] not in _TYPES
    ):
        return ()
    names = [f"NAXIS{k}" for k in range(1, axes + 1)]
    if (
        list(cards)[: 3 + axes] != ["SIMPLE", "BITPIX", "NAXIS", *names]
        or sum(k.startswith("NAXIS") for k in cards) != 1 + axes
    ):
        return ()
    lengths = [cards[name] for name in reversed(names)]
    return (
        tuple(n for n in lengths if type(n) is int)
        if all(type(n) is int and n > 0 for n in lengths)
        else ()
    )


# -- writing --


def _card(key: str, value: Value, comment: str) -> str:
    """A card in fixed format; a text too long for it goes on in CONTINUE cards (FITS 4.0, section
    4.2.1.2).
    """
    if not re.fullmatch(r"[A-Z0-9_-]{1,8}", key) or key in (
        "COMMENT",
        "CONTINUE",
        "END",
        "HIERARCH",
    ):
        raise ValueError(f"{key!r} is no FITS keyword")
    if isinstance(value, str):
        text = value.replace("'", "''")
        if len(text) > 68:
            return _continued(key, value)
        shown = f"'{text:8}'".ljust(20)
    elif isinstance(value, bool | np.bool_):
        shown = f"{'T' if value else 'F':>20}"
    elif isinstance(value, int | np.integer):
        shown = f"{int(value):>20}"
    elif value is None:
        shown = " " * 20
    elif math.isfinite(value):
        digits, _, power = repr(float(value)).partition("e")
        shown = f"{digits if '.' in digits else digits + '.0'}{'E' + power if power else ''}".rjust(
            20
        )
    else:
        raise ValueError(f"{key} = {value}: FITS headers hold finite numbers")
    card = f"{key:8}= {shown}" + (f" / {comment}" if comment else "")
    return card[:CARD]


def _continued(key: str, value: str) -> str:
    pieces = [
        value[k : k + 33].replace("'", "''") for k in range(0, len(value), 33)
    ]  # all of it may be quotes
    begins = [f"{key:8}= ", *["CONTINUE  "] * (len(pieces) - 1)]
    ends = ["&'"] * (len(pieces) - 1) + ["'"]
    return "".join(f"{b}'{p}{e}".ljust(CARD) for b, p, e in zip(begins, pieces, ends, strict=True))
