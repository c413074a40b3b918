"""What a number may depend on besides the pipeline: versions."""

from __future__ import annotations

from functools import cache


def versions() -> dict[str, str]:
    """Versions of everything that can change a number."""
    import platform

    found = {"python": platform.python_version(), "machine": platform.machine()}
    for package in ("zonda", "numpy", "scipy", "astropy", "astropy-iers-data", "numba", "healpy", "h5py"):
        installed = _version(package)
        if installed is not None:
            found[package] = installed
    return found


@cache
def _version(package: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None
