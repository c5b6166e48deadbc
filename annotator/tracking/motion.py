"""Frame times, and prediction of an object's position with constant velocity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from annotator.types import OrientedBox


def frame_times(times_ns: Sequence[int | None]) -> Float64[np.ndarray, "n"]:
    """The times of a recording's frames in units of the median interval between frames, from 0.

    Args:
        times_ns: in order. If one is unknown, or they do not increase, equal intervals are assumed.
    """
    count = np.arange(len(times_ns), dtype=np.float64)
    if len(times_ns) < 2 or any(time is None for time in times_ns):
        return count
    first = times_ns[0]
    # differences first, since float64 cannot represent nanoseconds since the epoch
    passed = np.array([float(time - first) for time in times_ns if time is not None and first is not None])
    steps = np.diff(passed)
    return count if (steps <= 0).any() else passed / np.median(steps)


def predicted(boxes: Sequence[OrientedBox], times: Sequence[float], time: float) -> OrientedBox:
    """An object's last box, moved to its predicted position at `time`.

    Args:
        boxes: one or more boxes of the object, in order of time; a line is fitted to their centres.
        times: times of the boxes.
        time: time of the prediction.
    """
    last = boxes[-1]
    passed = np.asarray(times) - np.mean(times)
    if not passed.any():
        return last
    centers = np.array([box.center_m for box in boxes])
    velocity = passed @ (centers - centers.mean(axis=0)) / (passed @ passed)
    center = last.center_m + velocity * (time - times[-1])
    return OrientedBox.from_parts(center, last.rotation, last.size_m)
