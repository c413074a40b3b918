"""Partial products, layouts and records as files: plain values and arrays in a zip archive, whose
own checksums tell a damaged one. No pickles.

A file holds ``head.json`` (its identity, and how it was made), ``values.json``, a tree of mappings,
lists and plain values in which ``{"array": k}`` stands for the k-th array, and ``0.npy``, ``1.npy``
...
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..storage.files import atomic_path

HEAD, VALUES = "head.json", "values.json"


def write(
    path: Path, identity: str, tree: Mapping[str, Any], made: Mapping[str, Any] | None = None
) -> None:
    """Write a tree atomically. ``identity``: of what it is the product, checked by `read`;
    ``made``: how it was made, for `head`.

    Raises `OutputError` where it cannot be written, TypeError for a value that is neither plain nor
    an array.
    """
    arrays: list[Any] = []
    text = json.dumps(_flatten(tree, arrays), allow_nan=True)
    content = [_npy(array) for array in arrays]
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive,
    ):
        _put(archive, HEAD, json.dumps({"identity": identity, "made": dict(made or {})}))
        _put(archive, VALUES, text)
        for k, data in enumerate(content):
            _put(archive, f"{k}.npy", data)


def read(path: Path, identity: str) -> dict[str, Any]:
    """The tree in a file that `write` made. Raises `InputError` where it is damaged or the product
    of another identity.
    """
    with _opened(path, identity) as (archive, _):
        content = [archive.read(f"{k}.npy") for k in range(len(archive.namelist()) - 2)]
        arrays = [np.load(io.BytesIO(data), allow_pickle=False) for data in content]
        tree: dict[str, Any] = _restore(json.loads(archive.read(VALUES)), arrays)
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
def _opened(path: Path, identity: str) -> Iterator[tuple[zipfile.ZipFile, dict[str, Any]]]:
    """An archive and how it was made; what goes wrong in the body is an `InputError`."""
    try:
        with zipfile.ZipFile(path) as archive:
            found = json.loads(archive.read(HEAD))
            if found["identity"] != identity:
                raise ValueError("it is the product of another task")
            yield archive, found["made"]
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        EOFError,
        IndexError,
        zipfile.BadZipFile,
        zlib.error,
        RuntimeError,
    ) as err:
        cure = "zonda resume looks for such files and makes them anew"
        raise InputError(
            f"cannot be used: {str(err) or type(err).__name__}", place=str(path), cure=cure
        ) from None


def _put(archive: zipfile.ZipFile, name: str, data: str | bytes) -> None:
    archive.writestr(
        zipfile.ZipInfo(name), data
    )  # without the time of day: the same product is the same bytes


def _npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)
    return stream.getvalue()


def _flatten(value: Any, arrays: list[Any]) -> Any:
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {"array": len(arrays) - 1}
    if isinstance(value, Mapping):
        if "array" in value or not all(isinstance(k, str) for k in value):
            raise TypeError("the keys of a partial product are texts other than 'array'")
        return {k: _flatten(v, arrays) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_flatten(v, arrays) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"a partial product holds plain values and arrays, not {type(value).__name__}")


def _restore(value: Any, arrays: list[Any]) -> Any:
    if isinstance(value, dict):
        return (
            arrays[value["array"]]
            if set(value) == {"array"}
            else {k: _restore(v, arrays) for k, v in value.items()}
        )
    return [_restore(v, arrays) for v in value] if isinstance(value, list) else value
