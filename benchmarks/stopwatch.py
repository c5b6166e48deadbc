"""A profiler by stage: measures the time of functions of the program, which are patched temporarily."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np


class Stopwatch:
    """CPU seconds of this thread by stage. The time of nested stages counts for the innermost one.

    CPU time does not include waiting; other programs affect it only through shared caches.

    Attributes:
        runs: for each run, its steps; for each step, seconds by stage.
        whole: for each stage outside the steps, its seconds each time it ran.
    """

    def __init__(self, run_stages: Sequence[str], clock: Callable[[], float] = time.thread_time) -> None:
        """
        Args:
            run_stages: stages that belong to the whole run and not to a step.
            clock: returns the time, seconds.
        """
        self._clock = clock
        self._run_stages = frozenset(run_stages)
        self.runs: list[list[dict[str, float]]] = []
        self.whole: dict[str, list[float]] = defaultdict(list)
        self._inside: list[float] = []

    def reset(self) -> None:
        """Discards all times."""
        self.runs.clear()
        self.whole.clear()

    def median_ms(self, stage: str) -> float:
        """Median time of a stage outside the steps, milliseconds; NaN if it never ran."""
        return float(np.median(self.whole[stage])) * 1e3 if self.whole[stage] else float("nan")

    @contextmanager
    def over(self, *functions: tuple[Any, ...]) -> Iterator[None]:
        """Times one run.

        Args:
            functions: for each function, its module or object, its name there, the stage to which its time is added,
                and True if a call starts a new step.
        """
        self.runs.append([])
        with ExitStack() as stack:
            for holder, name, stage, *starts_step in functions:
                timed = self._timed(getattr(holder, name), stage, bool(starts_step))
                stack.enter_context(patch.object(holder, name, timed))
            yield

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Counts the time of the block for a stage."""
        self._inside.append(0.0)
        begin = self._clock()
        try:
            yield
        finally:
            total = self._clock() - begin
            without_nested = total - self._inside.pop()
            if self._inside:
                self._inside[-1] += total
            self._count(name, without_nested)

    def _timed(self, function: Callable[..., Any], stage: str, starts_step: bool) -> Callable[..., Any]:
        def call(*args: Any, **named: Any) -> Any:
            if starts_step:
                self.runs[-1].append(defaultdict(float))
            with self.stage(stage):
                return function(*args, **named)

        return call

    def _count(self, stage: str, seconds: float) -> None:
        if stage in self._run_stages:
            self.whole[stage].append(seconds)
        else:
            self.runs[-1][-1][stage] += seconds
