"""The times of a recording's frames, without reading the frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from annotator.project import StoredFrame
from annotator.recordings import Recording
from annotator.recordings.kitti.folder import KittiFolder
from annotator.tracking.motion import frame_times


@runtime_checkable
class Timed(Protocol):
    """A recording with a time for each frame."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The frames' names."""

    @property
    def times_ns(self) -> tuple[int | None, ...] | None:
        """The time of each frame, nanoseconds on an arbitrary clock; None if not recorded."""


def times_of(recording: Recording, frames: Sequence[StoredFrame]) -> Float64[np.ndarray, "n"]:
    """Returns the times of some frames of a recording in units of the frame interval (`frame_times`), so that dropped
    frames are gaps. Without recorded times, these are the frames' indices.

    Args:
        frames: in the order of the recording.

    Raises:
        FrameError: the recording's times are broken.
    """
    times_ns = _times_ns(recording, frames)
    if times_ns is None:
        return np.array([float(frame.index or 0) for frame in frames])
    return frame_times(times_ns)


def _times_ns(recording: Recording, frames: Sequence[StoredFrame]) -> list[int | None] | None:
    if isinstance(recording, KittiFolder) and all(frame.key.isascii() and frame.key.isdigit() for frame in frames):
        return [recording.time_ns(int(frame.key)) for frame in frames]
    if isinstance(recording, Timed) and recording.times_ns is not None:
        known = dict(zip(recording.keys, recording.times_ns, strict=True))
        return [known.get(frame.key) for frame in frames]
    return None
