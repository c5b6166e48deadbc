"""The reader selected for a path, and the errors of paths that are no recordings: what is missing, what is near."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from annotator.recordings import (
    ReaderOptions,
    Recording,
    detect_format,
    open_recording,
    parse_options,
    stored_options,
)
from annotator.types.errors import ConfigError, RecordingError, UnknownFormatError

REAL = [
    ("hand_gesture", "rgbd_folder", 24, True),
    ("human_turn", "rgbd_folder", 75, True),
    ("rgbd_open3d_testdata/RGBD", "rgbd_folder", 5, True),
    ("kitti", "kitti_object", 10, False),
    ("kitti_drive_0005", "kitti_tracking", 20, True),
    ("realsense/single_depth_color_640x480.bag", "ros_bag", 1, True),
]


@pytest.mark.shared
@pytest.mark.parametrize(("folder", "name", "frames", "is_sequence"), REAL)
def test_real_folders_are_recognised_and_their_frames_load(
    shared: Path, folder: str, name: str, frames: int, is_sequence: bool
):
    path = shared / "data" / folder
    recording = open_recording(path)
    assert isinstance(recording, Recording)
    assert (recording.format, len(recording), recording.is_sequence) == (name, frames, is_sequence)
    assert detect_format(path) == name
    assert recording.path == path
    for i in range(0, len(recording), 5):
        frame = recording.frame(i)
        assert (frame.key, frame.index) == (recording.keys[i], i)
        assert len(frame.cloud) > 1000
        assert frame.cloud.rgb is not None


@pytest.mark.shared
def test_a_raw_sun_rgbd_folder_is_not_taken_for_an_rgbd_folder(shared: Path):
    # its depth has another encoding: read as millimetres it would be wrong
    assert detect_format(shared / "data" / "sunrgbd" / "raw") is None


def test_errors_of_missing_permissions_name_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The system's errors are simulated, since root may read everything."""
    make(tmp_path, "take/color/", "take/depth/")

    def refuse(path: Path) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(os, "scandir", refuse)
    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(RecordingError, match=r"/take.*Permission denied\); allow this user to read it"):
        open_recording(tmp_path / "take")


def test_a_path_that_is_too_long_is_an_error(tmp_path: Path):
    for ask in (open_recording, detect_format):
        with pytest.raises(RecordingError, match=r"File name too long\); give a shorter path"):
            ask(tmp_path / ("n" * 300))


def test_a_recording_without_frames_is_an_error(tmp_path: Path):
    make(tmp_path, "color/readme.txt", "color/.hidden.png", "depth/")
    with pytest.raises(RecordingError, match="no frames; expected"):
        open_recording(tmp_path)


def test_frames_are_in_numerical_order(tmp_path: Path):
    make(tmp_path, *(f"{folder}/{key}.png" for folder in ("color", "depth") for key in ("10", "2", "a9", "a10", "1")))
    recording = open_recording(tmp_path)
    assert recording.keys == ("1", "2", "10", "a9", "a10")
    for i in (-1, 5):
        with pytest.raises(IndexError, match="5 frames"):
            recording.frame(i)


def test_an_option_that_the_format_does_not_take_is_an_error(generated: Path) -> None:
    with pytest.raises(ConfigError, match="is read as rgbd_folder, which takes no options, not --columns, --frame"):
        open_recording(generated / "people", parse_options(columns=5, tf_frame="lens"))


def test_invalid_options_are_named_as_on_the_command_line() -> None:
    for name, flag in (("columns", "--columns 2"), ("tolerance_s", "--tolerance 2")):
        with pytest.raises(ConfigError, match=flag):
            parse_options(**{name: 2 if name == "columns" else 2e3})


def test_options_are_stored_and_restored() -> None:
    options = parse_options(columns=5, tolerance_s=0.1)
    assert stored_options(options.stored()) == options
    assert ReaderOptions().stored() == "" and stored_options("") == ReaderOptions()
    with pytest.raises(ConfigError, match="update annotator"):
        stored_options('{"zoom": 2}')


