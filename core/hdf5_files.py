"""HDF5 files from elsewhere: opened for reading, whole in themselves, and no larger in memory than what they can hold."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

from .errors import InputError
from .files import check_memory, reading

COMPRESSION_MAX = 1100
"""Bytes in memory per byte of the file: deflate, the densest filter in use, reaches 1032."""


@contextlib.contextmanager
def opened(path: str | os.PathLike[str], place: str, kind: str, cure: str) -> Iterator[Any]:
    """An `h5py.File` to read from; whatever goes wrong in the body is an `InputError` about ``place``.

    External links, data kept in other files and virtual data sets are refused: a file must not make zonda open others.
    """
    import h5py

    with reading(place, kind, cure), h5py.File(path, "r") as file:
        _refuse_other_files(file, place)
        yield file


def check_size(dataset: Any, place: str) -> None:
    """Refuse a data set that claims more than its file can hold, or than memory is free, before it is read (`InputError`)."""
    size = int(dataset.size or 0) * int(dataset.dtype.itemsize)
    if size > COMPRESSION_MAX * os.path.getsize(dataset.file.filename):
        raise InputError(
            f"{dataset.name} claims {size / 1e9:.3g} GB, more than a file of this size can hold",
            place=place,
            cure="the file is corrupt or was never filled: copy or make it again",
        )
    check_memory(size, str(dataset.name), place)


def _refuse_other_files(file: Any, place: str) -> None:
    import h5py

    seen: set[Any] = set()
    groups = [file]
    while groups:
        group = groups.pop()
        for name in group:
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise _leaves(f"{group.name}/{name} lies in another file, {link.filename!r}", place)
            if isinstance(link, h5py.SoftLink):
                continue  # leads elsewhere in this file, which is visited anyway
            item = group[name]
            info = h5py.h5o.get_info(item.id)
            if (info.fileno, info.addr) in seen:
                continue
            seen.add((info.fileno, info.addr))
            if isinstance(item, h5py.Group):
                groups.append(item)
            elif isinstance(item, h5py.Dataset) and (item.external or item.is_virtual):
                raise _leaves(f"the values of {item.name} lie in another file", place)


def _leaves(message: str, place: str) -> InputError:
    return InputError(message, place=place, cure="give a file that holds everything itself, e.g. made by h5repack")
