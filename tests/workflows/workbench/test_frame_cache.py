"""Opened frames: readers are used as they allow, and what is kept of a frame shows what has changed since."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from live_server import wait_until

from annotator.project import NewLabel, Project, StoredFrame, WriteContext
from annotator.recordings.rgbd_folder import RgbdFolder
from annotator.types import Box2D, BoxKind, Frame, OrientedBox
from annotator.types.errors import FrameError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.workbench.frame_cache import FrameCache, Memo, OpenFrame
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


def test_a_frame_is_read_once_the_next_ahead_and_as_many_kept_as_memory_allows(
    people: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads, read, ids = list[str](), FrameSource.read, [stored.id for stored in people.frames.of()]

    def counted(self: FrameSource, stored: StoredFrame) -> Frame:
        reads.append(stored.key)
        return read(self, stored)

    monkeypatch.setattr(FrameSource, "read", counted)
    cache = FrameCache()
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda _: cache.read(people, ids[0]), range(8)))
    assert len(set(map(id, found))) == 1
    wait_until(lambda: len(reads) == 2)
    assert reads == ["000000", "000001"]
    cache.close()
    assert cache.read(people, ids[4]).key == "000004", "after the end frames are still read, but not ahead"
    small = FrameCache(1, kept_bytes=5 * OpenFrame(found[0]).memory_bytes // 2)
    small.close()
    reads.clear()
    for index in (0, 1, 0, 1, 2, 0):
        small.read(people, ids[index])
    assert reads == ["000000", "000001", "000002", "000000"]


def test_a_result_is_computed_once_and_again_after_an_error() -> None:
    memo, began, ends, computed = Memo(2), threading.Event(), threading.Event(), list[str]()

    def slow() -> str:
        began.set()
        assert ends.wait(30)
        computed.append("slow")
        if len(computed) == 1:
            raise FrameError(Path("a.png"), "cannot be read")
        return "slow"

    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(memo.get, "a", slow)
        assert began.wait(30)
        second = threads.submit(memo.get, "a", slow)
        assert memo.get("b", lambda: "fast") == "fast", "waits for no other result"
        ends.set()
        with pytest.raises(FrameError):
            first.result(30)
        assert second.result(30) == memo.get("a", slow) == "slow"
    assert len(computed) == 2
    memo.get("c", lambda: "c")
    assert [memo.get(key, lambda: "new") for key in "acb"] == ["slow", "c", "new"], "the latest are kept"
