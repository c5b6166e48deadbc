"""What commands print: lines or one JSON object on standard output, progress bars on standard error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from pydantic import BaseModel
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from annotator.types.errors import ConfigError


def print_line(text: str) -> None:
    sys.stdout.write(text + "\n")


def require_yes(question: str, yes: bool) -> None:
    """Asks at a terminal whether to go on, unless `yes`."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise ConfigError(f"{question} Nothing was changed: add --yes to do it without being asked")
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ConfigError("nothing was changed")


def facts(rows: Iterable[tuple[str, object]]) -> Iterator[str]:
    """Yields the lines of two columns: names and values."""
    listed = list(rows)
    width = max((len(name) for name, _ in listed), default=0)
    for name, value in listed:
        yield f"{name:{width}}  {value}"


def print_lines(lines: Iterable[str]) -> None:
    for line in lines:
        print_line(line)


def print_result(result: BaseModel, lines: Iterable[str], as_json: bool) -> None:
    """Prints a result as one JSON object, or as lines for people."""
    print_lines([result.model_dump_json()] if as_json else lines)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A bar with counts, elapsed and remaining time, on standard error.

    If an error ends the work, the bar is removed, so that only the message remains; after an interrupt it stays.
    """
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("elapsed"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=Console(stderr=True),
    )
    bar.start()
    try:
        yield bar
    except Exception:
        bar.live.transient = True
        bar.live.stop()  # bar.stop() would leave an empty line where there is no terminal
        raise
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def counted(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar for countable work; yields a function that sets (done, total)."""
    with progress_bar() as bar:
        task = bar.add_task(what, total=None, note="")

        def update(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield update
