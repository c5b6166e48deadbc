"""A recording that is played as if a camera stood where it was taken: at its own rate, in its own order."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator, Sequence
from enum import StrEnum

import numpy as np

from annotator.recordings import Recording
from annotator.types.errors import ConfigError, FrameError, RecordingError
from annotator.workflows.live.source import Taken

# Frames a second of recordings that do not know when their frames were taken: a LiDAR turns ten times a second, RGB-D
# cameras give 30.
RATE_BY_FORMAT = {"kitti_object": 10.0, "kitti_tracking": 10.0, "kitti_raw": 10.0, "cloud_folder": 10.0}
DEFAULT_RATE = 30.0
# A longer pause within a recording is shortened to this, seconds.
LONGEST_GAP_S = 1.0
# Who asks when a frame is nearly as old as the next one is far gets the next one: seconds, and a share of the time
# between the two. Frames of a source of 30 a second that is asked at any moment are 9 ms old on average in place of 17,
# for 1 ms of waiting.
PATIENCE_S, PATIENCE_SHARE = 0.010, 0.25


class Repeat(StrEnum):
    """What comes after the last frame."""

    NO = "no"
    AGAIN = "again"
    BACK = "back"
    """Back to the first one and forth again, so that motion goes on without a jump."""


class Playback:
    """A `Source` that plays a recording. A frame whose successor is due, or nearly so, is left out.

    Attributes:
        recording: what is played.
        gives_newest: it leaves out what nobody has asked for in time.
        skipped: frames that were left out.
    """

    gives_newest = True

    def __init__(self, recording: Recording, *, rate: float | None = None, repeat: Repeat = Repeat.NO) -> None:
        """
        Args:
            rate: frames a second; None = the recording's own; infinite = as fast as it can be read.

        Raises:
            ConfigError: a rate of zero or less.
        """
        if rate is not None and not rate > 0:
            raise ConfigError(f"a rate of {rate:g} frames a second shows nothing; give more than 0")
        self.recording = recording
        self.skipped = 0
        self._gap_s = None if rate is None else 1 / rate
        self._times_s = None if rate is not None else times_s(recording)
        self._order = _order(len(recording), repeat)
        self._next = next(self._order, None)
        self._due_s: float | None = None
        self._broken_in_a_row = 0

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def rate(self) -> float:
        """Frames a second, where they come evenly; else the median."""
        if self._times_s is None or len(self._times_s) < 2:
            gap_s = self._gap_s if self._gap_s is not None else 1 / default_rate(self.recording)
            return np.inf if gap_s == 0 else 1 / gap_s
        return 1 / max(float(np.median(np.abs(np.diff(self._times_s)))), 1e-9)

    def read(self, stop: threading.Event) -> Taken | None:
        """As `Source.read`.

        Raises:
            FrameError: this frame cannot be read.
            RecordingError: none of a whole round could be.
        """
        turn = self._await_turn(stop)
        if turn is None:
            return None
        index, taken_s = turn
        begin = time.perf_counter()
        try:
            frame = self.recording.frame(index)
        except FrameError as error:
            self._broken_in_a_row += 1
            if self._broken_in_a_row >= len(self.recording):
                count = len(self.recording)
                raise RecordingError(
                    f"{self.recording.path}: none of its {count} frames can be read: {error}"
                ) from error
            raise
        self._broken_in_a_row = 0
        return Taken(frame, taken_s, time.perf_counter() - begin)

    def resume(self) -> None:
        """The next frame is due now."""
        self._due_s = None

    def close(self) -> None:
        """Recordings hold nothing open."""

    def _await_turn(self, stop: threading.Event) -> tuple[int, float] | None:
        """The next frame's number and when it was due, once it is; those whose successors are nearly due are left out.

        None at the end, or when `stop` is set.
        """
        while self._next is not None:
            now = time.perf_counter()
            # at full speed nothing is ever late
            index, due_s = self._next, now if self._due_s is None or self._gap_s == 0 else self._due_s
            self._next = next(self._order, None)
            gap_s = 0.0 if self._next is None else self._gap(index, self._next)
            self._due_s = due_s + gap_s
            if gap_s and self._due_s <= now + min(PATIENCE_S, PATIENCE_SHARE * gap_s):
                self.skipped += 1
                continue
            if stop.wait(max(due_s - now, 0.0)):
                return None
            return index, due_s
        return None

    def _gap(self, index: int, following: int) -> float:
        """From one frame to the next that is played, seconds."""
        if self._gap_s is not None:
            return self._gap_s
        if self._times_s is None or abs(following - index) != 1:  # from the last one to the first
            return 1 / self.rate
        return min(abs(self._times_s[following] - self._times_s[index]), LONGEST_GAP_S)


def times_s(recording: Recording) -> Sequence[float] | None:
    """When each frame was taken, seconds from any moment; None where the recording does not know it of all of them."""
    times_ns: Sequence[int | None] | None = getattr(recording, "times_ns", None)
    if times_ns is None or any(each is None for each in times_ns):
        return None
    return [1e-9 * each for each in times_ns if each is not None]


def default_rate(recording: Recording) -> float:
    """Frames a second of a recording that knows no times."""
    return RATE_BY_FORMAT.get(recording.format, DEFAULT_RATE)


def _order(frames: int, repeat: Repeat) -> Iterator[int]:
    once = range(frames)
    if repeat is Repeat.NO:
        return iter(once)
    if repeat is Repeat.BACK:
        return itertools.cycle([*once, *once[-2:0:-1]])
    return itertools.cycle(once)
