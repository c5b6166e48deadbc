"""The reader selected for a path, errors that say what is missing or near, and remote recordings."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.recordings import (
    ReaderOptions,
    Recording,
    detect_format,
    open_recording,
    parse_options,
    stored_options,
)
from annotator.recordings.mirror import open_mirror
from annotator.types.errors import ConfigError, FrameError, RecordingError, UnknownFormatError

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


MEGABYTE = 10**6


@pytest.fixture
def bucket(generated: Path) -> Iterator[str]:
    """The generated people in fsspec's memory file system."""
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.put(str(generated / "people"), "/bucket/people", recursive=True)
    yield "memory://bucket/people"
    memory.rm("/bucket", recursive=True)


def held_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_a_mirror_has_the_folders_frames_and_bounded_size(bucket: str, generated: Path, tmp_path: Path) -> None:
    plain = open_recording(generated / "people")
    sizes = [held_bytes(generated / "people" / name) for name in ("color", "depth")]
    limit = held_bytes(generated / "people") - sum(sizes) * 2 // 5  # some frames, not all
    mirror = open_mirror(bucket, tmp_path, limit)
    assert (mirror.keys, mirror.format, mirror.name, len(mirror)) == (plain.keys, plain.format, "people", 5)
    for index in (0, 4, 2, 3, 1, 0):
        ours, theirs = mirror.frame(index), plain.frame(index)
        assert (ours.key, ours.index) == (theirs.key, theirs.index)
        assert np.array_equal(ours.rgb, theirs.rgb) and np.array_equal(ours.cloud.xyz_m, theirs.cloud.xyz_m)
        assert np.array_equal(ours.up, theirs.up)
        assert held_bytes(tmp_path) <= limit
    mirror.close()
    assert list(tmp_path.iterdir()) == []


def test_only_files_of_the_frame_and_shared_files_are_copied(tmp_path: Path) -> None:
    """Files with the frame's key in their name belong to the frame; other files are shared by all frames."""
    folder = tmp_path / "clouds"
    for name in ("points", "calib", "notes"):
        (folder / name).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for key in ("000007", "000010"):
        points = np.concatenate([rng.uniform([5, -2, -1], [9, 2, 1], (50, 3)), np.ones((50, 1))], axis=1)
        points.astype(np.float32).tofile(folder / "points" / f"{key}.bin")
    (folder / "notes" / "all.txt").write_text("of nobody\n")
    mirror = open_mirror(folder.as_uri(), tmp_path / "copy", MEGABYTE)
    plain = open_recording(folder)
    assert np.array_equal(mirror.frame(1).cloud.xyz_m, plain.frame(1).cloud.xyz_m)
    copied = {path.name: path.stat().st_size for path in (tmp_path / "copy").rglob("*") if path.is_file()}
    assert copied["000007.bin"] == 0 and copied["all.txt"] == 10


def test_failed_downloads_leave_no_files_and_are_not_counted(bucket: str, tmp_path: Path) -> None:
    """If one file of a frame cannot be copied, its other files are neither counted nor left in the copy."""
    import fsspec

    memory = fsspec.filesystem("memory")
    depth = memory.cat("/bucket/people/depth/000002.png")
    memory.pipe("/bucket/people/depth/000003.png", b"no picture")
    mirror = open_mirror(bucket, tmp_path, 50 * MEGABYTE)
    with pytest.raises(FrameError, match=r"memory://bucket/people/depth/000003\.png"):
        mirror.frame(3)
    held = held_bytes(tmp_path)
    memory.rm("/bucket/people/depth/000002.png")
    for _ in range(3):
        with pytest.raises(RecordingError, match=r"people/depth/000002\.png: cannot be reached"):
            mirror.frame(2)
    assert held_bytes(tmp_path) == held == mirror.store.used_bytes
    memory.pipe("/bucket/people/depth/000002.png", depth)
    mirror.frame(2)


def test_shared_files_that_have_arrived_stay_if_a_later_one_fails(bucket: str, tmp_path: Path) -> None:
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.pipe({"/bucket/people/notes/all.txt": b"of nobody", "/bucket/people/notes/more.txt": b"lost"})
    mirror = open_mirror(bucket, tmp_path, 50 * MEGABYTE)
    used = mirror.store.used_bytes
    memory.rm("/bucket/people/notes/more.txt")
    with pytest.raises(RecordingError, match=r"notes/more\.txt: cannot be reached"):
        mirror.frame(0)
    assert next(tmp_path.rglob("all.txt")).read_bytes() == b"of nobody"
    assert held_bytes(tmp_path) == mirror.store.used_bytes >= used + len(b"of nobody")


def test_a_frame_larger_than_the_limit_is_an_error(bucket: str, tmp_path: Path) -> None:
    mirror = open_mirror(bucket, tmp_path, 5000)
    with pytest.raises(RecordingError, match="raise --cache-mb"):
        mirror.frame(0)


def test_urls_without_a_recording_are_errors(tmp_path: Path) -> None:
    for url, says in (("memory://bucket/nothing", "has no files"), ("xyz://bucket/room", "Protocol not known: xyz")):
        with pytest.raises(RecordingError, match=says):
            open_mirror(url, tmp_path, MEGABYTE)


def test_a_folder_that_is_not_a_recording_leaves_no_copy(tmp_path: Path) -> None:
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "a.md").write_text("a")
    with pytest.raises(UnknownFormatError):
        open_mirror((tmp_path / "texts").as_uri(), tmp_path / "copy", MEGABYTE)
    assert list((tmp_path / "copy").iterdir()) == []


def test_copies_of_killed_processes_are_removed(bucket: str, tmp_path: Path) -> None:
    left = tmp_path / ".recording.01234567.unfinished"
    left.mkdir()
    (left / "file").touch()
    open_mirror(bucket, tmp_path, 50 * MEGABYTE)
    assert not left.exists()
