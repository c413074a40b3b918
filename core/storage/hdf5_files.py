"""HDF5 files from elsewhere: opened for reading, whole in themselves, and no larger in memory than
what they can hold.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from typing import Any

from ..errors import InputError
from .files import AnyPath, check_kind, check_memory, reading

COMPRESSION_MAX = 1100
"""Bytes in memory per byte of the file: deflate, the densest filter in use, reaches 1032."""


@contextlib.contextmanager
def opened(path: AnyPath, place: str, kind: str, cure: str) -> Iterator[Any]:
    """An `h5py.File` to read from; whatever goes wrong in the body is an `InputError` about
    ``place``.

    External links, data kept in other files and virtual data sets are refused: a file must not make
    zonda open others.
    """
    with reading(place, kind, cure), checked(path, place) as file:
        yield file


def checked(path: AnyPath, place: str) -> Any:
    """An `h5py.File` that the caller closes; it refuses what `opened` refuses.

    Other errors are those of h5py.
    """
    import h5py

    check_kind(path)
    file = h5py.File(path, "r")
    try:
        _refuse_other_files(file, place)
    except BaseException:
        file.close()
        raise
    return file


def check_size(dataset: Any, place: str, *, whole: bool = True) -> None:
    """Refuse a data set that claims more than its file can hold before it is read, or, read
    ``whole``, than memory is free (`InputError`)."""
    size = int(dataset.size or 0) * int(dataset.dtype.itemsize)
    if size > COMPRESSION_MAX * os.path.getsize(dataset.file.filename):
        raise InputError(
            f"{dataset.name} claims {size / 1e9:.3g} GB, more than a file of this size can hold",
            place=place,
            cure="the file is corrupt or was never filled: copy or make it again",
        )
    _check_chunks(dataset, place)
    if whole:
        check_memory(size, str(dataset.name), place)


def read_columns(group: Any, name: str, place: str) -> Any:
    """A table that astropy wrote into a group (`write_table_hdf5`), as a QTable.

    Raises InputError for one that is larger than its file can hold, or whose header unfolds to more
    values than any needs.
    """
    from astropy.io.misc.hdf5 import read_table_hdf5
    from astropy.table import QTable

    from .table_files import check_header

    if name not in group:
        raise KeyError(f"there is no table {group.name.rstrip('/')}/{name}")
    header = group.get(f"{name}.__table_column_meta__")
    for item in (group[name], header):
        if item is not None:
            check_size(item, place)
    if header is not None:
        check_header(b"\n".join(header[:]).decode())
    return QTable(read_table_hdf5(group, path=name, character_as_bytes=False))


def _check_chunks(dataset: Any, place: str) -> None:
    """Refuse chunks that unpack to more than they hold: libhdf5 unpacks whatever is stored, before
    it looks at the size.
    """
    import h5py

    plist = dataset.id.get_create_plist()
    filters = [plist.get_filter(k)[0] for k in range(plist.get_nfilters())]
    if not dataset.chunks or not filters:
        return
    harm = "the file is corrupt or made to harm: make it again, e.g. with h5repack -f GZIP=4"
    if filters.count(h5py.h5z.FILTER_DEFLATE) > 1:
        raise InputError(f"{dataset.name} is deflated twice over", place=place, cure=harm)
    size = math.prod(dataset.chunks) * int(dataset.dtype.itemsize)
    most = (
        size + size // 16 + 4096
    )  # what cannot be compressed grows: deflate by less than 0.1 %, others by less than 1/16

    def larger(chunk: Any) -> int | None:
        return int(chunk.size) if chunk.size > most else None

    if found := dataset.id.chunk_iter(larger):
        message = (
            f"a chunk of {dataset.name} is stored in {found} bytes, more than the {size} that it"
            " holds unpacked"
        )
        raise InputError(message, place=place, cure=harm)


class Disk:
    """A file for h5py to write to. libhdf5 crashes when it closes a file that it could not write:
    it is never told of a failure.

    Raises OSError at the next `check` or `close`; whatever is written after a failure is dropped.
    """

    def __init__(self, path: AnyPath) -> None:
        self._file = open(path, "w+b", buffering=0)  # noqa: SIM115
        self._error: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, data: Any) -> int:
        """Write all of it where the last `seek` led."""
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while self._error is None and len(rest):
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self._error = error
        return size

    def readinto(self, buffer: Any) -> int:
        """Read what was written; zeros beyond the end."""
        view = memoryview(buffer).cast("B")
        have = 0
        while have < len(view) and (more := self._file.readinto(view[have:])):
            have += more
        view[have:] = bytes(len(view) - have)
        return len(view)

    def truncate(self, size: int) -> int:
        """Cut the file, or make it longer."""
        try:
            self._file.truncate(size)
        except OSError as error:
            self._error = self._error or error
        return size

    def check(self) -> None:
        """Raise the first failure."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Close the file, then raise the first failure."""
        if not self._file.closed:
            self._file.close()
            self.check()


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
    return InputError(
        message,
        place=place,
        cure="give a file that holds everything itself, e.g. made by h5repack",
    )
