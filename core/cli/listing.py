"""``zonda plugins``, ``zonda pipelines`` and ``zonda schema``: what there is."""

from __future__ import annotations

import traceback
import warnings

import click

from ..errors import ZondaError


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
