"""The times of a recording's frames, without reading the frames."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from annotator.recordings.kitti.folder import KittiFolder
from annotator.recordings.recording import Recording


@runtime_checkable
class Timed(Protocol):
    """A recording with a time for each frame."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The frames' names."""

    @property
    def times_ns(self) -> tuple[int | None, ...] | None:
        """The time of each frame, nanoseconds on an arbitrary clock; None if not recorded."""


def recorded_times(recording: Recording) -> dict[str, int | None] | None:
    """The time of each frame by its key, nanoseconds on an arbitrary clock; None if the recording has no times."""
    if isinstance(recording, KittiFolder) and all(key.isascii() and key.isdigit() for key in recording.keys):
        return {key: recording.time_ns(int(key)) for key in recording.keys}
    if isinstance(recording, Timed) and recording.times_ns is not None:
        return dict(zip(recording.keys, recording.times_ns, strict=True))
    return None


def has_times(recording: Recording) -> bool:
    """True if the recording is a sequence with at least two times, so that images and clouds may be apart in time."""
    times = recorded_times(recording) if recording.is_sequence else None
    return times is not None and sum(time is not None for time in times.values()) > 1


def image_at(recording: Recording, index: int, offset_s: float) -> int:
    """Index of the frame whose image belongs to the cloud of frame `index`, with the clouds' clock ahead by `offset_s`.

    It is the frame itself without a time for it, or where no other image is nearer in time.
    """
    times = recorded_times(recording) if recording.is_sequence else None
    time_ns = None if times is None else times[recording.keys[index]]
    if times is None or time_ns is None:
        return index
    apart = [np.inf if time is None else abs(time - time_ns + offset_s * 1e9) for time in times.values()]
    nearest = int(np.argmin(apart))
    return index if apart[index] <= apart[nearest] else nearest
