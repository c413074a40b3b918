"""Installed packages: the versions on which results depend besides the pipeline, and packages that
come with an extra.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from .discovery import HOST
from .errors import InputError


def needed(module: str, extra: str, place: str = "") -> Any:
    """A module of a package that the extra ``extra`` installs. Raises InputError at ``place`` where
    it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as err:
        cure = f"pip install 'zonda[{extra}]'"
        raise InputError(
            f"cannot import {module}: {err}",
            place=place or f"zonda.interop.{extra}",
            cure=cure,
        ) from None


def versions() -> dict[str, str]:
    """Versions of everything that can change a number."""
    import platform

    found = {"python": platform.python_version(), "machine": platform.machine()}
    for package in (
        "zonda",
        "numpy",
        "scipy",
        "astropy",
        "astropy-iers-data",
        "pyerfa",
        "numba",
        "llvmlite",
        "healpy",
        "h5py",
    ):
        installed = _version(package)
        if installed is not None:
            found[package] = installed
    return found


def arithmetic() -> dict[str, str]:
    """Everything on which bits depend besides the pipeline: libraries, the C library's functions,
    and the instructions that each may use.

    ``cpu`` and ``instructions`` are those that numba compiles for, ``numpy instructions`` those
    that numpy chooses among; ``processor`` is its name. Where all of it is the same, bits are.
    """
    import platform

    from llvmlite import binding
    from numba.core import config

    from .machine import processor

    features = config.CPU_FEATURES
    if features is None:
        with suppress(RuntimeError):  # unknown to LLVM
            features = binding.get_host_cpu_features().flatten()
    return {
        **versions(),
        "processor": processor(),
        "cpu": config.CPU_NAME or binding.get_host_cpu_name(),
        "instructions": " ".join(
            sorted(f[1:] for f in (features or "").split(",") if f.startswith("+"))
        ),
        "numpy instructions": " ".join(_of_numpy()),
        "libc": " ".join(filter(None, platform.libc_ver())),
        **{
            name: os.environ[name]
            for name in ("GLIBC_TUNABLES", "OPENBLAS_CORETYPE")
            if os.environ.get(name)
        },
    }


def _of_numpy() -> list[str]:
    with suppress(ImportError, AttributeError):
        from numpy._core import _multiarray_umath as inside  # type: ignore[attr-defined]

        return [name for name in inside.__cpu_dispatch__ if inside.__cpu_features__.get(name)]
    return []


@cache
def _version(package: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None


@cache
def fingerprint() -> str:
    """Hash of the names, times and sizes of zonda's own files."""
    digest = hashlib.blake2b(digest_size=16)
    for folder in folders():
        for path, stat in sorted(_files(folder)):
            digest.update(f"{path} {stat.st_mtime_ns} {stat.st_size}\n".encode())
    return digest.hexdigest()


def folders() -> Iterator[str]:
    """Folders of zonda's own modules."""
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
