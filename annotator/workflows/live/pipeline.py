"""Runs capture, detection and display in parallel: each processes its newest frame without waiting for a slower one.

    source -> [slot] -> detection -> [slot] -> display
                            \\-> record

Each stage is a thread. If one ends (the source ends, an error, `stop`), all end. The detectors are prepared on the
first frame, which takes long: no frame is read in the meantime, and the first one is not measured.

Reading a frame occupies a core for some time (12 ms for an RGB-D image pair), which delays the detectors on a small
machine. So a source that returns its newest frame on request is read as late as possible, such that the frame is ready
when detection ends. Both durations are predicted from recent ones.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from annotator.types.errors import ConfigError, DeviceError, FrameError
from annotator.workflows.live.detection import Detected, Taken
from annotator.workflows.live.recorder import Recorder

WINDOW_S = 5.0


@dataclass(frozen=True)
class Figures:
    """Measurements of a pipeline; rates, medians and percentiles are those of the window.

    Attributes:
        fps: shown frames per second; None before two are shown.
        latency_ms, latency_p95_ms: median and 95th percentile of the time from taking a frame to showing it.
        stages_ms: median duration of each stage: read, image and view detector, the geometry between them, show.
        read, detected, shown: numbers of frames since the start.
        broken: number of frames that could not be read.
        drops: numbers of dropped frames: `source` left out by the source to keep its rate, `detect` and `show` replaced
            by a newer one while detectors or display were busy, `record` not recorded because the disk was too slow.
    """

    fps: float | None
    latency_ms: float | None
    latency_p95_ms: float | None
    stages_ms: Mapping[str, float]
    read: int
    detected: int
    shown: int
    broken: int
    drops: Mapping[str, int]


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
    # when a frame was shown, its latency, and the durations of its stages, seconds
    _recent: deque[tuple[float, float, Mapping[str, float]]] = field(default_factory=deque)
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
            self._recent.append((now, now - taken_s, stages_s))
            self._forget(now)

    def figures(self, drops: Mapping[str, int]) -> Figures:
        with self._lock:
            self._forget(time.perf_counter())
            recent, shown = list(self._recent), self._shown
        at_s, stages = [at for at, _, _ in recent], [stages_s for _, _, stages_s in recent]
        latency_ms = [1e3 * latency_s for _, latency_s, _ in recent]
        names = dict.fromkeys(name for stages_s in stages for name in stages_s)
        has_rate = len(at_s) > 1 and at_s[-1] > at_s[0]
        return Figures(
            fps=(len(at_s) - 1) / (at_s[-1] - at_s[0]) if has_rate else None,
            latency_ms=float(np.median(latency_ms)) if recent else None,
            latency_p95_ms=float(np.percentile(latency_ms, 95)) if recent else None,
            stages_ms={
                name: 1e3 * float(np.median([stages_s[name] for stages_s in stages if name in stages_s]))
                for name in names
            },
            read=self.read,
            detected=self.detected,
            shown=shown,
            broken=self.broken,
            drops=drops,
        )

    def _forget(self, now: float) -> None:
        while self._recent and now - self._recent[0][0] > self.window_s:
            self._recent.popleft()


def summary_line(figures: Figures) -> str:
    """Returns the measurements in one line."""
    counts = [f"{count} {name}" for name, count in figures.drops.items() if count]
    parts = ["too few frames for a rate" if figures.fps is None else f"{figures.fps:.1f} frames/s"]
    if figures.latency_ms is not None:
        parts[0] += f", {figures.latency_ms:.0f} ms latency (95 %: {figures.latency_p95_ms:.0f})"
    parts.append(f"{figures.shown} shown")
    parts += [f"dropped: {', '.join(counts)}"] if counts else []
    parts += [f"{figures.broken} unreadable"] if figures.broken else []
    return "; ".join(parts)


# Time within which all threads end after `stop`, unless one hangs in a call.
END_TIMEOUT_S = 20.0

Show = Callable[[Detected], None]
Report = Callable[[str], None]


Item = TypeVar("Item")

# Number of recent durations whose median predicts the next one.
HISTORY = 9
# A frame is read this much earlier than predicted, seconds, since a late frame costs more than a slightly older one.
SPARE_S = 0.003


class Slot(Generic[Item]):
    """Holds one item, which a newer one replaces until it is taken. One thread puts, another takes.

    Attributes:
        dropped: number of items replaced before they were taken.
        taken_s: when the last item was taken, `time.perf_counter`.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: Item | None = None
        self._awaited = self._closed = False
        self.dropped = 0
        self.taken_s = 0.0

    def put(self, item: Item) -> None:
        """Puts an item without waiting. Does nothing after `close`."""
        with self._changed:
            if self._closed:
                return
            self.dropped += self._item is not None
            self._item = item
            self._changed.notify_all()

    def take(self) -> Item | None:
        """Waits for an item and takes it; returns None once the slot is closed and empty."""
        with self._changed:
            self._awaited = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._item is not None or self._closed)
            item, self._item = self._item, None
            self._awaited, self.taken_s = False, time.perf_counter()
            self._changed.notify_all()
            return item

    def wait_until_wanted(self, after_s: float) -> None:
        """Waits until the item was taken `after_s` seconds ago, the next one is waited for, or the slot is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is None or self._closed)
            left_s = self.taken_s + after_s - time.perf_counter()
            self._changed.wait_for(lambda: self._awaited or self._closed, max(left_s, 0.0))

    def close(self, *, empty: bool = False) -> None:
        """Accepts no more items. The present one can still be taken, unless `empty` is set."""
        with self._changed:
            self._closed = True
            if empty:
                self._item = None
            self._changed.notify_all()


@runtime_checkable
class Source(Protocol):
    """A camera, or a played recording. Read by one thread."""

    @property
    def name(self) -> str:
        """The name shown to the operator."""

    @property
    def gives_newest(self) -> bool:
        """True if `read` returns the newest frame; False if unread frames queue up."""

    @property
    def skipped(self) -> int:
        """Number of frames left out to keep the frame rate."""

    def read(self, stop: threading.Event) -> Taken | None:
        """Waits for the next frame; returns None at the end, or when `stop` is set.

        Raises:
            FrameError: this frame cannot be read; the next one may be readable.
            DeviceError: the camera is disconnected or delivers no frames.
        """

    def resume(self) -> None:
        """Discards frames that are old by now; called after a pause."""

    def close(self) -> None:
        """Releases the camera."""


class Pipeline:
    """Runs from `start` until its source ends, a stage fails, or it is stopped.

    Attributes:
        source: of the frames; closed at the end.
        ended: set once all stages have ended; then `on_end`, which may be set before the start, is called.
    """

    def __init__(
        self,
        source: Source,
        detect: Callable[[Taken], Detected],
        show: Show,
        *,
        record: Recorder | None = None,
        max_frames: int | None = None,
        report: Report = lambda line: None,
    ) -> None:
        """
        Args:
            show: the display; called by a thread of its own.
            max_frames: end after this number of frames of the source; None = when the source ends.
            report: called with a message for each frame that cannot be read.
        """
        if max_frames is not None and max_frames < 1:
            raise ConfigError(f"cannot show {max_frames} frames; give 1 or more")
        self.source = source
        self.meter = Meter()
        self.ended = threading.Event()
        self.on_end: Callable[[], None] = lambda: None
        self._detect_in, self._show, self._record = detect, show, record
        self._max_frames, self._report = max_frames, report
        self._taken: Slot[Taken] = Slot()
        self._detected: Slot[Detected] = Slot()
        # of detection without the first frame, which takes long, and of reading
        self._durations_s: deque[float] = deque(maxlen=HISTORY)
        self._reads_s: deque[float] = deque(maxlen=HISTORY)
        self._stop = threading.Event()
        self._running = threading.Event()
        self._running.set()
        self._ready = threading.Event()
        self._error: BaseException | None = None
        self._lock = threading.Lock()
        self._threads = [
            threading.Thread(target=self._run_stage, args=(stage,), name=name, daemon=True)
            for name, stage in (("capture", self._capture), ("detect", self._detect), ("display", self._display))
        ]
        self._running_stages = len(self._threads)

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Asks all stages to end; frames between them are dropped."""
        for event in (self._stop, self._running, self._ready):
            event.set()
        for slot in (self._taken, self._detected):
            slot.close(empty=True)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Waits for the end; returns False after `timeout_s` seconds."""
        if not self.ended.wait(timeout_s):
            return False
        if self._error is not None:
            raise self._error
        return True

    def end(self) -> None:
        """Stops, and waits until all stages have ended."""
        self.stop()
        if not self.wait(END_TIMEOUT_S):
            alive = ", ".join(thread.name for thread in self._threads if thread.is_alive())
            raise DeviceError(f"{self.source.name}: {alive} does not end; unplug the device, or end the process")

    @property
    def is_paused(self) -> bool:
        """True while no frames are read."""
        return not self._running.is_set()

    def pause(self, paused: bool) -> None:
        if paused:
            self._running.clear()
        if not paused or self._stop.is_set():  # checked after clearing, so that a concurrent stop is not undone
            self._running.set()

    def figures(self) -> Figures:
        drops = {"source": self.source.skipped, "detect": self._taken.dropped, "show": self._detected.dropped}
        return self.meter.figures(drops | {"record": 0 if self._record is None else self._record.dropped})

    # --- the stages, each by its own thread --------------------------------------------------------------------------

    def _capture(self) -> None:
        try:
            while not self._stop.is_set() and self._max_frames != self.meter.read + self.meter.broken:
                if not self._running.is_set():
                    self._running.wait()
                    self.source.resume()
                    continue
                if self.source.gives_newest:
                    self._wait_for_demand()
                try:
                    taken = self.source.read(self._stop)
                except FrameError as error:
                    self.meter.broken += 1
                    self._report(str(error))
                    continue
                if taken is None:
                    break
                self.meter.read += 1
                self._reads_s.append(taken.read_s)
                self._taken.put(taken)
                if not self._ready.is_set():
                    self._ready.wait()
                    self.source.resume()
        finally:
            self.source.close()
            self._taken.close()

    def _wait_for_demand(self) -> None:
        """Returns when the next frame should be read, such that it is ready when detection ends."""
        after_s = 0.0
        if self._durations_s and self._reads_s:
            after_s = statistics.median(self._durations_s) - statistics.median(self._reads_s) - SPARE_S
        self._taken.wait_until_wanted(after_s)

    def _detect(self) -> None:
        try:
            while (taken := self._taken.take()) is not None:
                detected = self._detect_in(taken)
                if self._ready.is_set():
                    self._durations_s.append(time.perf_counter() - self._taken.taken_s)
                self.meter.detected += 1
                if self._record is not None:
                    self._record.put(detected)
                self._detected.put(detected)
                self._ready.set()
        finally:
            self._detected.close()

    def _display(self) -> None:
        while (detected := self._detected.take()) is not None:
            begin = time.perf_counter()
            self._show(detected)
            stages_s = {**detected.stages_s, "show": time.perf_counter() - begin}
            self.meter.shown(detected.taken_s, stages_s, is_first=detected.is_first)

    def _run_stage(self, stage: Callable[[], None]) -> None:
        """Runs a stage. A failure ends the other stages, and is raised by `wait`."""
        try:
            stage()
        except BaseException as error:
            with self._lock:
                self._error = self._error or error
            self.stop()
        with self._lock:
            self._running_stages -= 1
            if self._running_stages:
                return
        self.ended.set()
        self.on_end()
