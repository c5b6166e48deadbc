"""TUM's RGB-D format: pairs by time, depth units, gravity from its poses; and damage."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import small_recordings as made
from scipy.spatial.transform import Rotation
from small_recordings import START_S

from annotator.recordings import open_recording
from annotator.recordings.recording import ReaderOptions
from annotator.types.errors import FrameError, RecordingError


def image(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (480, 640, 3)).astype(np.uint8)


def depth(number: int) -> np.ndarray:
    raw = np.random.default_rng(number).integers(2500, 20_000, (480, 640)).astype(np.uint16)
    raw[:100] = 0
    return raw


def write_tum(folder: Path, rgb_ms: list[int], depth_ms: list[int], images: made.Draw = image) -> Path:
    return made.write_tum(folder, rgb_ms, depth_ms, images, depth)


def test_images_are_paired_by_time_and_depth_has_5000_units_per_metre(tmp_path: Path):
    path = write_tum(tmp_path / "rgbd_dataset_freiburg1_xyz", [0, 33, 66, 133], [12, 41, 97, 130])
    recording = open_recording(path)
    assert (recording.format, recording.is_sequence) == ("tum_rgbd", True)
    assert recording.keys == ("1305031102.000000", "1305031102.033000", "1305031102.133000")
    assert recording.notes == ("Left out: 1 colour image without a depth image within 0.02 s.",)
    for i, (color, partner) in enumerate(((0, 0), (1, 1), (3, 3))):
        frame = recording.frame(i)
        np.testing.assert_array_equal(frame.rgb, image(color))
        np.testing.assert_array_equal(frame.depth_m, (depth(partner) / np.float32(5000)).astype(np.float32))
        assert len(frame.cloud) == np.count_nonzero(depth(partner)) == len(frame.cloud.pixel_index)
    assert frame.timestamp_ns == START_S * 10**9 + 133_000_000
    assert (frame.camera.fx, frame.camera.cx, frame.camera.cy) == (525.0, 319.5, 239.5)
    # the camera looks down by about 27 degrees
    np.testing.assert_allclose(
        frame.up, Rotation.from_quat([0.6132, 0.5962, -0.3311, -0.3986]).as_matrix()[2], atol=1e-6
    )
    assert frame.up[1] < -0.85 and frame.up[2] == pytest.approx(-np.sin(np.radians(27.6)), abs=0.01)
    wider = open_recording(path, ReaderOptions(tolerance_s=0.05))
    assert (len(wider), wider.notes) == (4, ())
    with pytest.raises(
        RecordingError, match=r"no frames; none of its colour images \(4\) has .* within 0\.001 s; give a larger"
    ):
        open_recording(path, ReaderOptions(tolerance_s=0.001))


def test_other_recordings_have_their_own_camera_and_no_known_gravity(tmp_path: Path):
    path = write_tum(tmp_path / "lab", [0], [1])
    recording = open_recording(path)
    assert "write camera_intrinsic.json for others" in recording.notes[0]
    assert recording.frame(0).up is None
    camera = {"width": 640, "height": 480, "intrinsic_matrix": [500.0, 0, 0, 0, 501.0, 0, 320, 240, 1]}
    (path / "camera_intrinsic.json").write_text(json.dumps(camera))
    frame = recording.frame(0)
    assert (frame.camera.fx, recording.notes) == (500.0, ())
    assert frame.depth_m.max() == depth(0).max() / np.float32(5000)
    (path / "camera_intrinsic.json").write_text(json.dumps(camera | {"depth_scale": 1000}))
    assert recording.frame(0).depth_m.max() == depth(0).max() / np.float32(1000)


def test_folders_may_be_linked_into_the_recording_but_not_lead_further(tmp_path: Path):
    path = write_tum(tmp_path / "freiburg", [0, 33], [1, 34])
    (path / "rgb").rename(tmp_path / "elsewhere")
    (path / "rgb").symlink_to(tmp_path / "elsewhere")
    np.testing.assert_array_equal(open_recording(path).frame(0).rgb, image(0))
    (tmp_path / "elsewhere").rename(tmp_path / "further")
    (tmp_path / "elsewhere").mkdir()
    for file in (tmp_path / "further").iterdir():
        (tmp_path / "elsewhere" / file.name).symlink_to(file)
    with pytest.raises(FrameError, match="leads out of the folder"):
        open_recording(path).frame(0)


@pytest.mark.parametrize(
    "changed",
    [
        lambda text: text.replace(" ", ", "),
        lambda text: text.replace(" ", ","),
        lambda text: text.replace("rgb/", "./rgb/"),
        lambda text: text.replace(".png", ".png 1 2"),
    ],
    ids=["commas-blanks", "commas", "point", "columns"],
)
def test_lists_of_other_tools_are_read(tmp_path: Path, changed: Callable[[str], str]):
    path = write_tum(tmp_path / "freiburg", [0, 33], [1, 34], small)
    before = open_recording(path)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        comments, _, rows = (path / name).read_text().rpartition("#")
        comment, _, rows = rows.partition("\n")
        (path / name).write_bytes(changed(f"{comments}#{comment}\n{rows}").encode())
    after = open_recording(path)
    assert (after.keys, after.times_ns) == (before.keys, before.times_ns)
    np.testing.assert_array_equal(after.poses.quaternions, before.poses.quaternions)
    assert [file.is_file() for i in range(2) for file in after.files(i)] == [True] * 4


def small(number: int) -> np.ndarray:
    return image(number)[:8, :8]


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("depth.txt", "1305031102000000000 a.png", r"depth\.txt:1: the time \d+ s is beyond the year 2262"),
        ("rgb.txt", "1305031102,25 rgb/a.png", r"rgb\.txt:1: begins with a time with a decimal comma; write a point"),
        ("groundtruth.txt", "1305031102 0 0 0 0,5 0,5 0,5 0,5", r"groundtruth\.txt:1: must be a time, a place"),
        ("groundtruth.txt", "1305031102 0 0 0 2 0.6 -0.3 -0.4", r"groundtruth\.txt:1: must be a time, a place"),
    ],
)
def test_decimal_commas_and_nanoseconds_are_refused(tmp_path: Path, name: str, text: str, says: str):
    path = write_tum(tmp_path / "freiburg", [0], [1], small)
    (path / name).write_text(text)
    with pytest.raises(RecordingError, match=says):
        open_recording(path)
