"""Paths of input files in operator parameters."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationInfo

from .diagnostics import nearest
from .values import mistake


def find(value: Any, info: ValidationInfo) -> Path:
    """The absolute path of an existing file. Raises what names the folders tried."""
    if not isinstance(value, str | Path) or not str(value).strip():
        raise mistake(f"expected the path of a file, got {value!r:.60}")
    path = Path(value)
    with suppress(RuntimeError):  # nobody of that name: take ~ as it stands
        path = path.expanduser()
    folder = (info.context or {}).get("folder")
    folders = list(dict.fromkeys(Path(f).resolve() for f in (folder, Path.cwd()) if f is not None))
    tried = [path] if path.is_absolute() else [f / path for f in folders]
    for candidate in tried:
        if candidate.is_file():
            return candidate.resolve()
    for candidate in tried:
        if candidate.exists():
            message = f"'{value}' is not a file" + (" but a folder" if candidate.is_dir() else "")
            raise mistake(message, help=f"it is {candidate}")
    where = " and ".join(str(p.parent) for p in tried)
    raise mistake(f"no such file: '{value}', looked in {where}", _similar(tried))


def _similar(tried: list[Path]) -> str:
    for path in tried:
        if path.parent.is_dir():
            hint = nearest(path.name, (p.name for p in path.parent.iterdir() if p.is_file()))
            if hint:
                return hint
    return ""


InputPath = Annotated[Path, BeforeValidator(find)]
"""A file to read. A relative path is looked for beside the pipeline file, then in the working directory; it becomes absolute."""
