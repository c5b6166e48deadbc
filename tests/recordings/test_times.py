"""Which image belongs to a cloud when the clocks of images and clouds differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from annotator.recordings.frame_times import Clock
from annotator.types import Frame


class Timed:
    """A recording of which only the times matter."""

    path = root = Path("timed")
    format, name, notes, is_sequence = "rgbd_folder", "timed", (), True

    def __init__(self, times_ns: list[int | None]) -> None:
        self.times_ns = tuple(times_ns)
        self.keys = tuple(map(str, range(len(times_ns))))
        self.asked = 0

    def __len__(self) -> int:
        return len(self.keys)

    def frame(self, i: int) -> Frame:
        raise NotImplementedError


times = st.none() | st.integers(0, 5_000_000_000)


@given(st.lists(times, min_size=1, max_size=12), st.integers(-4_000, 4_000))
@example([0, 1_000_000_000, 1_000_000_000], 1000)
@example([3_000_000_000, 0, 1_000_000_000], -2000)
@example([None, 5], 1)
def test_the_nearest_image_in_time_is_taken(times_ns: list[int | None], offset_ms: int) -> None:
    clock = Clock(Timed(times_ns))
    for index, time_ns in enumerate(times_ns):
        shown = clock.image_at(index, offset_ms / 1e3)
        if time_ns is None:
            assert shown == index
            continue
        apart = [np.inf if t is None else abs(t - (time_ns - offset_ms * 1_000_000)) for t in times_ns]
        assert apart[shown] == min(apart)
        assert shown == index or apart[index] > min(apart), "the frame's own image, where no other is nearer"
