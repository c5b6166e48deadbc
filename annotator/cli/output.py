"""Standard output of the commands: plain lines, or one JSON object."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from pydantic import BaseModel

from annotator.types.errors import ConfigError


def print_line(text: str) -> None:
    """Prints one line."""
    sys.stdout.write(text + "\n")


def require_yes(question: str, yes: bool) -> None:
    """Asks at a terminal whether to go on, unless `yes`.

    Raises:
        ConfigError: the answer is no, or there is nobody to ask.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise ConfigError(f"{question} Nothing was changed: add --yes to do it without being asked")
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ConfigError("nothing was changed")


def print_json(model: BaseModel) -> None:
    """Prints one JSON object on one line."""
    print_line(model.model_dump_json())


def print_facts(rows: Iterable[tuple[str, object]]) -> None:
    """Prints two columns: names and values."""
    listed = list(rows)
    width = max((len(name) for name, _ in listed), default=0)
    for name, value in listed:
        print_line(f"{name:{width}}  {value}")
