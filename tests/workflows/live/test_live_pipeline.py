"""Live: playback of recordings, the concurrent stages, and the image regions in which tracked objects are searched."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from annotator.geometry.iou import box_iou
from annotator.geometry.outline import box_on_image
from annotator.project import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.starts import WarmStart, is_warm
from annotator.recordings import Recording, open_recording
from annotator.types import Box2D, Camera, Frame, Image, OrientedBox, PointCloud, Region
from annotator.types.errors import ConfigError, DeviceError, FrameError, RecordingError
from annotator.workflows.detectors import Detectors
from annotator.workflows.live.detection import (
    MAX_SEED_AGE_S,
    WHOLE_EVERY,
    Detected,
    LiveDetection,
    RegionDetection,
    Taken,
)
from annotator.workflows.live.open_source import Playback
from annotator.workflows.live.pipeline import Meter, Pipeline, Slot, summary_line

NEVER = threading.Event()
# A limit for waits, which only a failure should reach.
PATIENCE_S = 240.0
SHORT = RcvConfig(max_steps=2)


@pytest.fixture(scope="module")
def hands(generated: Path) -> Recording:
    return open_recording(generated / "hands")


@pytest.fixture(scope="module")
def frame(hands: Recording) -> Frame:
    return hands.frame(0)


@dataclass
class FakeRecording:
    """A recording with given times, whose frames are all copies of one."""

    any_frame: Frame
    times_ns: tuple[int | None, ...]
    broken: tuple[int, ...] = ()
    path: Path = Path("told")
    format: str = "rgbd_folder"
    name: str = "told"
    asked: list[int] = field(default_factory=list)

    root = path
    is_sequence = True
    notes = ()

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(map(str, range(len(self))))

    def __len__(self) -> int:
        return len(self.times_ns)

    def frame(self, i: int) -> Frame:
        self.asked.append(i)
        if i in self.broken:
            raise FrameError(self.path, f"frame {i} is broken")
        return replace(self.any_frame, key=str(i), index=i)


def played(playback: Playback, most: int = 100) -> Iterator[Taken]:
    for _ in range(most):
        taken = playback.read(NEVER)
        if taken is None:
            return
        yield taken


def test_playback_keeps_the_recordings_times(frame: Frame) -> None:
    recording = FakeRecording(frame, tuple(int(1e9 + 1e6 * ms) for ms in (0, 30, 130, 190)))
    taken = list(played(Playback(recording)))
    at_s = [each.taken_s - taken[0].taken_s for each in taken]
    assert [each.frame.key for each in taken] == ["0", "1", "2", "3"]
    assert at_s == pytest.approx([0, 0.03, 0.13, 0.19], abs=1e-6)
    assert all(each.read_s >= 0 for each in taken)


def test_the_playback_rate_is_given_or_the_formats_default(frame: Frame) -> None:
    unknown = FakeRecording(frame, (None,) * 3)
    assert Playback(unknown).rate == pytest.approx(30)
    unknown.format = "kitti_raw"
    assert Playback(unknown).rate == pytest.approx(10)
    taken = list(played(Playback(unknown, rate=20.0)))
    assert [b.taken_s - a.taken_s for a, b in itertools.pairwise(taken)] == pytest.approx([0.05, 0.05])
    for rate in (0.0, -1.0, math.nan):
        with pytest.raises(ConfigError, match="cannot play at"):
            Playback(unknown, rate=rate)


def test_a_late_reader_misses_frames_as_with_a_camera(frame: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("annotator.workflows.live.open_source.time", clock)
    playback = Playback(FakeRecording(frame, (None,) * 60), rate=100.0)
    first = playback.read(clock)
    clock.now_s += 0.1
    second = playback.read(clock)
    assert first is not None
    assert second is not None
    missed = second.frame.index - 1
    assert missed >= 8
    assert playback.skipped == missed
    assert second.taken_s - first.taken_s == pytest.approx(0.01 * (missed + 1))
    # after a pause no frames are skipped
    clock.now_s += 0.1
    playback.resume()
    third = playback.read(clock)
    assert third is not None
    assert third.frame.index == second.frame.index + 1


class Clock(threading.Event):
    """Time that passes only during waits; replaces the module `time` and the event that ends a wait."""

    now_s = 0.0

    def perf_counter(self) -> float:
        return self.now_s

    def wait(self, timeout: float | None = None) -> bool:
        self.now_s += timeout or 0.0
        return False


@pytest.mark.parametrize(
    ("order", "expected"),
    [(None, [0, 1, 2]), (cycle(range(3)), [0, 1, 2, 0, 1, 2, 0]), (cycle((0, 1, 2, 1)), [0, 1, 2, 1, 0, 1, 2])],
)
def test_playback_ends_after_the_last_frame_or_goes_on_as_it_is_told(
    frame: Frame, order: Iterable[int] | None, expected: list[int]
) -> None:
    recording = FakeRecording(frame, (None,) * 3)
    assert [taken.frame.index for taken in played(Playback(recording, rate=math.inf, order=order), 7)] == expected


def test_a_stopped_reader_does_not_wait_for_the_next_frame(frame: Frame) -> None:
    an_hour_ns = 3_600_000_000_000
    playback = Playback(FakeRecording(frame, (0, an_hour_ns)))
    stop = threading.Event()
    assert playback.read(stop) is not None
    stop.set()
    assert playback.read(stop) is None


def test_playback_of_an_unreadable_recording_ends_with_an_error(frame: Frame) -> None:
    playback = Playback(FakeRecording(frame, (None,) * 2, broken=(0, 1)), rate=math.inf, order=cycle(range(2)))
    with pytest.raises(FrameError):
        playback.read(NEVER)
    with pytest.raises(RecordingError, match=r"none of its frames can be read \(2 tried\)"):
        playback.read(NEVER)


class FakeDetection:
    """A detection that takes the given time and finds nothing."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds

    def detect(self, taken: Taken) -> Detected:
        time.sleep(self.seconds)
        return Detected(taken.frame, FrameProposals(taken.frame.key, (), ()), taken.taken_s, {"read": taken.read_s})


