"""How benchmarks print: a table for people, one JSON object on the last line for programs; and how they fail."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping

from rich.console import Console
from rich.table import Table as RichTable

from annotator.types.errors import AnnotatorError

UNUSABLE_INPUT = 2


class Table:
    """Rows under column heads; numbers are rounded for reading."""

    def __init__(self, *heads: str) -> None:
        self._table = RichTable(*heads)

    def add(self, *cells: object) -> None:
        self._table.add_row(*(f"{c:.3f}" if isinstance(c, float) else str(c) for c in cells))

    def show(self) -> None:
        # Where no terminal says how wide it is, nothing shall be cut.
        console = Console()
        (console if console.is_terminal else Console(width=140)).print(self._table)


def guarded(main: Callable[[], None]) -> None:
    """Runs a benchmark: unusable input is one line on standard error and exit code 2; `--debug` shows the traceback."""
    debug = "--debug" in sys.argv
    sys.argv = [word for word in sys.argv if word != "--debug"]
    try:
        main()
    except AnnotatorError as error:
        if debug:
            raise
        sys.stderr.write(f"error: {error}\n")
        sys.exit(UNUSABLE_INPUT)


def finish(result: Mapping[str, object], as_json: bool, *tables: Table) -> None:
    """Prints the tables and, where asked for, the result as the last line of standard output."""
    for table in tables:
        table.show()
    if as_json:
        print(json.dumps(_plain(result), allow_nan=False))


def _plain(value: object) -> object:
    """JSON has no NaN: what could not be measured is null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
