"""Which program this is, down to its files: what was remembered by another one does not hold."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec

from .discovery import HOST


@cache
def fingerprint() -> str:
    """Hash of the names, times and sizes of zonda's own files."""
    digest = hashlib.blake2b(digest_size=16)
    for folder in folders():
        for path, stat in sorted(_files(folder)):
            digest.update(f"{path} {stat.st_mtime_ns} {stat.st_size}\n".encode())
    return digest.hexdigest()


def folders() -> Iterator[str]:
    """Where zonda's own modules are."""
    for package in ("core", "operators", "plugins"):
        spec = find_spec(f"{HOST}.{package}")
        yield from spec.submodule_search_locations or () if spec else ()


def _files(folder: str) -> Iterator[tuple[str, os.stat_result]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                if entry.name != "__pycache__":
                    yield from _files(entry.path)
            elif not entry.name.startswith("."):
                yield entry.path, entry.stat()