class Shown(list[str]):
    """A display that records the keys of the shown frames."""

    def __call__(self, detected: Detected) -> None:
        self.append(detected.frame.key)


def run(made: Pipeline) -> None:
    made.start()
    assert made.wait(PATIENCE_S)
    for thread in made._threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def test_all_stages_process_frames_and_end_with_the_source(hands: Recording, knowing: Any) -> None:
    shown: list[Detected] = []
    detectors: Detectors = knowing("hands")
    detection = LiveDetection(detectors, SHORT, BoxRotation.AUTO, warm_start=False)
    made = Pipeline(Playback(hands, rate=2.0), detection.detect, shown.append, max_frames=3)
    ends: list[str] = []
    made.on_end = lambda: ends.append("end")
    run(made)
    figures = made.figures()
    assert (figures.read, figures.detected, figures.shown) == (3, 3, 3)
    assert [len(each.found.proposals) for each in shown] == [2, 2, 2]
    assert list(figures.stages_ms) == ["read", "image", "views", "geometry", "show"]
    assert all(took >= 0 for took in figures.stages_ms.values())
    assert figures.latency_ms is not None
    assert figures.latency_ms > sum(figures.stages_ms.values()) / 2
    assert ends == ["end"]


class QueueingPlayback(Playback):
    """A recording that behaves like a camera whose driver queues unread frames, at most three ahead."""

    gives_newest = False
    given = 0
    begun = 0

    def read(self, stop: threading.Event) -> Taken | None:
        while self.given > self.begun + 3 and not stop.is_set():
            time.sleep(0.001)
        self.given += 1
        return super().read(stop)


