"""Lists of components (``zonda plugins``, ``pipelines``, ``schema``), and ``zonda completion``: the
names that a shell completes, without importing components.
"""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem, get_completion_class

from ..errors import ZondaError

VARIABLE = "_ZONDA_COMPLETE"
"""Environment variable with which the script asks for completions; `click.Command.main` answers."""
HOW = {
    "bash": '# add to ~/.bashrc:  eval "$(zonda completion bash)"',
    "zsh": '# add to ~/.zshrc:  eval "$(zonda completion zsh)"',
    "fish": "# put into a file:  zonda completion fish > ~/.config/fish/completions/zonda.fish",
}


@click.command()
@click.option("--check", is_flag=True, help="Import each one; exit status 1 where one fails.")
def plugins(check: bool) -> None:
    """List operators, instruments, sites and other components.

    These are operators, instruments, sites, bands, noise models, weather sources, spectra, checks,
    metrics and hooks, each with the distribution and the module that it comes from.
    """
    from .. import hooks
    from ..discovery import discover
    from ..registry import registries
    from ..tables import aligned

    rows: list[tuple[str, ...]] = []
    failures: list[Exception] = []
    for registry in registries:
        candidates = registry.candidates()
        for found in candidates:
            twice = sum(other.name == found.name for other in candidates) > 1
            note = "provided twice" if twice else ""
            if check:
                try:
                    registry.load(found) if registry.classes or twice else registry.create(
                        found.name
                    )
                except ZondaError as err:
                    failures.append(err)
                    note = "FAILED"
            rows.append((registry.kind, found.name, found.origin, found.reference, note))
    rows += [
        ("hook", found.name, found.origin, found.reference, "") for found in discover(hooks.GROUP)
    ]
    click.echo("\n".join(aligned(rows)))
    if check:
        failures += _failing_hooks()
        for failure in failures:
            click.echo(f"\n{failure}", err=True)
            if failure.__cause__ is not None:
                click.echo(
                    "".join(traceback.format_exception(failure.__cause__)).rstrip(),
                    err=True,
                )
        click.echo(
            f"\n{len(rows)} components, {len(failures)} fault{'s' if len(failures) != 1 else ''}",
            err=True,
        )
        if failures:
            raise click.exceptions.Exit(1)


def _failing_hooks() -> list[ZondaError]:
    """Warnings about plugins with hooks while they are loaded."""
    from ..hooks import manager

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        manager.cache_clear()
        manager()
    return [ZondaError(str(warning.message)) for warning in caught]


@click.command()
def pipelines() -> None:
    """List the shipped pipelines, to be run by their names."""
    from ..configuration import locate, yaml_places
    from ..tables import aligned

    rows = []
    for name, path in locate.shipped().items():
        value = yaml_places.load(yaml_places.Source(str(path), locate.read(path))).value
        rows.append((name, str(value.get("description", "")) if isinstance(value, dict) else ""))
    click.echo("\n".join(aligned(rows)))


@click.command()
def schema() -> None:
    """Print the JSON schema of pipeline files, for editors."""
    import json

    from ..configuration.schema import json_schema

    click.echo(json.dumps(json_schema(), indent=2))


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


def complete_pipelines(
    context: click.Context, parameter: click.Parameter, incomplete: str
) -> list[Any]:
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


def complete_instruments(
    context: click.Context, parameter: click.Parameter, incomplete: str
) -> list[Any]:
    """Registered instruments."""
    from ..registry import instruments

    return _beginning(instruments, incomplete)


def complete_sites(
    context: click.Context, parameter: click.Parameter, incomplete: str
) -> list[Any]:
    """Registered sites."""
    from ..registry import sites

    return _beginning(sites, incomplete)


def _beginning(names: Iterable[str], incomplete: str) -> list[Any]:
    return [CompletionItem(name) for name in names if name.startswith(incomplete)]
