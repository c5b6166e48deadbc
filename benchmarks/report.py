"""What the benchmarks share: arguments and their checks, tables, and with --json one JSON object on the last line."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import tyro
from rich.console import Console
from rich.table import Table as RichTable

from annotator.detection.training import TrainingProgress
from annotator.project import BoxRotation
from annotator.types import DetectorKind
from annotator.types.errors import AnnotatorError, ConfigError

QUIET = Console(stderr=True, highlight=False, markup=False)


@dataclass(kw_only=True)
class Options:
    """The arguments of every benchmark."""

    json: bool = False
    """Print one JSON object as the last line."""


@dataclass(kw_only=True)
class BoxOptions(Options):
    """The arguments of benchmarks that need the rotation of boxes."""

    upright: bool = False
    """Upright boxes: one axis along gravity (default if the recording has a gravity direction)."""
    free: bool = False
    """Freely rotated boxes (default for other recordings)."""

    def __post_init__(self) -> None:
        if self.upright and self.free:
            raise ConfigError("--upright and --free contradict each other; give at most one")

    @property
    def rotation(self) -> BoxRotation:
        """The rotation of the boxes; AUTO: the recording decides."""
        return BoxRotation.UPRIGHT if self.upright else BoxRotation.FREE if self.free else BoxRotation.AUTO


def require(args: Options, low: float, high: float, *names: str) -> None:
    """Checks that numbers among the arguments are finite and from `low` to `high`."""
    for name in names:
        value = getattr(args, name)
        if not (low <= value <= high and math.isfinite(value)):
            allowed = f"{low} or more" if high == math.inf else f"{low} to {high}"
            raise ConfigError(f"--{name.replace('_', '-')} must be {allowed}, not {value}")


def chosen(flag: str, words: str, known: Iterable[str]) -> list[str]:
    """The words of a list with commas, checked."""
    parts = [part.strip() for part in words.split(",") if part.strip()]
    if unknown := [part for part in parts if part not in known]:
        raise ConfigError(f"{flag}: unknown word {unknown[0]!r}; choose from {', '.join(known)}")
    return parts


def seconds_of(work: Callable[[], object]) -> float:
    """How long some work takes."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def print_epoch(role: DetectorKind, step: TrainingProgress) -> None:
    """Reports the progress of a training on stderr."""
    if step.batch == step.batches and step.epoch % 5 == 0:
        QUIET.print(f"{role} epoch {step.epoch}/{step.epochs}: {step.seconds:.0f} s")


class Table:
    """A printed table; floats are rounded to three decimals, and None is empty."""

    def __init__(self, *heads: str, rows: Iterable[Iterable[object]] = ()) -> None:
        self._table = RichTable(*heads)
        for row in rows:
            self.add(*row)

    @classmethod
    def of_figures(cls, figures: Mapping[str, object]) -> Table:
        """Names and values; the values of a mapping have rows of their own."""
        table = cls("measure", "value")
        for name, value in figures.items():
            if isinstance(value, Mapping):
                for part, each in value.items():
                    table.add(f"{name}: {part}", each)
            else:
                table.add(name, value)
        return table

    def add(self, *cells: object) -> None:
        self._table.add_row(*("" if c is None else f"{c:.3f}" if isinstance(c, float) else str(c) for c in cells))

    def show(self) -> None:
        # without a terminal, wide enough for all columns
        console = Console()
        (console if console.is_terminal else Console(width=140)).print(self._table)


A = TypeVar("A", bound=Options)
R = TypeVar("R", bound=Mapping[str, Any])


def program(
    arguments: type[A], run: Callable[[A], R], tables: Callable[[A, R], Sequence[Table]], description: str | None
) -> Callable[[], R]:
    """The benchmark as a program: reads its arguments, runs, and prints the tables and the result."""

    def main() -> R:
        args = tyro.cli(
            arguments,
            description=description,
            config=(tyro.conf.EnumChoicesFromValues, tyro.conf.FlagCreatePairsOff),
        )
        result = run(args)
        for table in tables(args, result):
            table.show()
        if args.json:
            print(json.dumps(_plain(result), allow_nan=False))
        return result

    return main


def guarded(main: Callable[[], object]) -> None:
    """Runs a benchmark; on unusable input, exits with code 2 after one line on stderr (with `--debug`, a traceback)."""
    debug = "--debug" in sys.argv
    sys.argv = [word for word in sys.argv if word != "--debug"]
    try:
        main()
    except AnnotatorError as error:
        if debug:
            raise
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)


def _plain(value: object) -> object:
    """The value with NaN and infinities, which JSON cannot represent, replaced by None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
