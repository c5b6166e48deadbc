"""Where the time of a run goes: functions of the program, watched from outside while they work."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np


class Stopwatch:
    """Seconds of this thread's processor time by stage; of what is inside of each other, each second counts for the
    innermost stage. Other programs on the machine make it longer by what they take of the caches, and not by waiting.

    Attributes:
        runs: for each run its steps, for each step seconds by stage.
        whole: for each stage of a run its seconds, each time it ran.
    """

    def __init__(self, of_run: Sequence[str], clock: Callable[[], float] = time.thread_time) -> None:
        """
        Args:
            of_run: stages that belong to no step.
            clock: seconds.
        """
        self._clock = clock
        self._of_run = frozenset(of_run)
        self.runs: list[list[dict[str, float]]] = []
        self.whole: dict[str, list[float]] = defaultdict(list)
        self._inside: list[float] = []

    def forget(self) -> None:
        """Begins anew."""
        self.runs.clear()
        self.whole.clear()

    def median_ms(self, stage: str) -> float:
        """The median of a stage of a run, milliseconds; NaN where it never ran."""
        return float(np.median(self.whole[stage])) * 1e3 if self.whole[stage] else float("nan")

    @contextmanager
    def over(self, *watched: tuple[Any, ...]) -> Iterator[None]:
        """One run, with functions watched.

        Args:
            watched: for each where it is looked up, its name there, the stage that its time counts for, and True where
                a call begins a step.
        """
        self.runs.append([])
        with ExitStack() as stack:
            for holder, name, stage, *begins in watched:
                timed = self._timed(getattr(holder, name), stage, bool(begins))
                stack.enter_context(patch.object(holder, name, timed))
            yield

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Counts what happens inside for a stage."""
        self._inside.append(0.0)
        begin = self._clock()
        try:
            yield
        finally:
            whole = self._clock() - begin
            own = whole - self._inside.pop()
            if self._inside:
                self._inside[-1] += whole
            self._count(name, own)

    def _timed(self, function: Callable[..., Any], stage: str, begins: bool) -> Callable[..., Any]:
        def call(*args: Any, **named: Any) -> Any:
            if begins:
                self.runs[-1].append(defaultdict(float))
            with self.stage(stage):
                return function(*args, **named)

        return call

    def _count(self, stage: str, seconds: float) -> None:
        if stage in self._of_run:
            self.whole[stage].append(seconds)
        else:
            self.runs[-1][-1][stage] += seconds
