"""Opened frames are read once, and the next one is read ahead."""

from __future__ import annotations

import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from live_server import wait_until

from annotator.project import NewLabel, Project, WriteContext
from annotator.project import overview as overview_module
from annotator.recordings import open_recording
from annotator.recordings.rgbd_folder import RgbdFolder
from annotator.types import Box2D, BoxKind, Frame, OrientedBox
from annotator.types.errors import FrameError, NotFoundError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.workbench import frame_cache
from annotator.workflows.workbench.frame_cache import PAUSE_S, FrameCache, OpenFrame
from annotator.workflows.workbench.frame_state import show_frame


@pytest.fixture
def project(people: Project) -> Project:
    return people


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys of the frames that are read from the disk, in order."""
    found: list[str] = []
    read = FrameSource.read

    def counted(self: FrameSource, stored: object) -> Frame:
        found.append(vars(stored)["key"])
        return read(self, stored)  # type: ignore[arg-type]

    monkeypatch.setattr(FrameSource, "read", counted)
    return found


def _wait(reads: list[str], count: int) -> None:
    wait_until(lambda: len(reads) >= count)


def test_a_frame_is_read_once_and_the_next_ahead(project: Project, reads: list[str]) -> None:
    cache = FrameCache()
    first = cache.read(project, 1)
    assert cache.read(project, 1) is first
    _wait(reads, 2)
    assert reads == ["000000", "000001"]
    assert cache.read(project, 2).key == "000001"
    _wait(reads, 3)
    assert reads == ["000000", "000001", "000002"]
    cache.close()
    assert cache.read(project, 5).key == "000004", "after the end frames are still read, but not ahead"


def test_more_frames_are_cached_as_long_as_memory_allows(project: Project, reads: list[str]) -> None:
    size = OpenFrame(FrameSource(project).read(project.frames.get(1))).memory_bytes
    reads.clear()
    cache = FrameCache(1, kept_bytes=2 * size)
    cache.close()
    for frame in (1, 2, 1, 2, 3, 1, 2):
        cache.read(project, frame)
    assert reads == ["000000", "000001", "000002", "000000", "000001"]


def test_a_frame_does_not_wait_for_the_results_of_another(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    slow, fast = (OpenFrame(FrameSource(project).read(project.frames.get(frame))) for frame in (1, 2))
    began, ends, jpeg = threading.Event(), threading.Event(), frame_cache._jpeg

    def held_up(frame: Frame) -> bytes:
        if frame is slow.frame:
            began.set()
            assert ends.wait(30)
        return jpeg(frame)

    monkeypatch.setattr(frame_cache, "_jpeg", held_up)
    with ThreadPoolExecutor(3) as pool:
        first, second = pool.submit(lambda: slow.jpeg), pool.submit(lambda: slow.jpeg)
        assert began.wait(30)
        assert pool.submit(lambda: fast.jpeg).result(30) is fast.jpeg
        ends.set()
        assert first.result(30) is second.result(30), "computed once"


def test_reading_ahead_waits_for_a_pause_and_keeps_no_frame(
    project: Project, reads: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [0.0]
    monkeypatch.setattr(frame_cache, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    cache = FrameCache(3, kept_bytes=0)
    left = weakref.ref(cache.open(project, 1, "Ada"))
    for frame in (2, 3, 4, 5, 2, 3, 4, 5, 2, 3, 4, 5, 2, 3):
        cache.open(project, frame, "Ada")
    assert left() is None, "a frame that was left is released"
    last = len(reads)
    now_s[0] = PAUSE_S
    _wait(reads, last + 1)
    assert reads[last] == "000003", "the one after the last"
    cache.close()


def test_frames_are_read_ahead_for_each_operator(project: Project, reads: list[str]) -> None:
    cache = FrameCache()
    cache.open(project, 1, "Ada")
    cache.open(project, 5, "Bob")
    _wait(reads, 4)
    assert sorted(reads) == ["000000", "000001", "000003", "000004"]
    cache.close()


def test_many_threads_read_a_frame_once(project: Project, reads: list[str]) -> None:
    cache = FrameCache()
    cache.close()
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: cache.read(project, 3), range(8)))
    assert len(set(map(id, found))) == 1
    assert reads == ["000002"]


def test_an_unreadable_frame_is_an_error_each_time(project: Project, reads: list[str]) -> None:
    cache = FrameCache()
    cache.close()
    project.recordings.rescan(1, ["000000", "gone"])
    gone = project.frames.find(1, "gone").id
    for _ in range(2):
        with pytest.raises(FrameError, match="frame gone no longer exists"):
            cache.read(project, gone)
    with pytest.raises(NotFoundError):
        cache.read(project, 99)


@pytest.mark.parametrize("is_parallel", [True, False])
def test_frames_that_are_only_looked_at_are_read_side_by_side_where_the_reader_can(
    project: Project, monkeypatch: pytest.MonkeyPatch, is_parallel: bool
) -> None:
    both = threading.Barrier(2)
    met: list[bool] = []
    frame = RgbdFolder.frame

    def together(self: RgbdFolder, i: int) -> Frame:
        with suppress(threading.BrokenBarrierError):
            both.wait(30 if is_parallel else 0.05)
        met.append(not both.broken)
        return frame(self, i)

    cache = FrameCache()
    monkeypatch.setattr(RgbdFolder, "is_parallel", is_parallel)
    monkeypatch.setattr(RgbdFolder, "frame", together)
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(lambda stored: cache.look(project, stored), project.frames.of()[:2]))
    assert [each.key for each in found] == ["000000", "000001"]
    assert met == [is_parallel] * 2
    cache.close()


def test_labels_without_new_events_are_not_read_again(
    project: Project, generated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = OpenFrame(open_recording(generated / "people").frame(0))
    frame = project.frames.of()[0].id
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.array([0.5, 0.6, 1.7]))
    project.labels.create(frame, [NewLabel("person", box), NewLabel("person", box)], WriteContext(0, "Ada"))
    reads = Mock(side_effect=overview_module.stored_label)
    monkeypatch.setattr(overview_module, "stored_label", reads)
    first = show_frame(project, frame, opened)
    again = show_frame(project, frame, opened)
    assert reads.call_count == 2 and again.labels is first.labels

    # without an event of the frame, its index and neighbours have changed
    (recording,) = project.recordings.all()
    keys = [stored.key for stored in project.frames.of()]
    project.recordings.rescan(recording.id, ["before", *keys])
    moved = show_frame(project, frame, opened)
    assert (moved.page.frame.index, moved.page.previous) == (1, project.frames.find(recording.id, "before").id)
    assert reads.call_count == 2 and moved.labels is first.labels

    # any event of the frame
    project.boxes.set_on_image(frame, [Box2D("person", 1.0, 2.0, 30.0, 40.0)], BoxKind.BOX, WriteContext(2, "Bob"))
    drawn = show_frame(project, frame, opened)
    assert [item.image_box.xyxy for item in drawn.objects] == [(1.0, 2.0, 30.0, 40.0)]
    project.labels.reject(frame, first.labels[0].stored.label.uid, WriteContext(3, "Bob"))
    rejected = show_frame(project, frame, opened)
    assert rejected.labels[0].stored.label.author == "Bob"
    # what the other label shows is not computed again
    assert rejected.labels[1] is drawn.labels[1] is first.labels[1]
