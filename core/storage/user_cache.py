"""What a run may know from earlier ones: small JSON files in the user's cache folder, worth nothing
if they are lost.

``$ZONDA_CACHE_DIR``, else ``zonda`` in the system's cache folder of the user. Where nothing can be
written, nothing is remembered.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from .files import put

RESTRAINTS = (
    "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES",
    "NPY_DISABLE_CPU_FEATURES",
    "OPENBLAS_CORETYPE",
    "GLIBC_TUNABLES",
)
"""Variables with which other instructions are chosen than the processor's own."""

MOST = 64
"""Entries of one kind that are kept; the oldest go first."""


def folder() -> Path:
    """The folder, which need not exist."""
    if given := os.environ.get("ZONDA_CACHE_DIR"):
        return Path(given).expanduser()
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "zonda" / "cache"
    if sys.platform == "darwin":
        return Path("~/Library/Caches/zonda").expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "zonda"


def recall(kind: str, key: Any) -> Any:
    """What was remembered under ``key`` (JSON values), or None; a damaged or foreign file counts as
    none.
    """
    text = _text(key)
    with suppress(OSError, ValueError, RecursionError):  # no home, no file, no JSON
        entry = json.loads(_path(kind, text).read_text(encoding="utf-8"))
        if (
            isinstance(entry, dict)
            and entry.get("key") == text
            and entry.get("check") == _hash(text + _text(entry.get("value")))
        ):
            return entry["value"]
    return None


def remember(kind: str, key: Any, value: Any) -> None:
    """Keep ``value`` (JSON values) under ``key``, whole or not at all; a value that JSON would
    change is not kept.
    """
    text = _text(key)
    with suppress(OSError, ValueError, TypeError, RuntimeError):
        body = json.dumps(
            {"key": text, "value": value, "check": _hash(text + json.dumps(value, sort_keys=True))}
        )
        if json.loads(body)["value"] != value:
            return
        path = _path(kind, text)
        put(path, body.encode())
        for old in sorted(path.parent.glob(f"{kind}-*.json"), key=lambda p: p.stat().st_mtime)[
            :-MOST
        ]:
            old.unlink(missing_ok=True)


@cache
def processor() -> str:
    """This machine's processor, as the system calls it, and what the environment forbids it."""
    return " ".join(
        [_name(), *(f"{name}={os.environ[name]}" for name in RESTRAINTS if os.environ.get(name))]
    )


def _name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return f"{platform.machine()} {line.partition(':')[2].strip()}"
    return f"{platform.machine()} {platform.processor()}"


def _text(key: Any) -> str:
    return json.dumps(key, sort_keys=True, default=str)


def _path(kind: str, text: str) -> Path:
    return folder() / f"{kind}-{_hash(text)}.json"


def _hash(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=12).hexdigest()
