"""Live: frames and detections are recorded with proposals, even if the process is killed."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from annotator.geometry.iou import iou_3d
from annotator.project import BoxRotation, Project
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.recordings import open_recording
from annotator.recordings.frame_writer import FrameWriter
from annotator.recordings.recording import ReaderOptions
from annotator.types import (
    Box2D,
    Correction,
    Frame,
    LostObject,
    OrientedBox,
    PointCloud,
    Proposal,
    Quality,
    ReviewState,
)
from annotator.types.errors import ConfigError, RecordingError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.live.detection import Detected
from annotator.workflows.live.open_source import open_source
from annotator.workflows.live.recorder import Recorder, require_recordable, store

BOX = OrientedBox.from_parts(np.array([0.1, 0.0, 0.9]), np.eye(3), np.array([0.1, 0.2, 0.1]))
IMAGE_BOX = Box2D("hand", 10.0, 20.0, 60.0, 90.0, 0.9)


@pytest.fixture(scope="module")
def frames(generated: Path) -> list[Frame]:
    recording = open_recording(generated / "hands")
    return [recording.frame(index) for index in range(3)]


def seen(frame: Frame, at_s: float = 0.0) -> Detected:
    proposal = Proposal("hand", 0.8, BOX, IMAGE_BOX, (), Quality(0.0, 1.0, 0.0))
    found = FrameProposals(frame.key, (proposal,), (LostObject("hand", IMAGE_BOX, ()),))
    return Detected(frame, found, at_s, {"read": 0.01, "views": 0.02})


def test_frames_with_depth_are_read_back_unchanged(frames: list[Frame], tmp_path: Path) -> None:
    writer = FrameWriter(tmp_path)
    assert [writer.add(frame, 10**18 + n * 10**8) for n, frame in enumerate(frames)] == ["000000", "000001", "000002"]
    recording = open_recording(tmp_path)
    assert recording.format == "rgbd_folder"
    for number, frame in enumerate(frames):
        read = recording.frame(number)
        assert read.timestamp_ns == 10**18 + number * 10**8
        assert (read.depth_m == frame.depth_m).all()
        assert (read.cloud.xyz_m == frame.cloud.xyz_m).all()
        assert np.abs(read.rgb.astype(int) - frame.rgb).mean() < 4
        assert (read.camera.matrix == frame.camera.matrix).all()
        assert read.up == pytest.approx(frame.up)


def test_frames_without_depth_are_read_back_as_clouds(frames: list[Frame], tmp_path: Path) -> None:
    """As from a LiDAR or a Kinect: no registered depth, a distorted camera, reflectance."""
    bent = replace(frames[0].camera, distortion=(0.1, -0.02, 0.001, 0.0, 0.003))
    cloud = frames[0].cloud
    middle = np.abs(cloud.xyz_m[:, :2] / cloud.xyz_m[:, 2:]).max(axis=1) < 0.4  # also inside the distorted image
    xyz_m = cloud.xyz_m[middle]
    share = np.linspace(0, 1, len(xyz_m), dtype=np.float32)
    assert cloud.rgb is not None
    frame = replace(frames[0], camera=bent, depth_m=None, cloud=PointCloud(xyz_m, cloud.rgb[middle], share))
    FrameWriter(tmp_path).add(frame, 7)
    read = open_recording(tmp_path).frame(0)
    assert (read.cloud.xyz_m == xyz_m).all() and (read.cloud.rgb == frame.cloud.rgb).all()
    assert read.cloud.reflectance == pytest.approx(share)
    assert (read.camera.distortion, read.timestamp_ns) == (bent.distortion, 7)
    assert read.up == pytest.approx(frame.up)


def test_a_folder_has_one_camera_and_one_up_direction(frames: list[Frame], tmp_path: Path) -> None:
    writer = FrameWriter(tmp_path)
    writer.add(frames[0], 0)
    writer.add(replace(frames[1], up=np.array([1.0, 0.0, 0.0])), 10**8)
    assert open_recording(tmp_path).frame(0).up is None, "the frames have different up directions"
    with pytest.raises(RecordingError, match="frame 000002 has a different camera"):
        writer.add(replace(frames[2], camera=replace(frames[2].camera, fx=300.0)), 2 * 10**8)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("key,time\n", ":1: the header must be key,timestamp_ns"),
        ("key,timestamp_ns\n000000,5\nx,1.5\n", ":3: must be a key and a time"),
        ("key,timestamp_ns\n000000,-5\n", ":2: must be a key and a time"),
        (f"key,timestamp_ns\n000000,{2**63}\n", ":2: the time 9223372036854775808 ns is beyond the year 2262"),
        (f"key,timestamp_ns\n000000,{'9' * 5000}\n", ":2: must be a key and a time"),
        ("key,timestamp_ns\n000000,5\n000000,6\n", ":3: frame 000000 already has a line"),
    ],
)
def test_invalid_timestamps_are_errors(frames: list[Frame], tmp_path: Path, text: str, said: str) -> None:
    FrameWriter(tmp_path).add(frames[0], 5)
    (tmp_path / "timestamps.csv").write_text(text)
    with pytest.raises(RecordingError, match=said):
        open_recording(tmp_path)
    (tmp_path / "timestamps.csv").write_text("key,timestamp_ns\nother,5\n")
    assert open_recording(tmp_path).frame(0).timestamp_ns is None


def test_recorded_frames_are_in_the_project_with_proposals(
    frames: list[Frame], tmp_path: Path, hands: Project, knowing: Any
) -> None:
    recorder = Recorder(tmp_path / "seen")
    for number, frame in enumerate(frames):
        recorder.put(seen(frame, 5.0 + 0.1 * number))
    assert not (tmp_path / "seen").exists()
    assert recorder.finish() == 3
    done = store(hands, recorder, knowing("hands"), RcvConfig(), BoxRotation.FREE, warm_start=True)
    recorder.close()
    assert (done.name, done.frames, done.proposals) == ("seen", 3, 3)
    recording = open_recording(tmp_path / "seen")
    times = [recording.frame(number).timestamp_ns or 0 for number in range(3)]
    assert np.diff(times) == pytest.approx(1e8, abs=1000)
    assert sorted(path.name for path in tmp_path.iterdir() if "seen" in path.name) == ["seen"]
    stored = hands.frames.of([hands.recordings.find("seen").id])
    for frame in stored:
        (label,) = hands.labels.of_frame(frame.id)
        assert label.state is ReviewState.PROPOSED
        assert iou_3d(label.box, BOX) > 0.999
    (run,) = hands.jobs.all()
    assert run.finished_ns is not None
    assert '"live": "warm start"' in run.config
    assert {result.seconds for result in hands.jobs.results()} == {0.02}


def test_a_slow_disk_drops_frames_instead_of_blocking(
    frames: list[Frame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = FrameWriter.add

    def slow(writer: FrameWriter, frame: Frame, timestamp_ns: int) -> str:
        time.sleep(0.02)
        return add(writer, frame, timestamp_ns)

    monkeypatch.setattr(FrameWriter, "add", slow)
    recorder = Recorder(tmp_path / "slow")
    for _ in range(40):
        recorder.put(seen(frames[0]))
    assert recorder.dropped >= 15
    assert recorder.finish() == 40 - recorder.dropped == len(open_recording(tmp_path / "slow"))
    assert len(list(recorder.recorded())) == 40 - recorder.dropped
    recorder.close()


def test_write_errors_are_raised_and_earlier_frames_are_kept(
    frames: list[Frame], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(tmp_path / "full")
    recorder.put(seen(frames[0]))
    recorder.put(seen(replace(frames[1], camera=replace(frames[1].camera, fx=300.0))))
    with pytest.raises(RecordingError, match="a different camera"):
        while True:
            recorder.put(seen(frames[0]))
            time.sleep(0.005)
    assert recorder.finish() == 1
    assert len(open_recording(tmp_path / "full")) == 1
    recorder.close()
    with closing(Recorder(tmp_path / "nothing")) as nothing:
        assert nothing.finish() == 0
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_a_full_disk_keeps_the_proposals_written_before(
    frames: list[Frame], tmp_path: Path, hands: Project, knowing: Any
) -> None:
    recorder = Recorder(tmp_path / "full disk")
    written = recorder._results

    # space for one frame's proposals and a few bytes
    space = iter([None, 10, 10])
    recorder._results = Mock(wraps=written, write=lambda data: written.write(data[: next(space)]))
    for number, frame in enumerate(frames):
        recorder.put(seen(frame, 0.1 * number))
    assert recorder.finish() == 2
    with pytest.raises(RecordingError, match=r"full disk: the proposals of frame 000001 cannot be written \(No"):
        recorder.require_complete()
    done = store(hands, recorder, knowing("hands"), RcvConfig(), BoxRotation.FREE, warm_start=True)
    assert (done.frames, done.proposals) == (2, 1)
    recorder.close()


def test_a_recording_of_the_project_is_played_as_the_project_reads_it(people: Project, generated: Path) -> None:
    (stored,) = people.recordings.all()
    people.adjustments.correct(stored.id, Correction((0.0, 0.1, 0.0), (0.2, 0.0, 0.0)), "me")
    people.adjustments.set_up(stored.id, (0.0, -1.0, 0.2), "me")
    expected = FrameSource(people).read(people.frames.of()[0])
    for name in (str(generated / "people"), stored.name):
        taken = open_source(people, name).read(threading.Event())
        assert taken is not None
        assert np.array_equal(taken.frame.cloud.xyz_m, expected.cloud.xyz_m)
        assert np.array_equal(taken.frame.up, expected.up)
        assert taken.frame.depth_m is None
    other = open_source(people, str(generated / "hands")).read(threading.Event())
    assert other is not None and other.frame.depth_m is not None


def test_a_path_of_several_recordings_is_played_by_name(make_project: Any, generated: Path) -> None:
    project, path = make_project(), (generated / "people").resolve()
    for camera in ("left", "right"):
        options = ReaderOptions(camera=camera).stored()
        project.recordings.add(path, "rgbd_folder", f"people@{camera}", ["000000"], True, options=options)
    with pytest.raises(ConfigError, match="several recordings of it; give the name of one: people@left, people@right"):
        open_source(project, str(path))


def test_unusable_recording_paths_are_errors(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path, match in ((tmp_path, "exists already"), (tmp_path / "file" / "x", "cannot be created")):
        with pytest.raises(ConfigError, match=match):
            Recorder(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"is_sequence": False}, "do not follow each other in time"),
        ({"format": "cloud_folder", "images": None}, "has no camera images"),
    ],
)
def test_unsuitable_sources_are_refused_before_the_start(change: dict[str, object], said: str, generated: Path) -> None:
    recording = open_recording(generated / "hands")
    require_recordable(recording)

    known = {name: getattr(recording, name) for name in ("path", "format", "is_sequence")}
    other = Mock(spec=recording, **(known | change))
    with pytest.raises(ConfigError, match=said):
        require_recordable(other)


KILLED = """
import sys, time
from pathlib import Path
from annotator.rcv.finish import FrameProposals
from annotator.recordings import open_recording
from annotator.workflows.live.detection import Detected
from annotator.workflows.live.recorder import Recorder
frame = open_recording(Path(sys.argv[1])).frame(0)
recorder = Recorder(Path(sys.argv[2]))
while True:
    recorder.put(Detected(frame, FrameProposals(frame.key, (), ()), time.perf_counter(), {}))
    time.sleep(0.002)
