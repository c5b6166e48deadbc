"""Capture, detection and display side by side: each works on its newest frame, and none waits for a slower one.

    source -> [slot] -> detection -> [slot] -> display
                            \\-> record

Each stage is a thread. Whatever ends one of them (the end of the source, an error, `stop`) ends all. Detectors get
ready on the first frame, which takes long: no other one is taken meanwhile, and it is not measured.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol, runtime_checkable

from annotator.types.errors import ConfigError, DeviceError, FrameError
from annotator.workflows.live.demand import Demand
from annotator.workflows.live.detection import Detected
from annotator.workflows.live.figures import Drops, Figures, Meter
from annotator.workflows.live.slot import Slot
from annotator.workflows.live.source import Source, Taken

# A thread that has been told to end, and is not in the middle of a call that never returns, does so within this.
ENDS_WITHIN_S = 20.0

Show = Callable[[Detected], None]
Tell = Callable[[str], None]


@runtime_checkable
class Detection(Protocol):
    """Finds the boxes of one frame after the other."""

    def detect(self, taken: Taken) -> Detected:
        """The boxes of a frame."""


@runtime_checkable
class Keep(Protocol):
    """Takes what was detected, to be recorded; never waits."""

    @property
    def dropped(self) -> int:
        """Frames that could not be taken."""

    def put(self, detected: Detected) -> None:
        """One frame with its boxes."""


class Pipeline:
    """Runs from `start` until its source ends, a stage fails, or it is stopped.

    Attributes:
        source: where frames come from; closed at the end.
        meter: what was measured.
        ended: set once all threads have come to their end.
    """

    def __init__(
        self,
        source: Source,
        detection: Detection,
        show: Show,
        *,
        keep: Keep | None = None,
        most_frames: int | None = None,
        tell: Tell = lambda line: None,
    ) -> None:
        """
        Args:
            show: the display; called by a thread of its own.
            keep: gets all that is detected, too.
            most_frames: end after so many frames of the source; None = with the source.
            tell: gets a line on each frame that cannot be read.

        Raises:
            ConfigError: no frame at all is asked for.
        """
        if most_frames is not None and most_frames < 1:
            raise ConfigError(f"{most_frames} frames show nothing; give 1 or more")
        self.source = source
        self.meter = Meter()
        self.ended = threading.Event()
        self._detection, self._show, self._keep = detection, show, keep
        self._most_frames, self._tell = most_frames, tell
        self._taken: Slot[Taken] = Slot()
        self._detected: Slot[Detected] = Slot()
        self._demand = Demand()
        self._stop = threading.Event()
        self._running = threading.Event()
        self._running.set()
        self._ready = threading.Event()
        self._error: BaseException | None = None
        self._lock = threading.Lock()
        self._at_end: list[Callable[[], None]] = []
        self._threads = [
            threading.Thread(target=self._guarded, args=(stage,), name=name, daemon=True)
            for name, stage in (("capture", self._capture), ("detect", self._detect), ("display", self._display))
        ]
        self._left = len(self._threads)

    def start(self) -> None:
        """Starts all stages."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Asks all stages to end; what waits between them is given up."""
        for event in (self._stop, self._running, self._ready):
            event.set()
        self._demand.close()
        for slot in (self._taken, self._detected):
            slot.close(empty=True)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Waits for the end; True where it has come.

        Raises:
            AnnotatorError: why a stage failed.
        """
        if not self.ended.wait(timeout_s):
            return False
        if self._error is not None:
            raise self._error
        return True

    def end(self) -> None:
        """Stops, and waits until all stages have ended.

        Raises:
            AnnotatorError: why a stage failed.
            DeviceError: the source does not come back from the device.
        """
        self.stop()
        if not self.wait(ENDS_WITHIN_S):
            alive = ", ".join(thread.name for thread in self._threads if thread.is_alive())
            raise DeviceError(f"{self.source.name}: {alive} does not end; unplug the device, or end the process")

    def at_end(self, call: Callable[[], None]) -> None:
        """Has `call` called, by a thread of the pipeline, when all has ended."""
        with self._lock:
            if not self.ended.is_set():
                self._at_end.append(call)
                return
        call()

    @property
    def is_paused(self) -> bool:
        """Whether no frame is taken for now."""
        return not self._running.is_set()

    def pause(self, paused: bool) -> None:
        """Takes no frame until it is told otherwise."""
        if paused:
            self._running.clear()
        if not paused or self._stop.is_set():  # asked after clearing: a stop in between is not to be undone
            self._running.set()

    def figures(self) -> Figures:
        """What was measured lately."""
        dropped = 0 if self._keep is None else self._keep.dropped
        drops = Drops(self.source.skipped, self._taken.dropped, self._detected.dropped, dropped)
        return self.meter.figures(drops)

    # --- the stages, each by its own thread --------------------------------------------------------------------------

    def _capture(self) -> None:
        try:
            while not self._stop.is_set() and self._most_frames != self.meter.read + self.meter.broken:
                if not self._running.is_set():
                    self._running.wait()
                    self.source.resume()
                    continue
                if self.source.gives_newest:
                    self._demand.wait()
                try:
                    taken = self.source.read(self._stop)
                except FrameError as error:
                    self.meter.broken += 1
                    self._tell(str(error))
                    continue
                if taken is None:
                    break
                self.meter.read += 1
                self._demand.given(taken.read_s)
                self._taken.put(taken)
                if not self._ready.is_set():
                    self._ready.wait()
                    self.source.resume()
        finally:
            self.source.close()
            self._taken.close()

    def _detect(self) -> None:
        try:
            while (taken := self._taken.take()) is not None:
                self._demand.begins()
                detected = self._detection.detect(taken)
                self._demand.ends()
                self.meter.detected += 1
                if self._keep is not None:
                    self._keep.put(detected)
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

    def _guarded(self, stage: Callable[[], None]) -> None:
        """Runs a stage; its failure ends the others, and is kept for who waits."""
        try:
            stage()
        except BaseException as error:
            with self._lock:
                self._error = self._error or error
            self.stop()
        with self._lock:
            self._left -= 1
            if self._left:
                return
            self.ended.set()
            calls = tuple(self._at_end)
        for call in calls:
            call()
