"""Where compiled code is kept and how many threads BLAS takes, before numpy and numba are
imported.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import warnings
from pathlib import Path


def ensure_cache() -> None:
    """Name a temporary folder for compiled code where there is no lasting one; call it before numba
    is imported.

    numba keeps compiled code beside the source, else in the user's cache folder, and refuses to
    compile where it may write to neither (a read-only container without a home). The folder is this
    process's own and goes with it, because loading compiled code from a folder that others may
    write to would run theirs.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if any(
        _writable(folder)
        for folder in (Path(__file__).resolve().parent / "__pycache__", Path(caches) / "numba")
    ):
        return
    folder = tempfile.mkdtemp(prefix="zonda-compiled-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder
    warnings.warn(
        "compiled code cannot be kept for the next run; set NUMBA_CACHE_DIR to a folder that lasts",
        stacklevel=2,
    )


def cache_folder() -> str:
    """Where compiled code is kept, as far as the environment says; empty: beside the source, or in
    the user's cache folder.
    """
    return os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or ""


def one_blas_thread() -> None:
    """Let BLAS work on one thread, unless the user says otherwise; call it before numpy is
    imported.

    zonda's own threads fill the machine. BLAS threads beside them wait for each other, and sums may
    depend on their number.
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def _writable(folder: Path) -> bool:
    """Whether a file can be made in ``folder``, which is made too where it is missing: found out as
    numba does, by trying.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True
