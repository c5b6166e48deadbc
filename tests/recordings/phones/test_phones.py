"""Record3D and Stray Scanner: what is written is read, from generated and from real images; and damage."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import av
import numpy as np
import phone_samples as made
import pytest

from annotator.geometry.projection import project
from annotator.recordings import open_recording
from annotator.recordings.image_file import open_video
from annotator.recordings.recording import ReaderOptions
from annotator.types import Frame
from annotator.types.errors import FrameError, RecordingError

Images = list[tuple[np.ndarray, np.ndarray, np.ndarray | None]]


def record3d(folder: Path, images: Images, matrix: np.ndarray = made.K, **how: int) -> Path:
    return made.write_record3d(folder / "take.r3d", images, matrix, **how)


def record3d_unpacked(folder: Path, images: Images) -> Path:
    return made.write_record3d(folder / "take", images)


def record3d_deflated(folder: Path, images: Images) -> Path:
    return record3d(folder, images, compression=zipfile.ZIP_DEFLATED)


def stray_scanner(folder: Path, images: Images, matrix: np.ndarray = made.K) -> Path:
    return made.write_stray_scanner(folder / "take", images, matrix)


WRITERS = [record3d, record3d_unpacked, record3d_deflated, stray_scanner]
Writer = Callable[..., Path]


def require_same(frame: Frame, written: tuple[np.ndarray, np.ndarray, np.ndarray | None], least: int, most_off: int):
    """Compares a frame with what was written. Image compression changes colours by at most `most_off` (99 of 100)."""
    rgb, depth_m, confidence = written
    assert np.percentile(np.abs(frame.rgb.astype(int) - rgb), 99) <= most_off
    kept = depth_m > 0 if confidence is None else (depth_m > 0) & (confidence >= least)
    np.testing.assert_allclose(frame.cloud.xyz_m[:, 2], depth_m[kept], atol=5.1e-4)
    # each point lies in the middle of the part of the image that its depth pixel covers
    v, u = np.nonzero(kept)
    scale = rgb.shape[1] / depth_m.shape[1]
    px = project(frame.camera, frame.cloud.xyz_m)
    np.testing.assert_allclose(px, np.c_[u, v] * scale + (scale - 1) / 2, atol=2e-3)
    at = np.floor(px + 0.5).astype(int)
    clear = (np.abs(px % 1 - 0.5) > 0.01).all(axis=1)
    np.testing.assert_array_equal(frame.cloud.rgb[clear], frame.rgb[at[clear, 1], at[clear, 0]])
    assert np.count_nonzero(frame.depth_m) == len(frame.cloud)


@pytest.mark.parametrize("write", WRITERS)
def test_what_is_written_is_read(tmp_path: Path, write: Writer):
    images = made.frames()
    path = write(tmp_path, images)
    for least in (0, 1, 2):
        recording = open_recording(path, ReaderOptions(min_confidence=least))
        for i in (2, 0, 3, 1):
            require_same(recording.frame(i), images[i], least, 4)
    recording = open_recording(path)
    assert (recording.name, len(recording), recording.is_sequence, recording.notes) == ("take", 4, True, ())
    frame = recording.frame(3)
    require_same(frame, images[3], 1, 4)  # without the option, low confidence is left out
    camera = frame.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (303.0, 304.0, 159.5, 119.5)  # of this image
    np.testing.assert_allclose(frame.up, made.orientation(3).inv().apply([0, 1, 0]), atol=1e-6)
    assert frame.up[1] < -0.9  # the camera was held upright
    start, step = (0, 1 / 30) if recording.format == "record3d" else (5000, 1 / 60)
    assert frame.timestamp_ns == pytest.approx((start + 3 * step) * 1e9, abs=100)


def test_older_record3d_files_have_fewer_keys_and_no_gravity(tmp_path: Path):
    relative = [[1e-9, 0, 0, 1, 0, 0, 0], [0, 0.1, 0, 0.995, 0, 0, 0]]
    newer = ("dw", "dh", "perFrameIntrinsicCoeffs", "frameTimestamps", "initPose")
    depth = np.linspace(1, 2, 192 * 256, dtype=np.float32)
    for name, shape, size in (("wide.r3d", (192, 256), (1024, 768)), ("tall.r3d", (256, 192), (768, 1024))):
        rgb = np.full((*size[::-1], 3), 90, np.uint8)
        images: Images = [(rgb, depth.reshape(shape), None)] * 2
        recording = open_recording(made.write_record3d(tmp_path / name, images, without=newer, poses=relative))
        frame = recording.frame(1)
        assert len(frame.cloud) == 192 * 256
        np.testing.assert_array_equal(frame.cloud.xyz_m[:, 2], depth)
        assert (frame.up, frame.timestamp_ns, frame.camera.fx) == (None, round(1e9 / 60), 300.0)
        assert "gravity is not known" in recording.notes[0]


def test_a_smaller_image_than_the_metadata_names_has_a_smaller_camera(tmp_path: Path):
    path = made.write_record3d(tmp_path / "take.r3d", made.frames(1), w=640, h=480)
    camera = open_recording(path).frame(0).camera
    assert (camera.width_px, camera.fx, camera.cx) == (320, 150.0, (159.5 + 0.5) / 2 - 0.5)
    other = made.write_record3d(tmp_path / "other.r3d", made.frames(1), h=400)
    with pytest.raises(FrameError, match="the image is 320 x 240 pixels, but the metadata has 320 x 400"):
        open_recording(other).frame(0)


def test_older_stray_scanner_folders_share_one_camera_matrix_and_have_numpy_depth(tmp_path: Path):
    images = made.frames(3)
    path = made.write_stray_scanner(tmp_path / "take", images, own_intrinsics=False)
    for number in range(3):
        depth_mm = np.rint(np.nan_to_num(images[number][1]) * 1000).astype(np.uint16)
        (path / "depth" / f"{number:06d}.png").unlink()
        np.save(path / "depth" / f"{number:06d}.npy", depth_mm)
    frame = open_recording(path).frame(2)
    require_same(frame, images[2], 1, 4)
    assert frame.camera.fx == 300.0


@pytest.mark.parametrize(("rolled", "turns"), [(90, 1), (180, 2), (30, 0)])
def test_images_of_a_turned_phone_are_upright(tmp_path: Path, rolled: int, turns: int):
    images = made.frames(2)
    path = made.write_stray_scanner(tmp_path / "take", images, rolled=rolled)
    recording = open_recording(path)
    frame = recording.frame(1)
    upright = tuple(np.rot90(image, -turns) for image in images[1])
    require_same(frame, upright, 1, 4)
    assert frame.up[1] < -0.75
    assert (recording.notes == ()) == (turns == 0)


def test_confidence_that_was_not_recorded_is_told(tmp_path: Path):
    rgb, depth_m, _ = made.scene(0)
    (tmp_path / "r").mkdir()
    for path in (
        record3d(tmp_path / "r", [(rgb, depth_m, None)]),
        stray_scanner(tmp_path / "s", [(rgb, depth_m, None)]),
    ):
        if path.is_dir():
            (path / "confidence").rmdir()
        (note,) = open_recording(path, ReaderOptions(min_confidence=2)).notes
        assert note.endswith("--min-confidence has no effect.")
        assert open_recording(path).notes == ()


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_images_of_a_video_are_decoded_in_any_order(tmp_path: Path, codec: str):
    images = [rgb for rgb, _, _ in made.frames(16)]
    path = tmp_path / "rgb.mp4"
    for _ in range(20):  # PyAV's x265 sometimes writes a head that its own container refuses
        with suppress(av.error.PatchWelcomeError):
            made.write_video(path, images, codec, keyframes=5)
            break
    video = open_video(path)
    assert (len(video), video.size) == (16, (320, 240))
    for i in (15, 3, 3, 4, 9, 0, 14, 13, 7, 8):
        assert np.percentile(np.abs(video.image(i).astype(int) - images[i]), 99) <= 4


def test_a_list_of_other_videos_is_no_video(tmp_path: Path):
    """FFmpeg would open the files that it names."""
    made.write_video(tmp_path / "other.mp4", [rgb for rgb, _, _ in made.frames(2)], "libx264", keyframes=1)
    assert len(open_video(tmp_path / "other.mp4")) == 2
    (tmp_path / "rgb.mp4").write_text("ffconcat version 1.0\nfile other.mp4\n")
    with pytest.raises(ValueError, match="not a readable video"):
        open_video(tmp_path / "rgb.mp4")


def test_a_video_of_another_length_is_told(tmp_path: Path):
    path = made.write_stray_scanner(tmp_path / "take", made.frames())
    table = (path / "odometry.csv").read_text().splitlines(keepends=True)
    (path / "odometry.csv").write_text("".join(table[:4]))
    assert "rgb.mp4 has 4 images, but odometry.csv has 3 rows" in open_recording(path).notes[0]
    (path / "odometry.csv").write_text("".join([*table, table[-1].replace("000003", "000004")]))
    with pytest.raises(FrameError, match=r"rgb\.mp4: frame 000004: there is no image 4; it has 4"):
        open_recording(path).frame(4)


def test_confidence_that_leaves_nothing_is_an_error(tmp_path: Path):
    rgb, depth_m, _ = made.scene(0)
    path = record3d(tmp_path, [(rgb, depth_m, np.zeros(depth_m.shape, np.uint8))])
    with pytest.raises(FrameError, match=r"0\.depth: no pixel has a depth of confidence 1 or more.*--min-confidence"):
        open_recording(path).frame(0)
    assert len(open_recording(path, ReaderOptions(min_confidence=0)).frame(0).cloud) > 1000


def test_frames_of_record3d_have_the_times_of_its_rate_if_none_is_set(tmp_path: Path):
    recording = open_recording(made.write_record3d(tmp_path / "take", made.frames(3), frameTimestamps=[0, 0, 0]))
    assert [recording.frame(i).timestamp_ns for i in range(3)] == [0, 16_666_667, 33_333_333]


def test_a_file_that_is_no_archive_is_an_error(tmp_path: Path):
    path = tmp_path / "take.r3d"
    path.write_bytes(b"RED1" + bytes(100))
    with pytest.raises(RecordingError, match=r"take\.r3d: not a complete zip archive .*; export"):
        open_recording(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("rgbd/0.jpg", b"")
    with pytest.raises(RecordingError, match="has no file metadata"):
        open_recording(path)