CASES = [
    (("color/",), "it looks like an RGB-D folder: depth/ and camera_*.json are missing"),
    (("image_2/", "calib/"), "it looks like a KITTI object folder: velodyne/ is missing"),
    (("training/image_2/", "training/calib/"), "training/ looks like a KITTI object folder: velodyne/ is missing"),
    (("image/", "calib/"), "VoteNet extracts it: depth/*.mat or points/*.npz is missing"),
]


def make(folder: Path, *names: str) -> None:
    for name in names:
        place = folder / name
        if name.endswith("/"):
            place.mkdir(parents=True, exist_ok=True)
        else:
            place.parent.mkdir(parents=True, exist_ok=True)
            place.touch()


def refusal(path: Path) -> str:
    with pytest.raises(UnknownFormatError) as caught:
        open_recording(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(("names", "said"), CASES)
def test_the_nearest_format_is_named_with_what_is_missing(tmp_path: Path, names: tuple[str, ...], said: str):
    make(tmp_path, *names)
    message = refusal(tmp_path)
    assert message.startswith(f"{tmp_path}: no known recording format in this folder; ")
    assert said in message


def test_recordings_are_searched_three_levels_down(tmp_path: Path):
    make(tmp_path, "b/c/take/color/1.png", "b/c/take/depth/1.png", "a/color/1.png", "a/depth/1.png")
    make(tmp_path, "d/e/f/deep/color/1.png", "d/e/f/deep/depth/1.png", ".hidden/color/1.png", ".hidden/depth/1.png")
    assert refusal(tmp_path).endswith("; it contains recordings; give the path of one of them: a, b/c/take")


def test_recordings_below_that_cannot_be_opened_are_shown_with_their_problem(tmp_path: Path):
    make(tmp_path, "drive/image_2/1.png", "drive/velodyne/1.bin")
    assert "it contains recordings that cannot be opened: " in refusal(tmp_path)
    assert f"{tmp_path}/drive: looks like a KITTI object folder: calib/ is missing" in refusal(tmp_path)


def test_a_part_of_a_recording_names_the_recording(tmp_path: Path):
    make(tmp_path, "kitti/image_2/1.png", "kitti/velodyne/1.bin", "kitti/calib/1.txt", "clouds/1.bin", "clouds/other/x")
    for part in ("kitti/velodyne/1.bin", "kitti/image_2", "kitti/calib/1.txt"):
        assert refusal(tmp_path / part).endswith(f"it is a part of the recording {tmp_path / 'kitti'}; give that path")
    assert refusal(tmp_path / "clouds" / "1.bin").endswith(f"recording {tmp_path / 'clouds'}; give that path")
    assert "it is a part" not in refusal(tmp_path / "clouds" / "other")
    scene = ("intrinsics.txt", "image/1.jpg", "depth/1.png", "extrinsics/1.txt")
    make(tmp_path, *(f"scene/{name}" for name in scene))
    assert refusal(tmp_path / "clouds" / "1.bin").endswith(f"recording {tmp_path / 'clouds'}; give that path")
    assert refusal(tmp_path / "scene" / "depth" / "1.png").endswith(f"recording {tmp_path / 'scene'}; give that path")


def test_single_files_are_told_what_to_do(tmp_path: Path):
    make(tmp_path, "take.ZIP", "take.mp4", "boxes.json", "notes.txt")
    assert "unpack it" in refusal(tmp_path / "take.ZIP")
    assert "a video, which has no depth" in refusal(tmp_path / "take.mp4")
    assert "it holds boxes; give the recording's folder" in refusal(tmp_path / "boxes.json")
    assert "notes.txt` lists what each format needs" in refusal(tmp_path / "notes.txt")


def test_a_missing_path_is_told_which_part_is_missing(tmp_path: Path):
    make(tmp_path, "kitti/")
    assert f"no such file or folder ({tmp_path} has no kiti; did you mean kitti?)" in refusal(tmp_path / "kiti" / "a")
