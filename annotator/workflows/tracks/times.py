"""The times of some frames of a recording, in units of the frame interval."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from annotator.project import StoredFrame
from annotator.recordings import Recording
from annotator.recordings.frame_times import recorded_times
from annotator.tracking.motion import frame_times


def times_of(recording: Recording, frames: Sequence[StoredFrame]) -> Float64[np.ndarray, "n"]:
    """Returns the times of some frames of a recording in units of the frame interval (`frame_times`), so that dropped
    frames are gaps. Without recorded times, these are the frames' indices.

    Args:
        frames: in the order of the recording.

    Raises:
        FrameError: the recording's times are broken.
    """
    times_ns = recorded_times(recording)
    if times_ns is None:
        return np.array([float(frame.index or 0) for frame in frames])
    return frame_times([times_ns.get(frame.key) for frame in frames])
