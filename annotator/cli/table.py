"""The commands: name -> where its function is, and what it does in one line. A new command is one file and one row.

A command's function is a plain function: tyro makes the command line from its signature and docstring. It returns
None or an exit code.
"""

from __future__ import annotations

from typing import NamedTuple


class Command(NamedTuple):
    """One row: "module:function", and the line that `annotator --help` shows."""

    target: str
    summary: str


COMMANDS: dict[str, Command] = {
    "new": Command("annotator.cli.new:run", "create a project"),
    "add": Command("annotator.cli.add:run", "put recordings into a project"),
    "inspect": Command("annotator.cli.inspect:run", "say what a recording holds"),
    "stats": Command("annotator.cli.stats:run", "say how far a project is"),
}
