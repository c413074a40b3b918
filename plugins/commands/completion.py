"""``zonda completion``: the script with which a shell completes commands, options and names."""

from __future__ import annotations

import click

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
    from click.shell_completion import get_completion_class

    kind = get_completion_class(shell)
    assert kind is not None  # click knows these three
    root = context.find_root()
    made = kind(root.command, {}, "zonda", VARIABLE)
    click.echo(HOW[shell])
    click.echo((made.source_template % made.source_vars()).strip())
