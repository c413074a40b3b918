"""Paths of input files in operator parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Protocol, Self, runtime_checkable

from pydantic import BaseModel, BeforeValidator, ValidationInfo

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
    beside = ((path.name, path.parent.iterdir()) for path in tried if path.parent.is_dir())
    hints = (nearest(name, (p.name for p in others if p.is_file())) for name, others in beside)
    raise mistake(f"no such file: '{value}', looked in {where}", next(filter(None, hints), ""))


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
        """The step with its arrays in a FITS file at ``path``, to the same bits; itself where it holds none."""
        ...


InputPath = Annotated[Path, BeforeValidator(find)]
"""A file to read. A relative path is looked for beside the pipeline file, then in the working directory; it becomes absolute."""
