"""Where pipeline files are: a path, or the name of a shipped pipeline. Imports nothing heavy."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import zonda.pipelines

from ..errors import InputError

MAXIMUM_BYTES = 10_000_000
"""Larger files are not pipeline files."""


def shipped() -> dict[str, Path]:
    """The shipped pipelines by name."""
    return {path.stem: path for path in sorted(Path(zonda.pipelines.__file__).parent.glob("*.yaml"))}


def locate(path_or_name: str | Path) -> Path:
    """The file that a path, or a shipped pipeline's name, stands for. Raises InputError where there is none."""
    path, name = Path(path_or_name), str(path_or_name)
    with suppress(RuntimeError):  # nobody of that name: take ~ as it stands
        path = path.expanduser()
    if not path.is_file() and name in shipped():
        return shipped()[name]
    if path.is_dir():
        inside = sorted(p.name for p in path.glob("*.y*ml"))
        cure = f"name a file in it, e.g. {path / inside[0]}" if inside else "give the path of a YAML file"
        raise InputError("is a folder, not a pipeline file", place=name, cure=cure)
    if not path.exists():
        beside = [str(path.parent / p.name) for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []
        from .diagnostics import nearest

        cure = nearest(name, [*shipped(), *beside]) or f"give the path of a YAML file or one of: {', '.join(shipped())}"
        raise InputError("no such pipeline file or shipped pipeline", place=name, cure=cure)
    return path


def read(path: Path) -> str:
    """The text of a pipeline file. Raises InputError where it cannot be read or is not UTF-8."""
    try:
        with path.open("rb") as file:
            content = file.read(MAXIMUM_BYTES + 1)
    except OSError as err:
        raise InputError(f"cannot be read: {err.strerror}", place=str(path), cure="check its permissions") from None
    if len(content) > MAXIMUM_BYTES:
        raise InputError("is too large for a pipeline file", place=str(path), cure="give the path of a YAML file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as err:
        line = content.count(b"\n", 0, err.start) + 1
        column = err.start - (content.rfind(b"\n", 0, err.start) + 1) + 1
        message = f"is not UTF-8 text (byte 0x{content[err.start]:02x})"
        raise InputError(message, place=f"{path}:{line}:{column}", cure="save it as UTF-8") from None
