"""The times of a recording's frames, without reading the frames."""

from __future__ import annotations

from bisect import bisect_left
from typing import Protocol, runtime_checkable

from annotator.recordings.kitti import KittiFolder
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


class Clock:
    """The times of a recording's frames, in order, to find images in."""

    def __init__(self, recording: Recording) -> None:
        times = recorded_times(recording) if recording.is_sequence else None
        self._times = None if times is None else tuple(times.values())
        self._ordered = sorted((time, i) for i, time in enumerate(self._times or ()) if time is not None)

    def image_at(self, index: int, offset_s: float) -> int:
        """Index of the frame whose image belongs to the cloud of frame `index`, with the clouds' clock ahead.

        It is the frame itself without a time for it, or where no other image is nearer in time.

        Args:
            offset_s: how far the clouds' clock is ahead.
        """
        time_ns = None if self._times is None else self._times[index]
        if time_ns is None:
            return index
        wanted = time_ns - round(offset_s * 1e9)
        place = bisect_left(self._ordered, (wanted, 0))
        near = self._ordered[max(place - 1, 0) : place + 1]
        apart, nearest = min((abs(time - wanted), i) for time, i in near)
        return index if abs(time_ns - wanted) <= apart else nearest
