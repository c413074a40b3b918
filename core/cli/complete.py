"""Completions of the shell: names, found without importing the components."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import click


def pipelines(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[Any]:
    """Shipped pipelines, and YAML files and folders on disk."""
    from click.shell_completion import CompletionItem

    from ..configuration.locate import shipped

    folder, _, begin = incomplete.rpartition("/")
    names = [name for name in shipped() if name.startswith(incomplete)]
    try:
        beside = sorted(
            p
            for p in Path(folder or ("/" if incomplete.startswith("/") else ".")).iterdir()
            if p.name.startswith(begin)
        )
    except OSError:
        beside = []
    before = incomplete[: len(incomplete) - len(begin)]
    for path in beside:
        if path.name.startswith(".") and not begin.startswith("."):
            continue
        if path.is_dir() or path.suffix in (".yaml", ".yml"):
            names.append(before + path.name + ("/" if path.is_dir() else ""))
    return [CompletionItem(name) for name in names]


def instruments(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[Any]:
    """Registered instruments."""
    from ..registry import instruments

    return _beginning(instruments, incomplete)


def sites(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[Any]:
    """Registered sites."""
    from ..registry import sites

    return _beginning(sites, incomplete)


def _beginning(names: Iterable[str], incomplete: str) -> list[Any]:
    from click.shell_completion import CompletionItem

    return [CompletionItem(name) for name in names if name.startswith(incomplete)]
