"""Times of frames, and where an object will be: constant velocity over its last boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from annotator.types import OrientedBox


def frame_times(times_ns: Sequence[int | None]) -> Float64[np.ndarray, "n"]:
    """The times of a recording's frames, in frames: 1 is the median time from one to the next.

    Args:
        times_ns: in order; where one is not known, or they do not grow, all frames count as equally far apart.
    """
    count = np.arange(len(times_ns), dtype=np.float64)
    if len(times_ns) < 2 or any(time is None for time in times_ns):
        return count
    first = times_ns[0]
    # differences first: nanoseconds since the epoch do not fit a float
    passed = np.array([float(time - first) for time in times_ns if time is not None and first is not None])
    steps = np.diff(passed)
    return count if (steps <= 0).any() else passed / np.median(steps)


def predicted(boxes: Sequence[OrientedBox], times: Sequence[float], time: float) -> OrientedBox:
    """The last of an object's boxes, moved to where it will be at `time`.

    Args:
        boxes: one or more of the object, in the order of time; the motion is the straight one nearest to all of them.
        times: of the boxes.
    """
    last = boxes[-1]
    passed = np.asarray(times) - np.mean(times)
    if not passed.any():
        return last
    centers = np.array([box.center_m for box in boxes])
    velocity = passed @ (centers - centers.mean(axis=0)) / (passed @ passed)
    center = last.center_m + velocity * (time - times[-1])
    return OrientedBox.from_parts(center, last.rotation, last.size_m)
