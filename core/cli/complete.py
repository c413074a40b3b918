"""``zonda completion``, and the names that a shell completes, without importing components."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem, get_completion_class

VARIABLE = "_ZONDA_COMPLETE"
"""Environment variable with which the script asks for completions; `click.Command.main` answers."""
HOW = {
    "bash": '# add to ~/.bashrc:  eval "$(zonda completion bash)"',
    "zsh": '# add to ~/.zshrc:  eval "$(zonda completion zsh)"',
    "fish": "# put into a file:  zonda completion fish > ~/.config/fish/completions/zonda.fish",
}


@click.command()
@click.argument("shell", type=click.Choice(list(HOW)))
@click.pass_context
def completion(context: click.Context, shell: str) -> None:
    """Print the script that makes Tab complete commands, options, pipelines, instruments and sites.

    For bash: eval "$(zonda completion bash)", in ~/.bashrc for good; zsh likewise, in ~/.zshrc; for
    fish write the script to ~/.config/fish/completions/zonda.fish.
    """
    kind = get_completion_class(shell)
    assert kind is not None  # click knows these three
    root = context.find_root()
    made = kind(root.command, {}, "zonda", VARIABLE)
    click.echo(HOW[shell])
    click.echo((made.source_template % made.source_vars()).strip())


def pipelines(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[Any]:
    """Shipped pipelines, and YAML files and folders on disk."""
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
    return [CompletionItem(name) for name in names if name.startswith(incomplete)]