def test_slow_stages_drop_frames_instead_of_delaying_others(frame: Frame) -> None:
    """Each stage is slower than the one before it. Detection and display wait for further frames, not for a time."""
    shown, source = Shown(), QueueingPlayback(FakeRecording(frame, (None,) * 40), rate=math.inf)

    class Waiting(FakeDetection):
        def detect(self, taken: Taken) -> Detected:
            source.begun = taken.frame.index
            # other frames are read only after the first one
            while taken.frame.index > 0 and source.given < source.begun + 3 and capture.is_alive():
                time.sleep(0.001)
            return super().detect(taken)

    def show(detected: Detected) -> None:
        shown(detected)
        # detection advances by at most 4 frames, so two more frames are detected before a display ends
        while source.begun < detected.frame.index + 12 and detect.is_alive():
            time.sleep(0.001)

    made = Pipeline(source, Waiting().detect, show)
    capture, detect, _ = made._threads
    run(made)
    figures = made.figures()
    drops = figures.drops
    assert figures.read == 40
    assert figures.detected + drops["detect"] == figures.read
    assert figures.shown + drops["show"] == figures.detected
    assert 2 <= figures.shown < figures.detected < figures.read
    assert shown[-1] == "39", "the last frame is never dropped"


def test_an_unreadable_frame_is_reported_and_the_others_are_shown(frame: Frame) -> None:
    shown, lines = Shown(), list[str]()
    made = Pipeline(
        Playback(FakeRecording(frame, (None,) * 4, broken=(1,)), rate=math.inf),
        FakeDetection().detect,
        shown,
        report=lines.append,
    )
    run(made)
    assert (made.figures().broken, made.figures().read) == (1, 3)
    assert "frame 1 is broken" in lines[0]
    assert shown[-1] == "3"


def test_a_frame_is_read_some_time_after_the_last_one_was_taken_or_when_one_is_waited_for() -> None:
    slot: Slot[int] = Slot()
    slot.put(1)
    slot.take()
    slot.wait_until_wanted(0.05)
    assert time.perf_counter() >= slot.taken_s + 0.05
    taker = threading.Thread(target=slot.take, daemon=True)
    taker.start()
    slot.wait_until_wanted(2 * PATIENCE_S)
    assert time.perf_counter() < slot.taken_s + PATIENCE_S
    slot.put(2)
    taker.join()


def test_a_pause_at_the_moment_of_a_stop_does_not_block(frame: Frame) -> None:
    made = Pipeline(Playback(FakeRecording(frame, (None,) * 40), rate=100.0), FakeDetection().detect, Shown())
    clear = made._running.clear

    def stop_and_clear() -> None:
        made.stop()
        clear()

    made._running.clear = stop_and_clear  # type: ignore[method-assign]
    made.start()
    made.pause(True)
    assert not made.is_paused
    assert made.wait(PATIENCE_S)


def fails(detected: Detected) -> None:
    raise ValueError("no display")


def test_an_error_of_any_stage_ends_all_stages_and_is_raised(frame: Frame) -> None:
    taken = Taken(frame, time.perf_counter(), 0.0)
    gone = SimpleNamespace(name="camera", skipped=0, gives_newest=False, resume=Mock(), close=Mock())
    gone.read = Mock(side_effect=[taken, taken, DeviceError("camera: was unplugged")])
    made = Pipeline(gone, FakeDetection().detect, Shown())
    made.start()
    with pytest.raises(DeviceError, match="unplugged"):
        made.wait(PATIENCE_S)
    gone.close.assert_called_once()
    endless = Playback(FakeRecording(frame, (None,) * 2), rate=50.0, order=cycle(range(2)))
    made = Pipeline(endless, FakeDetection().detect, fails)
    made.start()
    with pytest.raises(ValueError, match="no display"):
        made.wait(PATIENCE_S)
    with pytest.raises(ValueError, match="no display"):
        made.end()


