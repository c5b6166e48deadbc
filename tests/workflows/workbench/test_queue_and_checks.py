"""The review queue, checks of labels and attributes; what a server keeps: detectors, opened frames, results."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from live_server import wait_until
from scipy.spatial.transform import Rotation

from annotator.image_bytes import decode_image
from annotator.project import NewLabel, Project, StoredFrame, WriteContext, create_project
from annotator.project.changes import LabelChanged, TracksLinked
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.recordings.rgbd_folder import RgbdFolder
from annotator.types import Box2D, BoxKind, DetectorKind, Frame, OrientedBox, Proposal, PseudoView, Quality, Source
from annotator.types.errors import DetectionError, FrameError
from annotator.workflows.checking.project_labels import Kind, WarningRow, check_project
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.workbench import loaded_detectors as detectors_ready
from annotator.workflows.workbench.frame_cache import FrameCache, Memo, OpenFrame
from annotator.workflows.workbench.loaded_detectors import ReadyDetectors
from annotator.workflows.workbench.review_queue import Order, Queue, doubt, queue


def box_at(x: float, yaw_rad: float = 0.0, size: Sequence[float] = (0.8, 0.5, 1.7)) -> OrientedBox:
    rotation = Rotation.from_rotvec([0, 0, yaw_rad]).as_matrix()
    return OrientedBox.from_parts(np.array([x, 0.0, 3.0]), rotation, np.array(size, np.float64))


def proposed(x: float, score: float, label: str = "person") -> Proposal:
    return Proposal(label, score, box_at(x), Box2D(label, 0.0, 0.0, 9.0, 9.0), (), Quality(0.0, 1.0, 0.0, 1.0))


def propose(project: Project, frame: StoredFrame, *proposals: Proposal) -> None:
    context = WriteContext(project.frames.get(frame.id).revision, "rcv", Source.AUTO)
    project.proposals.replace(frame.id, proposals, context)


@pytest.mark.parametrize(
    ("quality", "score", "low", "high"),
    [
        (None, 0.3, 0.489, 0.491),
        (None, None, None, None),
        (Quality(0.5, 1.0, 0.0), 1.0, 0.69, 0.71),
        (Quality(0.0, 0.2, 0.9, 0.1), 0.0, 0.97, 1.0),
        (Quality(float("nan"), 1.0, float("nan"), None), 0.5, 0.3, 0.4),
        (Quality(0.0, 1.0, 0.0, 1.0, 0.9), 1.0, 0.69, 0.71),
    ],
)
def test_doubt_is_computed_from_quality_and_score(
    quality: Quality | None, score: float | None, low: float | None, high: float | None
) -> None:
    found = doubt(quality, score)
    if low is None or high is None:
        assert found is None
    else:
        assert found is not None and low <= found <= high


def test_proposals_are_in_the_selected_order(people: Project) -> None:
    people.configure(classes=["person", "dog"])
    frames = people.frames.of()
    propose(people, frames[0], proposed(0, 0.9), proposed(3, 0.2, "dog"))
    propose(people, frames[1], proposed(0, 0.5))
    propose(people, frames[2], proposed(0, 0.1))
    people.frames.finalise(frames[2].id, WriteContext(1, "ann"))

    def shown(order: Order, **options: object) -> list[tuple[int, str | None]]:
        return [(item.frame.index or 0, item.label) for item in queue(people, order, **options).items]  # type: ignore[arg-type]

    assert shown(Order.WORST) == [(0, "dog"), (1, "person"), (0, "person")]
    assert shown(Order.TIME) == [(0, "person"), (0, "dog"), (1, "person")]
    assert shown(Order.CLASS) == [(0, "dog"), (1, "person"), (0, "person")]
    assert shown(Order.TRACK) == shown(Order.TIME), "boxes without a track come frame by frame"
    late = people.labels.of_frame(people.frames.of()[1].id)[0]
    edit = TracksLinked(labels=(LabelChanged(uid=late.uid, track_id=4),))
    people.log.append(
        people.frames.of()[1].id, [edit], WriteContext(people.frames.of()[1].revision, "tracks", Source.AUTO)
    )
    assert shown(Order.TRACK) == [(1, "person"), (0, "person"), (0, "dog")]
    assert shown(Order.WORST, label="person") == [(1, "person"), (0, "person")]
    for uid in [item.uid for item in queue(people, Order.WORST).items]:
        assert uid is not None
        frame = people.labels.get(uid).frame_id
        people.labels.accept(frame, uid, WriteContext(people.frames.get(frame).revision, "ann"))
    assert queue(people, Order.WORST) == Queue((), 0)


def test_the_queue_is_sorted_by_the_doubt_that_a_frame_shows(people: Project) -> None:
    frame, rng = people.frames.of()[0], np.random.default_rng(0)
    for number in range(12):
        values = [float("nan") if rng.random() < 0.2 else float(x) for x in rng.uniform(-0.2, 1.2, 3)]
        known = [None if rng.random() < 0.2 else float(x) for x in rng.uniform(0.0, 1.0, 2)]
        found = replace(proposed(3.0 * number, float(rng.random())), quality=Quality(*values, *known))
        propose(people, people.frames.of()[number % 5], found)
    items = queue(people, Order.WORST).items
    shown = {item.uid: item.doubt for item in items}
    assert len(shown) == 5 and frame.id in {item.frame.id for item in items}
    for stored in people.labels.select():
        assert shown[stored.label.uid] == pytest.approx(doubt(stored.quality, stored.label.score), abs=1e-12)
    assert [item.doubt for item in items] == sorted(shown.values(), reverse=True)
    assert queue(people, Order.WORST, most=2) == Queue(items[:2], 5)
    assert len(queue(people, Order.TEACH, most=1).items) == 1


def test_the_most_informative_frames_come_first(people: Project) -> None:
    frames = people.frames.of()

    def shown() -> list[int]:
        return [item.frame.index or 0 for item in queue(people, Order.TEACH).items]

    assert shown()[0] == 0, "the first frame comes first"
    assert shown()[1] == 4, "then the most different frame"
    assert sorted(shown()) == [0, 1, 2, 3, 4]
    people.boxes.set_on_image(frames[0].id, [], BoxKind.SILHOUETTE, WriteContext(0, "ann"))
    assert shown()[0] == 4
    propose(people, frames[1], proposed(0, 0.95))
    propose(people, frames[2], proposed(0, 0.05))
    assert shown()[0] == 2, "the most doubtful frame"
    assert shown()[-1] == 1, "the least doubtful frame"
    assert all(item.uid is None for item in queue(people, Order.TEACH).items)


def label(box: OrientedBox, name: str = "person", track: int | None = None) -> NewLabel:
    return NewLabel(name, box, track_id=track)


def warned(project: Project, frame: int | None = None) -> list[tuple[Kind, int]]:
    return [(each.kind, int(each.key)) for each in warnings_of(project) if frame in (None, each.frame)]


def warnings_of(project: Project) -> tuple[WarningRow, ...]:
    """Those that need no points."""
    return check_project(project, budget_s=0.0).warnings


def test_unusual_sizes_are_found(people: Project) -> None:
    first, second = people.frames.of()[:2]
    people.labels.create(first.id, [label(box_at(3.0 * n)) for n in range(5)], WriteContext(0, "ann"))
    assert warned(people) == []
    turned = box_at(0.0, size=(0.5, 0.8, 1.7))
    people.labels.create(second.id, [label(turned), label(box_at(9.0, size=(1.8, 0.5, 1.7)))], WriteContext(0, "ann"))
    assert warned(people) == [(Kind.SIZE, 1)]
    (message,) = [warning.message for warning in warnings_of(people)]
    assert message == "person of 1.80 x 0.50 x 1.70 m (length x width x height); the median is 0.80 x 0.50 x 1.70 m"


def test_unusual_sizes_and_other_classes_in_a_track_are_found(people: Project) -> None:
    people.configure(classes=["person", "dog"])
    frames = people.frames.of()
    for number, frame in enumerate(frames):
        # sizes vary within the class, but not within a track
        size = (1.2, 0.5, 1.7) if number == 4 else (0.8, 0.5, 1.7)
        others = [label(box_at(9.0 + n, size=(0.6 + 0.2 * n, 0.5, 1.7)), track=10 + n) for n in (0, 4)]
        people.labels.create(frame.id, [label(box_at(0.0, size=size), track=1), *others], WriteContext(0, "ann"))
    assert warned(people) == [(Kind.SIZE, 4)]
    (message,) = [warning.message for warning in warnings_of(people)]
    sizes = "1.20 x 0.50 x 1.70 m (length x width x height); the median is 0.80 x 0.50 x 1.70 m"
    assert message == f"track 1: person of {sizes}"
    (changed,) = [each for each in people.labels.of_frame(frames[2].id) if each.track_id == 10]
    context = WriteContext(people.frames.get(frames[2].id).revision, "ann")
    people.labels.edit(frames[2].id, changed.uid, context, label="dog", box=changed.box, track_id=10)
    reported = [(w.kind, w.message) for w in warnings_of(people) if w.frame == frames[2].id]
    assert reported == [
        (Kind.TRACK, "track 10 is mostly person, but dog here"),
    ]


def test_heading_jumps_in_sequences_are_found(people: Project) -> None:
    frames = people.frames.of()
    people.labels.create(frames[0].id, [label(box_at(0.0), track=1), label(box_at(5.0))], WriteContext(0, "ann"))
    near, far = label(box_at(5.1, np.pi)), label(box_at(0.1, 0.5), track=1)
    people.labels.create(frames[1].id, [near, far], WriteContext(0, "ann"))
    assert warned(people) == [(Kind.HEADING, 1)]
    # another track at the same position is another object
    people.labels.create(frames[2].id, [label(box_at(0.1, 2.5), track=2)], WriteContext(0, "ann"))
    assert warned(people, frames[2].id) == []
    # two frames later, track 1 may have turned by 120 degrees; that is what the page marks, too
    for frame, angle, expected in ((frames[3], 2.7, [(Kind.HEADING, 3)]), (frames[4], 1.7, [])):
        people.labels.create(frame.id, [label(box_at(0.1, angle), track=1)], WriteContext(0, "ann"))
        assert warned(people, frame.id) == expected
    compared = [people.labels.beside(people.frames.get(frames[n].id)) for n in (0, 1, 3, 4)]
    headings = [np.arctan2(boxes[1].rotation[1, 0], boxes[1].rotation[0, 0]) for boxes in compared]
    np.testing.assert_allclose(headings, [0.5, 0.0, 0.5, 2.7], atol=1e-9)  # of the frame before; of the first, after it


def test_duplicates_are_found(people: Project) -> None:
    people.configure(classes=["person", "dog"])
    frame = people.frames.of()[0]
    boxes = [label(box_at(0.0)), label(box_at(0.1)), label(box_at(0.0), "dog"), label(box_at(0.7))]
    people.labels.create(frame.id, boxes, WriteContext(0, "ann"))
    assert warned(people) == [(Kind.DUPLICATE, 0)]


def test_empty_boxes_and_unreadable_frames_are_found_in_the_recording(people: Project) -> None:
    import_own_labels(people, 1)
    frame = people.frames.of()[1]
    nothing = OrientedBox.from_parts(np.array([0.0, -40.0, 3.0]), np.eye(3), np.array([0.7, 0.5, 1.7]))
    people.labels.create(frame.id, [label(nothing)], WriteContext(frame.revision, "ann"))
    people.recordings.rescan(1, [*(each.key for each in people.frames.of()), "gone"])
    gone = people.frames.find(1, "gone")
    people.labels.create(gone.id, [label(box_at(0.0))], WriteContext(0, "ann"))
    report = check_project(people)
    assert [(row.kind, row.key) for row in report.warnings if row.kind is Kind.EMPTY] == [(Kind.EMPTY, frame.key)]
    assert report.labels == 17
    assert [line.partition(":")[0] for line in report.unreadable] == ["gone"]


def put(project: Project, attribute: Attribute) -> None:
    project.change_classes(edit.PutAttribute(attribute=attribute), "ann")


def found(project: Project) -> list[tuple[str, str]]:
    return [(warning.key, warning.message) for warning in warnings_of(project) if warning.kind is Kind.ATTRIBUTE]


def change_attribute(project: Project, name: str, /, **changed: object) -> None:
    (attribute,) = (each for each in project.config.attributes if each.name == name)
    put(project, attribute.model_copy(update=changed))


def test_missing_and_contradicting_values_are_reported(tmp_path: Path) -> None:
    box = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.ones(3))
    with create_project(tmp_path, "p", ["car"]) as project:
        project.recordings.add(tmp_path / "r", "rgbd", "r", ["a", "b", "c"], True)
        a, b, c = (frame.id for frame in project.frames.of())
        for frame in (a, b, c):
            project.labels.create(frame, [NewLabel("car", box, track_id=1)], WriteContext(0, "ann"))
        assert found(project) == []
        put(project, Attribute(name="colour", kind=AttributeKind.TEXT, of=AttributeOf.TRACK))
        put(project, Attribute(name="doors", kind=AttributeKind.INTEGER, required=True))
        put(project, Attribute(name="rain", kind=AttributeKind.BOOLEAN, of=AttributeOf.FRAME, required=True))
        uids = [project.labels.of_frame(frame)[0].uid for frame in (a, b, c)]
        missing = "this car has no value of doors, which is required"
        no_rain = "this frame has no value of rain, which is required"
        assert found(project) == [(key, line) for key in "abc" for line in (missing, no_rain)]
        for frame, uid in zip((a, b, c), uids, strict=True):
            project.labels.set_attributes(frame, uid, {"doors": 5}, WriteContext(1, "ann"))
            project.frames.set_attributes(frame, {"rain": True}, WriteContext(2, "ann"))
        project.labels.set_attributes(a, uids[0], {"colour": "red"}, WriteContext(3, "ann"))
        assert found(project) == []
        # one label of the track has another value, since it was in another track before
        project.labels.edit(c, uids[2], WriteContext(4, "ann"), label="car", box=box)
        project.labels.set_attributes(c, uids[2], {"colour": "blue"}, WriteContext(5, "ann"))
        put(project, Attribute(name="wheels", kind=AttributeKind.INTEGER, required=True))
        with project.store.write() as connection:
            connection.exec_driver_sql("UPDATE labels SET track_id = 1")
        lines = [line for key, line in found(project) if key == "c"]
        assert lines == [
            "this car has no value of wheels, which is required",
            "colour of track 1 is mostly red, but blue here",
        ]
        assert project.statistics().attributes == {
            "colour": {"red": 2, "blue": 1},
            "doors": {"5": 3},
            "rain": {"true": 3},
            "wheels": {},
        }


def test_a_finalised_frame_without_boxes_needs_its_required_values(tmp_path: Path) -> None:
    with create_project(tmp_path, "p", ["car"]) as project:
        project.recordings.add(tmp_path / "r", "rgbd", "r", ["a", "b", "c"], True)
        put(project, Attribute(name="rain", kind=AttributeKind.BOOLEAN, of=AttributeOf.FRAME, required=True))
        a, b, _ = (frame.id for frame in project.frames.of())
        assert found(project) == []
        project.frames.set_attributes(a, {"rain": False}, WriteContext(0, "ann"))
        project.frames.finalise(a, WriteContext(1, "ann"))
        project.frames.finalise(b, WriteContext(0, "ann"))
        (warning,) = check_project(project).warnings
        assert (warning.number, warning.key, warning.uid) == (2, "b", None)
        assert warning.message == "this frame has no value of rain, which is required"
        # a frame that its recording no longer has cannot be completed
        project.recordings.rescan(1, ["a", "c"])
        assert found(project) == []
        project.recordings.rescan(1, ["a", "b", "c"])
        change_attribute(project, "rain", default=True)
        assert found(project) == []


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
    with monkeypatch.context() as patched:
        patched.setattr(cache._executor, "submit", lambda *_: pytest.fail("nobody has opened it"))
        assert cache.open(people, ids[3], None).frame.key == "000003"
    cache.close()
    assert cache.read(people, ids[4]).key == "000004", "after the end frames are still read, but not ahead"
    small = FrameCache(1, kept_bytes=5 * OpenFrame(found[0]).memory_bytes // 2)
    small.close()
    reads.clear()
    for index in (0, 1, 0, 1, 2, 0):
        small.read(people, ids[index])
    assert reads == ["000000", "000001", "000002", "000000"]


def test_small_pictures_need_no_points(people: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    cache, ids = FrameCache(), [stored.id for stored in people.frames.of()]
    of_whole = np.asarray(cache.read(people, ids[0]).rgb)
    cache.close()
    cache = FrameCache()
    monkeypatch.setattr(RgbdFolder, "frame", lambda *_: pytest.fail("a whole frame was read"))
    small = decode_image(cache.small(people, ids[0], 640), cv2.IMREAD_COLOR)
    assert small.shape == of_whole.shape
    assert np.abs(small[..., ::-1].astype(int) - of_whole).mean() < 10, "as a JPEG"
    cache.close()


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