"""


def wait_for(happened: Callable[[], bool]) -> None:
    end = time.monotonic() + 240
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_recording_of_a_killed_process_is_rescued(generated: Path, tmp_path: Path) -> None:
    out, lines = tmp_path / "cut [off]", list[str]()
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(generated / "hands"), str(out)])
    try:
        wait_for(lambda: len(list(tmp_path.glob(".cut [[]off].recording-*/color/*.jpg"))) >= 3)
        with pytest.raises(ConfigError, match="another `annotator live` records to it"):
            Recorder(out, lines.append)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait(30)
    (part,) = tmp_path.glob(".cut [[]off].recording-*")
    # as if it had been killed while it wrote a frame
    (part / "depth" / "999999.png").write_bytes(b"half")
    with (part / "timestamps.csv").open("a") as file:
        file.write("999999,12")
    empty = tmp_path / ".cut [off].recording-empty"
    empty.mkdir()
    with closing(Recorder(out, lines.append)) as again:
        again.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["cut [off]-rescued-1"]
    rescued = open_recording(tmp_path / "cut [off]-rescued-1")
    assert len(rescued) >= 3
    times = [rescued.frame(number).timestamp_ns for number in range(len(rescued))]
    assert None not in times
    assert sorted(times) == times  # type: ignore[type-var]
    assert any(f"{len(rescued)} frames of an interrupted recording" in line for line in lines)
    assert any("removed; it is from an interrupted recording without frames" in line for line in lines)


def test_if_the_path_is_taken_at_the_end_the_error_names_the_recorded_frames(
    frames: list[Frame], tmp_path: Path
) -> None:
    recorder = Recorder(tmp_path / "taken")
    recorder.put(seen(frames[0]))
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine").touch()
    with pytest.raises(RecordingError, match=r"1 frame kept in .*recording-"):
        recorder.finish()
    recorder.close()
