"""Paths of pipeline files, given by path or by the name of a shipped pipeline. Imports nothing
heavy.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import zonda.pipelines

from ..errors import InputError

MAXIMUM_BYTES = 10_000_000
"""Larger files are not pipeline files."""


def shipped() -> dict[str, Path]:
    """The shipped pipelines by name."""
    return {
        path.stem: path for path in sorted(Path(zonda.pipelines.__file__).parent.glob("*.yaml"))
    }


def folders() -> dict[str, Path]:
    """Shipped pipelines in folders, which are not listed: ``validation/mustang2_as_coded``."""
    every = sorted(Path(zonda.pipelines.__file__).parent.glob("*/*.yaml"))
    found = [path for path in every if "operators:" in path.read_text("utf-8").splitlines()]
    return {f"{path.parent.name}/{path.stem}": path for path in found}


def locate(path_or_name: str | Path) -> Path:
    """The file that a path, or a shipped pipeline's name, stands for. Raises InputError where there
    is none.
    """
    if not isinstance(path_or_name, str | Path):
        raise InputError(
            "is not a path",
            place=f"{path_or_name!r:.60}",
            cure=f"give the path of a YAML file; {SHIPPED}",
        )
    path = Path(path_or_name)
    name = str(path_or_name)
    with suppress(RuntimeError):  # nobody of that name: take ~ as it stands
        path = path.expanduser()
    if not path.is_file():
        from ..registry import fold

        for known, file in (shipped() | folders()).items():
            if name == known or fold(name) == fold(known):
                return file
    if path.is_dir():
        inside = sorted(p.name for p in path.glob("*.y*ml"))
        cure = (
            f"name a file in it, e.g. {path / inside[0]}"
            if inside
            else "give the path of a YAML file"
        )
        raise InputError("is a folder, not a pipeline file", place=name, cure=cure)
    if not path.exists():
        beside = (
            [str(path.parent / p.name) for p in path.parent.glob("*.y*ml")]
            if path.parent.is_dir()
            else []
        )
        from .diagnostics import nearest

        cure = (
            nearest(name, [*shipped(), *folders(), *beside])
            or f"give the path of a YAML file or one of: {', '.join(shipped())}"
        )
        raise InputError("no such pipeline file or shipped pipeline", place=name, cure=cure)
    return path


def read(path: Path) -> str:
    """The text of a pipeline file. Raises InputError where it cannot be read or is not UTF-8."""
    try:
        with path.open("rb") as file:
            content = file.read(MAXIMUM_BYTES + 1)
    except OSError as err:
        raise InputError(
            f"cannot be read: {err.strerror}",
            place=str(path),
            cure="check its permissions",
        ) from None
    if len(content) > MAXIMUM_BYTES:
        raise InputError(
            "is too large for a pipeline file",
            place=str(path),
            cure="give the path of a YAML file",
        )
    _check_kind(path, content)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as err:
        line = content.count(b"\n", 0, err.start) + 1
        column = err.start - (content.rfind(b"\n", 0, err.start) + 1) + 1
        message = f"is not UTF-8 text (byte 0x{content[err.start]:02x})"
        raise InputError(
            message,
            place=f"{path}:{line}:{column}",
            cure="save it as UTF-8",
        ) from None


SHIPPED = "`zonda pipelines` lists those that have names"
_DATA = (b"SIMPLE  =", b"\x89HDF", b"\x1f\x8b", b"\xff\xfe", b"\xfe\xff")
"""First bytes of data files, compressed files and UTF-16 text."""


def _check_kind(path: Path, content: bytes) -> None:
    """Raise InputError for a file that is not YAML text."""
    if content.startswith(_DATA) or b"\0" in content:
        raise InputError(
            "is a binary or data file, not a pipeline file",
            place=str(path),
            cure="give the path of a YAML file in UTF-8; data are named in a pipeline, e.g."
            f" - {_reader('sky')}: {{file: {path.name}}}",
        )
    if path.suffix == ".py":
        raise InputError(
            "is a Python script, not a pipeline file",
            place=str(path),
            cure=f"run it: python {path}",
        )


def _reader(what: str) -> str:
    """Name of the first step that reads ``what`` from a file."""
    from ..registry import makers, operators

    names = [name for name in makers(what) if "file" in operators.get(name).model_fields]
    return next(iter(names), f"a step that provides {what}")
