"""How fast a pipeline is, over the last few seconds. Threads share it."""

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
    """Frames that were given up so that newer ones come soon.

    Attributes:
        source: that a recording had no time to read, so that it keeps its pace.
        detect: that came while the detectors were busy.
        show: with boxes, that came while the display was busy.
        record: with boxes, that the disk was too slow for.
    """

    source: int = 0
    detect: int = 0
    show: int = 0
    record: int = 0


@dataclass(frozen=True)
class Figures:
    """One look at a pipeline; the medians are those of the window.

    Attributes:
        fps: frames a second that came through to the display; None before there are two.
        latency_ms, latency_p95_ms: from the moment that a frame was taken to that at which it was shown.
        stages_ms: median time of each stage: read, image and view detector, the geometry between them, show.
        read, detected, shown: frames since the beginning.
        broken: frames of a recording that could not be read.
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
    """Counts what the stages tell it.

    Attributes:
        window_s: how far back the rates and medians look, seconds.
    """

    window_s: float = WINDOW_S
    read: int = 0
    detected: int = 0
    broken: int = 0
    _shown: int = 0
    _recent: deque[_Shown] = field(default_factory=deque)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def shown(self, taken_s: float, stages_s: Mapping[str, float], *, is_first: bool = False) -> None:
        """A frame is on the display now.

        Args:
            taken_s: when it was taken, `time.perf_counter`.
            stages_s: what each stage took of it.
            is_first: it is counted, and its times are those of getting ready.
        """
        now = time.perf_counter()
        with self._lock:
            self._shown += 1
            if is_first:
                return
            self._recent.append(_Shown(now, now - taken_s, stages_s))
            self._forget(now)

    def figures(self, drops: Drops) -> Figures:
        """What there is to say now."""
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
    """Of moments in order, how many a second."""
    return None if len(at_s) < 2 or at_s[-1] <= at_s[0] else (len(at_s) - 1) / (at_s[-1] - at_s[0])


def told(figures: Figures) -> str:
    """The figures in one line."""
    rate = "too few frames for a rate" if figures.fps is None else f"{figures.fps:.1f} frames/s"
    late = (
        "" if figures.latency_ms is None else f", {figures.latency_ms:.0f} ms late (95 %: {figures.latency_p95_ms:.0f})"
    )
    drops = figures.drops
    gone = [f"{count} {name}" for name, count in vars(drops).items() if count]
    lost = f"; dropped: {', '.join(gone)}" if gone else ""
    return f"{rate}{late}; {figures.shown} shown{lost}" + (f"; {figures.broken} unreadable" if figures.broken else "")