def test_the_pipeline_can_be_ended_while_paused(frame: Frame) -> None:
    shown = Shown()
    made = Pipeline(
        Playback(FakeRecording(frame, (None,) * 2), rate=50.0, order=cycle(range(2))), FakeDetection().detect, shown
    )
    made.start()
    while len(shown) < 2:
        time.sleep(0.001)
    made.pause(True)
    assert made.is_paused
    seen = -1
    while seen != len(shown):  # frames in progress are still shown
        seen = len(shown)
        time.sleep(0.1)
    made.pause(False)
    while len(shown) < seen + 2:
        time.sleep(0.001)
    made.pause(True)
    made.end()
    assert made.ended.is_set()
    with pytest.raises(ConfigError, match="0 frames"):
        Pipeline(Playback(FakeRecording(frame, (None,)), rate=1.0), FakeDetection().detect, shown, max_frames=0)


def test_the_last_boxes_are_seeds_while_they_are_recent(hands: Recording, knowing: Any) -> None:
    detection = LiveDetection(knowing("hands"), SHORT, BoxRotation.AUTO, warm_start=True)
    frames = [hands.frame(index) for index in range(3)]
    moments = (10.0, 10.1, 10.1 + 2 * MAX_SEED_AGE_S)
    found = [detection.detect(Taken(f, at, 0.01)) for f, at in zip(frames, moments, strict=True)]
    assert [each.seeded for each in found] == [0, 2, 0]
    assert [any(map(is_warm, each.found.proposals)) for each in found] == [False, True, False]
    assert all(len(each.found.proposals) == 2 for each in found)
    assert found[0].stages_s["read"] == 0.01
    assert found[0].detect_s > 0


