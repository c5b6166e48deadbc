"""Progress bars on standard error, with the time left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A bar with counts, elapsed and remaining time, on standard error.

    If an error ends the work, the bar is removed, so that only the message remains.
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
    except BaseException:  # an interrupt: the bar stays and shows the progress
        bar.stop()
        raise
    else:
        bar.stop()


@contextmanager
def counted(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar for countable work; yields a function that sets (done, total)."""
    with progress_bar() as bar:
        task = bar.add_task(what, total=None, note="")

        def update(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield update
