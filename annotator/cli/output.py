"""What commands print: plain lines for people, one JSON object for programs; both on standard output."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Annotated

import tyro
from pydantic import BaseModel

AsJson = Annotated[bool, tyro.conf.arg(name="json")]
"""The option `--json` of a command."""


def print_line(text: str) -> None:
    """One line, as it is."""
    sys.stdout.write(text + "\n")


def print_json(model: BaseModel) -> None:
    """One JSON object on one line."""
    print_line(model.model_dump_json())


def print_facts(rows: Iterable[tuple[str, object]]) -> None:
    """Two columns: what, and its value."""
    known = list(rows)
    width = max((len(what) for what, _ in known), default=0)
    for what, value in known:
        print_line(f"{what:{width}}  {value}")
