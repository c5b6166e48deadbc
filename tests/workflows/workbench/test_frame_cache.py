"""Opened frames: readers are used as they allow, and what is kept of a frame shows what has changed since."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from live_server import wait_until

from annotator.project import Project, StoredFrame
from annotator.recordings.rgbd_folder import RgbdFolder
from annotator.types import Frame
from annotator.types.errors import FrameError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.workbench.frame_cache import FrameCache, Memo, OpenFrame


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
