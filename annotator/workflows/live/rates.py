"""Frame rate, latency and stage durations of a pipeline over the last few seconds."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

WINDOW_S = 5.0


@dataclass(frozen=True)
class Drops:
    """Numbers of dropped frames.

    Attributes:
        source: left out by the source to keep its frame rate.
        detect: replaced by a newer frame while the detectors were busy.
        show: replaced by a newer frame while the display was busy.
        record: not recorded because the disk was too slow.
    """

    source: int = 0
    detect: int = 0
    show: int = 0
    record: int = 0


@dataclass(frozen=True)
class Figures:
    """Measurements of a pipeline; rates, medians and percentiles are those of the window.

    Attributes:
        fps: shown frames per second; None before two are shown.
        latency_ms, latency_p95_ms: median and 95th percentile of the time from taking a frame to showing it.
        stages_ms: median duration of each stage: read, image and view detector, the geometry between them, show.
        read, detected, shown: numbers of frames since the start.
        broken: number of frames that could not be read.
    """

    fps: float | None
    latency_ms: float | None
    latency_p95_ms: float | None
    stages_ms: Mapping[str, float]
    read: int
    detected: int
    shown: int
    broken: int
    drops: Drops


@dataclass(frozen=True)
class _Shown:
    at_s: float
    latency_s: float
    stages_s: Mapping[str, float]


@dataclass(eq=False)
class Meter:
    """Counts frames and measures durations. Thread-safe.

    Attributes:
        window_s: length of the window of rates and medians, seconds.
    """

    window_s: float = WINDOW_S
    read: int = 0
    detected: int = 0
    broken: int = 0
    _shown: int = 0
    _recent: deque[_Shown] = field(default_factory=deque)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def shown(self, taken_s: float, stages_s: Mapping[str, float], *, is_first: bool = False) -> None:
        """Notes that a frame is shown now.

        Args:
            taken_s: when it was taken, `time.perf_counter`.
            stages_s: duration of each stage, seconds.
            is_first: count it without its durations, which include preparing the detectors.
        """
        now = time.perf_counter()
        with self._lock:
            self._shown += 1
            if is_first:
                return
            self._recent.append(_Shown(now, now - taken_s, stages_s))
            self._forget(now)

    def figures(self, drops: Drops) -> Figures:
        """Returns the present measurements."""
        with self._lock:
            self._forget(time.perf_counter())
            recent, shown = list(self._recent), self._shown
        latency_ms = [1e3 * each.latency_s for each in recent]
        names = dict.fromkeys(name for each in recent for name in each.stages_s)
        return Figures(
            fps=_rate([each.at_s for each in recent]),
            latency_ms=float(np.median(latency_ms)) if recent else None,
            latency_p95_ms=float(np.percentile(latency_ms, 95)) if recent else None,
            stages_ms={
                name: 1e3 * float(np.median([each.stages_s[name] for each in recent if name in each.stages_s]))
                for name in names
            },
            read=self.read,
            detected=self.detected,
            shown=shown,
            broken=self.broken,
            drops=drops,
        )

    def _forget(self, now: float) -> None:
        while self._recent and now - self._recent[0].at_s > self.window_s:
            self._recent.popleft()


def _rate(at_s: list[float]) -> float | None:
    """Returns the rate of events per second, from their times in order."""
    return None if len(at_s) < 2 or at_s[-1] <= at_s[0] else (len(at_s) - 1) / (at_s[-1] - at_s[0])


def summary_line(figures: Figures) -> str:
    """Returns the measurements in one line."""
    rate = "too few frames for a rate" if figures.fps is None else f"{figures.fps:.1f} frames/s"
    latency = (
        ""
        if figures.latency_ms is None
        else f", {figures.latency_ms:.0f} ms latency (95 %: {figures.latency_p95_ms:.0f})"
    )
    drops = figures.drops
    counts = [f"{count} {name}" for name, count in vars(drops).items() if count]
    dropped = f"; dropped: {', '.join(counts)}" if counts else ""
    return f"{rate}{latency}; {figures.shown} shown{dropped}" + (
        f"; {figures.broken} unreadable" if figures.broken else ""
    )
