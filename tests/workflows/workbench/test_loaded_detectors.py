"""What a server keeps: detectors that are loaded once, opened frames, results."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from live_server import wait_until

from annotator.project import Project, StoredFrame
from annotator.recordings.rgbd_folder import RgbdFolder
from annotator.types import BoxKind, DetectorKind, Frame, PseudoView
from annotator.types.errors import DetectionError, FrameError
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.workbench import loaded_detectors as detectors_ready
from annotator.workflows.workbench.frame_cache import FrameCache, Memo, OpenFrame
from annotator.workflows.workbench.loaded_detectors import ReadyDetectors


def register(project: Project, role: DetectorKind, fingerprint: str) -> None:
    weights = project.path / "models" / f"{fingerprint}.pt"
    weights.parent.mkdir(exist_ok=True)
    weights.write_bytes(b"w")
    project.models.register(role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=fingerprint)


class Blank:
    """A detector that counts how many calls run at once."""

    labels = ("person",)
    fingerprint = "blank"

    def __init__(self) -> None:
        self.running = self.most = 0

    def detect(self, images: Sequence[object]) -> list[list[object]]:
        self.running += 1
        self.most = max(self.most, self.running)
        time.sleep(0.01)
        self.running -= 1
        return [[] for _ in images]


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    found: list[Path] = []

    def load(weights: Path, names: object = ()) -> Blank:
        found.append(weights)
        if weights.name.startswith("bad"):
            raise DetectionError("no weights")
        return Blank()

    monkeypatch.setattr(detectors_ready, "load_detector", load)
    return found


def test_a_detector_is_loaded_once_and_again_for_another_model(people: Project, loads: list[Path]) -> None:
    ready = ReadyDetectors()
    assert ready.get(people, DetectorKind.VIEW) is None
    register(people, DetectorKind.VIEW, "a")
    ready.warm(people)
    first = ready.get(people, DetectorKind.VIEW)
    assert first is not None and first.labels == ("person",)
    assert ready.get(people, DetectorKind.VIEW) is first
    register(people, DetectorKind.VIEW, "b")
    second = ready.get(people, DetectorKind.VIEW)
    assert second is not None and second is not first
    assert [path.name for path in loads] == ["a.pt", "b.pt"]
    ready.close()


def test_the_state_of_loading_and_its_problem_are_reported(people: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    go = threading.Event()

    def load(weights: Path, names: object = ()) -> Blank:
        go.wait(240)
        if weights.name.startswith("odd"):
            raise ValueError("secret")
        if weights.name.startswith("bad"):
            raise DetectionError("no weights")
        return Blank()

    monkeypatch.setattr(detectors_ready, "load_detector", load)
    ready = ReadyDetectors()
    assert ready.readiness(people, DetectorKind.VIEW).state == "none"
    register(people, DetectorKind.VIEW, "bad")
    assert ready.readiness(people, DetectorKind.VIEW, wait_s=0.0).state == "loading"
    go.set()
    failed = ready.readiness(people, DetectorKind.VIEW)
    assert (failed.state, failed.detector, failed.problem) == ("failed", None, "no weights")
    register(people, DetectorKind.VIEW, "odd")
    problem = ready.readiness(people, DetectorKind.VIEW).problem
    assert problem is not None and "secret" not in problem and "log" in problem
    register(people, DetectorKind.VIEW, "good")
    assert ready.readiness(people, DetectorKind.VIEW).state == "ready"
    ready.close()


def test_calls_of_a_detector_do_not_run_concurrently(
    people: Project, loads: list[Path], knowing: Callable[..., Detectors]
) -> None:
    register(people, DetectorKind.VIEW, "a")
    ready = ReadyDetectors()
    detector = ready.get(people, DetectorKind.VIEW)
    assert detector is not None
    view = PseudoView(np.zeros((8, 8, 3), np.uint8), np.eye(3), 0.1, np.zeros(2), np.zeros((0, 3), np.float32))
    with ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda _: detector.detect([view]), range(6)))
    assert isinstance(detector.detector, Blank) and detector.detector.most == 1
    ready.close()


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
