"""`annotator completion`"""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stdout, suppress
from typing import Literal

from tyro.extras import SubcommandApp

from annotator.cli.main import COMMANDS, GROUPS, load, style, with_help

Shell = Literal["bash", "zsh", "fish"]
"""Shells that tyro writes completion scripts for."""


def run(shell: Shell, /) -> None:
    """Print the completion script of a shell, for all commands and options.

    bash: annotator completion bash > ~/.local/share/bash-completion/completions/annotator

    zsh: annotator completion zsh > FOLDER/_annotator, where FOLDER is in $fpath

    fish: annotator completion fish > ~/.config/fish/completions/annotator.fish

    Args:
        shell: bash, zsh or fish.
    """
    sys.stdout.write(script(shell))


def script(shell: Shell) -> str:
    """The completion script of a shell. Building it imports the module of every command, which takes two seconds."""
    printed = io.StringIO()
    with redirect_stdout(printed), suppress(SystemExit):
        _app().cli(prog="annotator", args=["--tyro-print-completion", shell], config=style())
    text = printed.getvalue()
    # tyro's bash function offers no file names for positional arguments; with -o default, bash adds them
    return text.replace("complete -F ", "complete -o default -F ") if shell == "bash" else text


def _app() -> SubcommandApp:
    """One tyro application with all commands; only the completion scripts need it."""
    app = SubcommandApp()
    groups = {group: SubcommandApp() for group in GROUPS}
    for group, summary in GROUPS.items():
        app.command(groups[group], name=group, help=summary)
    for name, command in COMMANDS.items():
        group, _, member = name.partition(" ")
        (groups[group] if member else app).command(name=member or name, help=command.summary)(with_help(load(command)))
    # main.py handles `help`; these subcommands only complete its arguments
    explained = SubcommandApp()
    app.command(explained, name="help", help="explain a command")
    for word in dict.fromkeys(name.partition(" ")[0] for name in COMMANDS):
        explained.command(name=word)(lambda: None)
    return app
