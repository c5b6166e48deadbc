"""Output and errors of the benchmarks: tables, and with --json one JSON object on the last line."""

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
    """A printed table; floats are rounded to three decimals."""

    def __init__(self, *heads: str) -> None:
        self._table = RichTable(*heads)

    def add(self, *cells: object) -> None:
        self._table.add_row(*(f"{c:.3f}" if isinstance(c, float) else str(c) for c in cells))

    def show(self) -> None:
        # without a terminal, wide enough for all columns
        console = Console()
        (console if console.is_terminal else Console(width=140)).print(self._table)


def guarded(main: Callable[[], None]) -> None:
    """Runs a benchmark; on unusable input, exits with code 2 after one line on stderr (with `--debug`, a traceback)."""
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
    """Prints the tables and, with `as_json`, the result as the last line of standard output."""
    for table in tables:
        table.show()
    if as_json:
        print(json.dumps(_plain(result), allow_nan=False))


def _plain(value: object) -> object:
    """The value with NaN and infinities, which JSON cannot represent, replaced by None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
