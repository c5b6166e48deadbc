"""Sources of live frames: an Azure Kinect, and a recording that is played at its frame rate."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from annotator.project import Project
from annotator.recordings import Recording, open_recording
from annotator.recordings.kinect.device import KinectDevice
from annotator.types import Frame
from annotator.types.errors import ConfigError, FrameError, RecordingError
from annotator.workflows.frame_source import OpenedRecording, open_stored
from annotator.workflows.live.detection import Taken
from annotator.workflows.live.pipeline import Source
from annotator.workflows.live.recorder import require_recordable


class KinectSource(KinectDevice):
    """A `Source` of the frames of a device.

    Attributes:
        skipped: 0, since late frames are dropped by the pipeline.
        gives_newest: False, since the driver queues unread frames.
    """

    skipped = 0
    gives_newest = False

    def read(self, stop: threading.Event) -> Taken | None:
        arrived = self.next_frame(stop)
        return None if arrived is None else Taken(*arrived, time.perf_counter() - arrived[1])


# Frames per second of recordings without times: 10 for a LiDAR, 30 for RGB-D cameras.
RATE_BY_FORMAT = {"kitti_object": 10.0, "kitti_tracking": 10.0, "kitti_raw": 10.0, "cloud_folder": 10.0}
DEFAULT_RATE = 30.0
# Longer gaps in a recording are shortened to this, seconds.
MAX_GAP_S = 1.0
# A frame is left out if the next one is due within this time: the smaller of a number of seconds and a share of the gap
# between the two. At 30 frames per second and random read times, frames are then 9 ms old on average instead of 17 ms,
# for 1 ms of waiting.
PATIENCE_S, PATIENCE_SHARE = 0.010, 0.25


class Playback:
    """A `Source` that plays a recording. A frame is left out if the next one is due or nearly due.

    Attributes:
        gives_newest: True, since late frames are left out.
    """

    gives_newest = True

    def __init__(
        self,
        recording: Recording,
        *,
        rate: float | None = None,
        order: Iterable[int] | None = None,
        read: Callable[[str], Frame] | None = None,
    ) -> None:
        """
        Args:
            rate: frames per second; None = as recorded; infinite = as fast as frames can be read.
            order: indices of the frames to play, which may be endless; None = each once.
            read: reads a frame by its key; None = as the recording's files give it.
        """
        if rate is not None and not rate > 0:
            raise ConfigError(f"cannot play at {rate:g} frames per second; give more than 0")
        self.recording = recording
        self.skipped = 0
        self._read = read
        self._gap_s = None if rate is None else 1 / rate
        times_ns: Sequence[int | None] | None = None if rate is not None else getattr(recording, "times_ns", None)
        # on an arbitrary clock, if all are recorded
        self._times_s = None if times_ns is None or None in times_ns else [1e-9 * (each or 0) for each in times_ns]
        self._order = iter(range(len(recording)) if order is None else order)
        self._next = next(self._order, None)
        self._due_s: float | None = None
        self._broken_in_a_row = 0

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def rate(self) -> float:
        """Frames per second; with recorded times, from their median gap."""
        if self._times_s is None or len(self._times_s) < 2:
            gap_s = (
                self._gap_s if self._gap_s is not None else 1 / RATE_BY_FORMAT.get(self.recording.format, DEFAULT_RATE)
            )
            return np.inf if gap_s == 0 else 1 / gap_s
        return 1 / max(float(np.median(np.abs(np.diff(self._times_s)))), 1e-9)

    def read(self, stop: threading.Event) -> Taken | None:
        due = self._wait_for_next(stop)
        if due is None:
            return None
        index, taken_s = due
        begin = time.perf_counter()
        try:
            frame = self.recording.frame(index) if self._read is None else self._read(self.recording.keys[index])
        except FrameError as error:
            self._broken_in_a_row += 1
            if self._broken_in_a_row >= len(self.recording):
                count = len(self.recording)
                raise RecordingError(
                    f"{self.recording.path}: none of its frames can be read ({count} tried): {error}"
                ) from error
            raise
        self._broken_in_a_row = 0
        return Taken(frame, taken_s, time.perf_counter() - begin)

    def resume(self) -> None:
        """Makes the next frame due now."""
        self._due_s = None

    def close(self) -> None:
        """Does nothing: a recording has no open files."""

    def _wait_for_next(self, stop: threading.Event) -> tuple[int, float] | None:
        """Waits until the next frame is due; returns its index and due time. Skips frames that are too late.

        Returns None at the end, or when `stop` is set.
        """
        while self._next is not None:
            now = time.perf_counter()
            # at full speed no frame is late
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
        """Returns the time between two successively played frames, seconds."""
        if self._gap_s is not None:
            return self._gap_s
        if self._times_s is None or abs(following - index) != 1:  # from the last one to the first
            return 1 / self.rate
        return min(abs(self._times_s[following] - self._times_s[index]), MAX_GAP_S)


KINECT = "kinect"


def open_source(
    project: Project, name: str, *, rate: float | None = None, loop: bool = False, to_record: bool = False
) -> Source:
    """Opens a device or a recording. A recording of the project is read as the project reads it.

    Args:
        name: `kinect`, `kinect:` with a serial number or device index, the path of a recording, or the name of one of
            the project.
        rate: as for `Playback`.
        to_record: refuse a recording that cannot be recorded again.
    """
    kind, _, which = name.partition(":")
    if kind == KINECT and not Path(name).exists():
        if rate is not None or loop:
            raise ConfigError(f"{name}: a device has its own rate and no end; --rate and --loop are for recordings")
        return KinectSource(which or None)
    opened = _opened(project, Path(name), name)
    if to_record:
        require_recordable(opened.recording)
    order = itertools.cycle(range(len(opened.recording))) if loop else None
    return Playback(opened.recording, rate=rate, order=order, read=opened.read)


def _opened(project: Project, path: Path, name: str) -> OpenedRecording:
    """The recording with the options, the up direction and the correction that the project has for it."""
    if path.exists():
        known = project.recordings.at(path.resolve())
    else:
        known = tuple(each for each in project.recordings.all() if each.name == name)
    stored = next((each for each in known if len(known) == 1 or not each.options), None)
    if stored is not None:
        return open_stored(stored, project.path.name)
    if known:
        names = ", ".join(each.name for each in known)
        raise ConfigError(f"{name}: the project has several recordings of it; give the name of one: {names}")
    return OpenedRecording(open_recording(path), None)
