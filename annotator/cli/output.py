"""Standard output of the commands: plain lines, or one JSON object."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from pydantic import BaseModel


def print_line(text: str) -> None:
    """Prints one line."""
    sys.stdout.write(text + "\n")


def print_json(model: BaseModel) -> None:
    """Prints one JSON object on one line."""
    print_line(model.model_dump_json())


def print_facts(rows: Iterable[tuple[str, object]]) -> None:
    """Prints two columns: names and values."""
    listed = list(rows)
    width = max((len(name) for name, _ in listed), default=0)
    for name, value in listed:
        print_line(f"{name:{width}}  {value}")
