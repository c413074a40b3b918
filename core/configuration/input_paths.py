"""Paths of input files in operator parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from glob import escape, glob
from pathlib import Path
from typing import Annotated, Any, Protocol, Self, runtime_checkable

from pydantic import BaseModel, BeforeValidator, ValidationInfo

from .diagnostics import mistake, nearest

MOST_NAMED = 4
"""Files of a folder that a message names."""


def find(value: Any, info: ValidationInfo) -> Path:
    """The absolute path of an existing file, beside the pipeline file or in the working directory.

    Raises PydanticCustomError, which names the folders tried.
    """
    return find_in((info.context or {}).get("folder"), value)


def find_in(folder: str | Path | None, value: Any) -> Path:
    """Find a file beside ``folder``; see `find`."""
    if not isinstance(value, str | Path) or not str(value).strip():
        raise mistake(f"expected the path of a file, got {value!r:.60}")
    path = Path(value)
    with suppress(RuntimeError):  # nobody of that name: take ~ as it stands
        path = path.expanduser()
    folders = list(dict.fromkeys(Path(f).resolve() for f in (folder, Path.cwd()) if f is not None))
    tried = [path] if path.is_absolute() else [f / path for f in folders]
    for candidate in tried:
        if candidate.is_file():
            return candidate.resolve()
    for candidate in tried:
        if candidate.exists():
            message = f"'{value}' is not a file" + (" but a folder" if candidate.is_dir() else "")
            inside = _names(Path(escape(str(path)), "*"), folders) if candidate.is_dir() else ""
            raise mistake(
                message,
                help=f"it is {candidate}" + (f"; name a file in it: {inside}" if inside else ""),
            )
    found = _names(path, folders)
    if found or {"*", "?"} & set(str(value)):
        stands_for = (
            f"write the names that it stands for: {found}"
            if found
            else "write the names of files; it stands for none"
        )
        raise mistake(f"'{value}' is a pattern, not the path of a file", help=stands_for)
    where = " and ".join(str(p.parent) for p in tried)
    beside = ((path.name, path.parent.iterdir()) for path in tried if path.parent.is_dir())
    hints = (nearest(name, (p.name for p in others if p.is_file())) for name, others in beside)
    raise mistake(f"no such file: '{value}', looked in {where}", next(filter(None, hints), ""))


def _names(pattern: Path, folders: list[Path]) -> str:
    """The first files that match in one of the folders, and how many more there are; empty:
    none.
    """
    for folder in folders:
        names = sorted(
            name for name in glob(str(pattern), root_dir=folder) if (folder / name).is_file()
        )
        if names:
            more = [f"and {len(names) - MOST_NAMED} more"] if len(names) > MOST_NAMED else []
            return ", ".join([*names[:MOST_NAMED], *more])
    return ""


def paths_in(value: Any) -> Iterator[Path]:
    """Every path among parameters."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from paths_in(getattr(value, name))
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from paths_in(item)
    elif isinstance(value, list | tuple | set | frozenset):
        for item in value:
            yield from paths_in(item)


@runtime_checkable
class InMemory(Protocol):
    """A step that may hold arrays in place of a file that a pipeline file names."""

    def in_files(self, path: Path) -> Self:
        """A copy of the step that reads its arrays from a FITS file, written at ``path`` to the
        same bits; the step itself if it has none.
        """
        ...


InputPath = Annotated[Path, BeforeValidator(find)]
"""A file to read. A relative path is looked for beside the pipeline file, then in the working
directory; it becomes absolute.
"""
