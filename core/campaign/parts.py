"""Partial products and layouts as files: plain values and arrays in a zip archive that knows its
own checksum. No pickles.

A file holds ``values.json``, a tree of mappings, lists and plain values in which ``{"array": k}``
stands for the k-th array, and ``0.npy``, ``1.npy`` ... The first line of the tree is a BLAKE2b
digest of everything else: a file that was cut short, changed or taken for another one is refused.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..storage.files import atomic_path

VALUES = "values.json"


def write(path: Path, identity: str, tree: Mapping[str, Any]) -> str:
    """Write a tree atomically; its digest. ``identity``: of what it is the product, checked by
    `read`.

    Raises `OutputError` where it cannot be written, TypeError for a value that is neither plain nor
    an array.
    """
    arrays: list[Any] = []
    text = json.dumps(_flatten(tree, arrays), allow_nan=True)
    content = [_npy(array) for array in arrays]
    digest = _digest(identity, text, content)
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive,
    ):
        _put(archive, VALUES, json.dumps({"identity": identity, "digest": digest}) + "\n" + text)
        for k, data in enumerate(content):
            _put(archive, f"{k}.npy", data)
    return digest


def read(path: Path, identity: str, digest: str | None = None) -> dict[str, Any]:
    """The tree in a file that `write` made. Raises `InputError` where it is damaged, another's, or
    not the one meant.
    """
    return _opened(path, identity, digest)[0]


def digest_of(path: Path, identity: str) -> str | None:
    """The digest of a file that is whole and the product of ``identity``; None of any other."""
    try:
        return _opened(path, identity, None)[1]
    except InputError:
        return None


def _opened(path: Path, identity: str, digest: str | None) -> tuple[dict[str, Any], str]:
    try:
        with zipfile.ZipFile(path) as archive:
            head, _, text = archive.read(VALUES).decode().partition("\n")
            given = json.loads(head)
            content = [archive.read(f"{k}.npy") for k in range(len(archive.namelist()) - 1)]
        found = _digest(given["identity"], text, content)
        if found != given["digest"]:
            raise ValueError("its checksum is wrong")
        if given["identity"] != identity or digest not in (None, found):
            raise ValueError("it is the product of another task")
        tree = _restore(
            json.loads(text), [np.load(io.BytesIO(data), allow_pickle=False) for data in content]
        )
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
    assert isinstance(tree, dict)
    return tree, found


def _put(archive: zipfile.ZipFile, name: str, data: str | bytes) -> None:
    archive.writestr(
        zipfile.ZipInfo(name), data
    )  # without the time of day: the same product is the same bytes


def _npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)
    return stream.getvalue()


def _digest(identity: str, text: str, content: list[bytes]) -> str:
    found = hashlib.blake2b(digest_size=16)
    for part in (identity.encode(), text.encode(), *content):
        found.update(len(part).to_bytes(8, "little") + part)
    return found.hexdigest()


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
