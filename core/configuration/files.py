"""Paths of input files in operator parameters."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationInfo
from pydantic_core import PydanticCustomError


def find(value: Any, info: ValidationInfo) -> Path:
    """The absolute path of an existing file. Raises PydanticCustomError with the folders tried."""
    if not isinstance(value, str | Path) or not str(value).strip():
        raise PydanticCustomError("path_type", "expected the path of a file, got {value}", {"value": repr(value)[:60]})
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
            message = "'{path}' is not a file" + (" but a folder" if candidate.is_dir() else "")
            raise PydanticCustomError("path_kind", message, {"path": str(value), "help": f"it is {candidate}"})
    where = " and ".join(str(p.parent) for p in tried)
    near = _similar(tried)
    context = {"path": str(value), "where": where, "label": near}
    raise PydanticCustomError("path_missing", "no such file: '{path}', looked in {where}", context)


def _similar(tried: list[Path]) -> str:
    from .diagnostics import nearest

    for path in tried:
        if path.parent.is_dir():
            hint = nearest(path.name, (p.name for p in path.parent.iterdir() if p.is_file()))
            if hint:
                return hint
    return ""


InputPath = Annotated[Path, BeforeValidator(find)]
"""A file to read. A relative path is looked for beside the pipeline file, then in the working directory; it becomes absolute."""
