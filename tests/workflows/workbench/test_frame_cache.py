"""Opened frames: readers are used as they allow, and what is kept of a frame shows what has changed since."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from annotator.project import NewLabel, Project, WriteContext
from annotator.recordings.rgbd_folder import RgbdFolder
from annotator.types import Box2D, BoxKind, Frame, OrientedBox
from annotator.types.errors import FrameError, NotFoundError
from annotator.workflows.workbench.frame_cache import FrameCache
from annotator.workflows.workbench.frame_state import show_frame


def test_a_reader_that_threads_cannot_share_reads_one_frame_at_a_time(
    people: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    reading, frame = threading.Lock(), RgbdFolder.frame

    def alone(self: RgbdFolder, i: int) -> Frame:
        assert reading.acquire(blocking=False)
        time.sleep(0.02)
        reading.release()
        return frame(self, i)

    cache = FrameCache()
    monkeypatch.setattr(RgbdFolder, "is_parallel", False)
    monkeypatch.setattr(RgbdFolder, "frame", alone)
    stored = people.frames.of()
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda each: cache.look(people, each), stored))
    assert [each.key for each in found] == [each.key for each in stored]
    cache.close()


def test_a_kept_frame_shows_what_has_changed_since(people: Project) -> None:
    cache, frame = FrameCache(), people.frames.of()[0].id
    opened = cache.open(people, frame)
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.array([0.5, 0.6, 1.7]))
    people.labels.create(frame, [NewLabel("person", box), NewLabel("person", box)], WriteContext(0, "Ada"))
    first = show_frame(people, frame, opened)
    # without an event of the frame
    (recording,) = people.recordings.all()
    people.recordings.rescan(recording.id, ["before", *(stored.key for stored in people.frames.of())])
    moved = show_frame(people, frame, opened)
    assert (moved.page.frame.index, moved.page.previous) == (1, people.frames.find(recording.id, "before").id)
    # with events
    people.boxes.set_on_image(frame, [Box2D("person", 1.0, 2.0, 30.0, 40.0)], BoxKind.BOX, WriteContext(2, "Bob"))
    drawn = show_frame(people, frame, opened)
    assert [item.image_box.xyxy for item in drawn.objects] == [(1.0, 2.0, 30.0, 40.0)]
    people.labels.reject(frame, first.labels[0].stored.label.uid, WriteContext(3, "Bob"))
    assert [each.stored.label.author for each in show_frame(people, frame, opened).labels] == ["Bob", "Ada"]
    cache.close()


def test_an_unreadable_frame_is_an_error_each_time(people: Project) -> None:
    cache = FrameCache()
    people.recordings.rescan(1, ["000000", "gone"])
    for _ in range(2):
        with pytest.raises(FrameError, match="frame gone no longer exists"):
            cache.read(people, people.frames.find(1, "gone").id)
    with pytest.raises(NotFoundError):
        cache.read(people, 99)
    cache.close()
