"""Partial products, layouts and records as files: plain values and arrays in numpy's npz, whose own
checksums tell a damaged one. No pickles.

The array ``head`` holds the file's identity and how it was made, ``values`` a tree of mappings,
lists and plain values, both as JSON; a mapping with the key `ARRAY` stands for an array.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..storage.files import atomic_path

ARRAY = "\0array"


def write(
    path: Path,
    identity: str,
    tree: Mapping[str, Any],
    made: Mapping[str, Any] | None = None,
) -> None:
    """Write a tree atomically. ``identity``: of what it is the product, checked by `read`;
    ``made``: how it was made, for `head`.

    Raises `OutputError` where it cannot be written, TypeError for a value that is neither plain nor
    an array.
    """
    arrays: dict[str, Any] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        if not isinstance(value, np.ndarray) or value.dtype.hasobject:
            kind = type(value).__name__
            raise TypeError(f"a partial product holds plain values and arrays, not {kind}")
        arrays[str(len(arrays))] = value
        return {ARRAY: str(len(arrays) - 1)}

    texts = {
        "values": json.dumps(tree, default=plain),
        "head": json.dumps({"identity": identity, "made": dict(made or {})}),
    }
    arrays |= {name: np.frombuffer(text.encode(), np.uint8) for name, text in texts.items()}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)


def read(path: Path, identity: str) -> dict[str, Any]:
    """The tree in a file that `write` made. Raises `InputError` where it is damaged or the product
    of another identity.
    """
    with _opened(path, identity) as (archive, _):
        tree: dict[str, Any] = json.loads(
            archive["values"].tobytes(),
            object_hook=lambda found: archive[found[ARRAY]] if ARRAY in found else found,
        )
        return tree


def head(path: Path, identity: str) -> dict[str, Any]:
    """Statement on how the file was made, as given to `write`. Raises as `read`."""
    with _opened(path, identity) as (_, made):
        return made


def digest_of(path: Path) -> str:
    """BLAKE2b of a file's bytes; empty where it cannot be read. The same tree gives the same."""
    try:
        with open(path, "rb") as content:
            return hashlib.file_digest(content, "blake2b").hexdigest()[:32]
    except OSError:
        return ""


@contextmanager
def _opened(path: Path, identity: str) -> Iterator[tuple[Any, dict[str, Any]]]:
    """An archive and how it was made; what goes wrong in the body is an `InputError`."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = json.loads(archive["head"].tobytes())
            if found["identity"] != identity:
                raise ValueError("it is the product of another task")
            yield archive, found["made"]
    except Exception as err:  # a damaged archive fails in any way
        cure = "zonda resume looks for such files and makes them anew"
        raise InputError(
            f"cannot be used: {str(err) or type(err).__name__}",
            place=str(path),
            cure=cure,
        ) from None