def test_figures_are_computed_over_their_window_only(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("annotator.workflows.live.pipeline.time", clock)
    clock.now_s = 100.0
    meter = Meter(window_s=0.3)
    assert summary_line(meter.figures({})) == "too few frames for a rate; 0 shown"
    meter.shown(clock.now_s - 5, {"show": 1.0})
    clock.now_s += 0.35
    for _ in range(3):
        clock.now_s += 0.02
        meter.shown(clock.now_s - 0.05, {"show": 0.002})
    figures = meter.figures({"detect": 2, "record": 1})
    assert figures.shown == 4
    assert figures.stages_ms == pytest.approx({"show": 2.0})
    assert figures.latency_ms == pytest.approx(50)
    assert figures.fps == pytest.approx(50)
    assert "dropped: 2 detect, 1 record" in summary_line(figures)


CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
CONFIG = RcvConfig()


def still() -> Frame:
    cloud = PointCloud(np.zeros((0, 3), np.float32))
    return Frame("0", 0, CAMERA, np.zeros((480, 640, 3), np.uint8), cloud)


def seed(x_m: float, y_m: float = 0.0, size_m: float = 0.1, label: str = "hand") -> WarmStart:
    return WarmStart(label, OrientedBox.at(RigidTransform.from_translation([x_m, y_m, 1.0]), np.full(3, size_m)))


def outline(of: WarmStart) -> Box2D:
    found = box_on_image(CAMERA, of.box, of.label)
    assert found is not None
    return found


class KnownBoxes:
    """A detector with given boxes that records its images."""

    labels, fingerprint = ("hand",), "known"

    def __init__(self, *boxes: Box2D) -> None:
        self.boxes = list(boxes)
        self.asked: list[Image] = []

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        self.asked += images
        return [[box for whole in self.boxes if (box := on_part(image, whole))] for image in images]

    @property
    def regions(self) -> list[bool]:
        """For each image since the last call: whether it was a region."""
        asked, self.asked = self.asked, []
        return [isinstance(image, Region) for image in asked]


def on_part(image: Image, box: Box2D) -> Box2D | None:
    """A box on a region, clipped to its border."""
    x, y = (image.x_px, image.y_px) if isinstance(image, Region) else (0, 0)
    height, width = image.rgb.shape[:2]
    edges = np.array(box.xyxy) - (x, y, x, y)
    low, high = np.clip(edges.reshape(2, 2), -0.5, [width - 0.5, height - 0.5])
    return None if (high - low < 1).any() else Box2D(box.label, *low.tolist(), *high.tolist(), box.score)


def shifted(box: Box2D, x_px: float, **other: object) -> Box2D:
    values = {"label": box.label, "score": 0.9} | other
    return Box2D(x_min=box.x_min + x_px, y_min=box.y_min, x_max=box.x_max + x_px, y_max=box.y_max, **values)


def tracking(*boxes: Box2D) -> tuple[KnownBoxes, RegionDetection]:
    """A detector that knows boxes, and has searched the whole of a first image for them."""
    known = KnownBoxes(*boxes)
    image_detection = RegionDetection(known)
    image_detection.boxes(still(), (), CONFIG)
    return known, image_detection


def test_a_tracked_object_is_searched_in_a_region_around_its_last_position() -> None:
    known = KnownBoxes(shifted(outline(seed(0.0)), 12.0))
    image_detection = RegionDetection(known)
    whole = image_detection.boxes(still(), (), CONFIG)
    followed = image_detection.boxes(still(), (seed(0.0),), CONFIG)
    assert known.regions == [False, True]
    assert whole == known.boxes
    assert followed[0].xyxy == pytest.approx(whole[0].xyxy)
    assert (followed[0].label, followed[0].score) == ("hand", 0.9)


def test_new_objects_are_found_when_the_whole_image_is_searched_again() -> None:
    known = KnownBoxes(outline(seed(0.0)), outline(seed(0.4)))
    image_detection = RegionDetection(known)
    found = [len(image_detection.boxes(still(), (seed(0.0),), CONFIG)) for _ in range(2 * WHOLE_EVERY)]
    assert found == ([2] + [1] * (WHOLE_EVERY - 1)) * 2
    assert known.regions == ([False] + [True] * (WHOLE_EVERY - 1)) * 2


@pytest.mark.parametrize(
    "seen",
    [
        pytest.param([], id="not found"),
        pytest.param([shifted(outline(seed(0.0)), 40.0)], id="too far away"),
        pytest.param([shifted(outline(seed(0.0)), 0.0, score=0.1)], id="low score"),
        pytest.param([shifted(outline(seed(0.0)), 0.0, label="foot")], id="another class"),
    ],
)
def test_an_object_not_found_in_its_region_is_searched_in_the_whole_image(seen: list[Box2D]) -> None:
    known, image_detection = tracking(*seen)
    known.boxes = seen
    for _ in range(WHOLE_EVERY):
        assert image_detection.boxes(still(), (seed(0.0),), CONFIG) == seen
    assert known.regions == [False, True, *[False] * WHOLE_EVERY], "regions are not used again at once"
    known.boxes = [outline(seed(0.0))]
    image_detection.boxes(still(), (seed(0.0),), CONFIG)
    assert known.regions == [True]


def test_an_object_cut_off_by_its_region_is_searched_in_the_whole_image() -> None:
    near = seed(0.0, size_m=0.36)
    for x_px, regions in ((40.0, [True]), (50.0, [True, False])):
        moved = shifted(outline(near), x_px)
        assert box_iou(moved, outline(near)) > 0.5
        known, image_detection = tracking(moved)
        (found,) = image_detection.boxes(still(), (near,), CONFIG)
        assert found.xyxy == pytest.approx(moved.xyxy)
        assert known.regions == [False, *regions]


def test_if_two_regions_find_the_same_object_the_whole_image_is_searched() -> None:
    known, image_detection = tracking(outline(seed(0.0)))
    assert image_detection.boxes(still(), (seed(0.0), seed(0.02)), CONFIG) == known.boxes
    assert known.regions == [False, True, True, False]
    # those of two classes may be there both
    known, image_detection = tracking(outline(seed(0.0)), outline(seed(0.02, label="foot")))
    found = image_detection.boxes(still(), (seed(0.0), seed(0.02, label="foot")), CONFIG)
    assert [box.label for box in found] == ["hand", "foot"]
    assert known.regions == [False, True, True]


def test_objects_at_the_border_of_the_image_are_tracked() -> None:
    at_edge = Box2D("hand", -0.5, 200.0, 40.0, 250.0, 0.9)
    known, image_detection = tracking(at_edge)
    assert image_detection.boxes(still(), (seed(-0.6),), CONFIG) == [at_edge]
    assert known.regions == [False, True]
