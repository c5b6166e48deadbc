"""Small recordings of all formats: files of a frame, known damage, times; images that are complete or refused."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import small_recordings as made
from cloud_samples import HEIGHT, WIDTH
from hypothesis import given, settings
from hypothesis import strategies as st
from rgbd_samples import png, write_rgbd
from small_recordings import cloud_folder, kitti_object, kitti_raw, kitti_tracking, rgbd_folder, sunrgbd_extracted

from annotator.frame_limits import most_pixels
from annotator.image_bytes import decode_image
from annotator.recordings import open_recording
from annotator.recordings.frame_times import has_times, known_times, read_times, recorded_times
from annotator.recordings.image_file import read_color_image
from annotator.recordings.recording import Recording
from annotator.types.errors import FrameError, RecordingError
from annotator.workflows.recorded.condition import broken_frames

Change = Callable[[bytes], bytes | None]
Case = tuple[Callable[[Path], object], str, Change, str]


def replaced(pattern: bytes, new: bytes) -> Change:
    return lambda old: re.sub(pattern, new, old, count=1)


def removed(_: bytes) -> None:
    return None


def described(**changes: object) -> Change:
    return lambda old: json.dumps(json.loads(old) | changes).encode()


def picture(shape: tuple[int, ...], value: int = 1, kind: type = np.uint16) -> Change:
    return lambda _: png(np.full(shape, value, kind))


def scan(*values: float) -> Change:
    return lambda _: struct.pack(f"<{len(values)}f", *values)


# Builds a recording; the file that is changed or removed, and what its error says.
KNOWN_CASES: list[Case] = [
    (kitti_object, "calib/0.txt", replaced(rb"P2: \S+", b"P2: 1e308"), "not finite or is too large"),
    (kitti_object, "calib/0.txt", replaced(rb"P2: \S+", b"P2: 1e-320"), "P2 is not a pinhole camera"),
    (kitti_tracking, "velodyne/0.bin", scan(*[3e38, 0, 0, 1] * 3), "every point is NaN"),
    (kitti_object, "velodyne/0.bin", lambda old: old[:-7], "the scan is truncated: 47993 bytes.*; "),
    (kitti_object, "velodyne/0.bin", removed, r"missing; put 0\.bin beside the image 0"),
    (kitti_object, "velodyne/0.bin", scan(-5, 0, 0, 0.5), "none of its points lies in the image.*; "),
    (kitti_tracking, "calib.txt", replaced(rb"P2", b"P"), "P2 is missing.*; "),
    (kitti_tracking, "calib.txt", replaced(rb"P2: 7\.", b"P2: 7,"), "P2: '7,0*e.01' has a decimal comma; "),
    (kitti_raw, "calib_velo_to_cam.txt", replaced(rb"R: \S+", b"R: 0.9"), "pose is not a rotation"),
    (kitti_raw, "calib_velo_to_cam.txt", replaced(rb"T: ", b"T: 1 "), "must have 3 numb"),
    (kitti_raw, "calib_velo_to_cam.txt", removed, "the calibration is missing"),
    *((kitti_raw, "image_02/timestamps.txt", lambda _, time=time: time, "line 1 must")
      for time in (b"2011-02-31 13:02:25.9\n", b"1317042145\n")),
    (rgbd_folder, "color/0.png", lambda old: old[:-20], "the image is damaged or truncated.*; "),
    (rgbd_folder, "color/0.png", picture((6, WIDTH, 3), 1, np.uint8), "is 120 x 6 pixels, but the camera in.*; "),
    (rgbd_folder, "depth/0.png", picture((HEIGHT, WIDTH), 1, np.uint8), "8-bit with 1.*; "),
    (rgbd_folder, "depth/0.png", picture((HEIGHT, 9)), "the image is 9 x 40 pixels, but the col.*; "),
    (rgbd_folder, "depth/0.png", picture((HEIGHT, WIDTH), 0), "the cloud is empty.*; "),
    (rgbd_folder, "camera_intrinsic.json", removed, "missing; write width"),
    (rgbd_folder, "camera_intrinsic.json", replaced(rb"\[70[^]]+", b"[9, 0, 5, 0, 9, 4, 0, 0, 1"),
     "column by column"),
    (rgbd_folder, "camera_intrinsic.json", lambda _: b"[" * 200_000, "not a camera file"),
    (rgbd_folder, "camera_intrinsic.json", replaced(rb"500\.0", b"1e-320"), "depth_scale"),
    (rgbd_folder, "gravity.json", lambda _: b'{"up": [0, 0, 0]}', "up has length 0.*; "),
    (rgbd_folder, "gravity.json", lambda _: b'{"up": [1e308, 1e308, 0]}', "not a gravity file"),
    (cloud_folder, "camera_intrinsic.json", lambda old: re.sub(rb'(th|ht)": [0-9]+', rb'\1": 60000', old), "pixels"),
    (partial(sunrgbd_extracted, keys=("0", "1")), "calib/0.txt", removed, "the calibration is missing"),
    (sunrgbd_extracted, "calib/0.txt", lambda _: b"1 0 0 0 1 0 0 0 1\n", "must have two lines"),
    (sunrgbd_extracted, "calib/0.txt", lambda _: b"1 0 0 0 1 0 0 0 2\n1 0 0 0 1 0 0 0 1", "the tilt is not a rotation"),
    (sunrgbd_extracted, "depth/0.mat", lambda _: b"", "is not a MATLAB file"),
    (partial(sunrgbd_extracted, clouds="points"), "points/0.npz", lambda _: b"", "the file is empty"),
    (made.sunrgbd_scene, "extrinsics/20160101.txt", lambda _: b"1 2 3", "must have 12 numbers"),
    (made.sunrgbd_scene, "depth/0000048.png", picture((39, 60)), "the image"),
    (made.sunrgbd_scene, "depth/0000048.png", picture((40, 60), 0), "no pixel has a depth"),
    (made.tum_rgbd, "rgb.txt", replaced(rb"\n1305031102", b"\nx"), r"rgb\.txt:4: 'x.*' is no time in seconds"),
    (made.tum_rgbd, "depth.txt", replaced(rb"\.png", b".exr"), r"depth\.txt:4: must be a time and a PNG"),
    (made.tum_rgbd, "rgb/1305031102.000000.png", removed, "cannot be read"),
    (made.record3d, "metadata", described(K=[1, 0, 5, 0, 1, 5, 0, 0, 1], perFrameIntrinsicCoeffs=[]),
     "column by column"),
    (made.stray_scanner, "odometry.csv", replaced(b"qw", b"w"), "csv:1: must name the columns"),
    (made.stray_scanner, "odometry.csv", replaced(b"000001", b"000000"), "csv:3: frame '000000' is not a number"),
    (made.stray_scanner, "odometry.csv", replaced(b", 0.1, 0.2, 0.3, ", b", 0, 0, 0, 9"), "line 2: qx qy qz qw is not"),
]  # fmt: skip


@pytest.mark.parametrize(("build", "name", "change", "complaint"), KNOWN_CASES)
def test_known_cases_are_errors(
    tmp_path: Path, build: Callable[[Path], object], name: str, change: Change, complaint: str
):
    build(tmp_path)
    file = tmp_path / name
    content = change(file.read_bytes())
    assert content != file.read_bytes()
    if content is None:
        file.unlink()
    else:
        file.write_bytes(content)
    with pytest.raises(RecordingError, match=complaint) as caught:
        open_recording(tmp_path).frame(0)
    assert str(caught.value).startswith(f"{file}:")


FILES: list[tuple[Callable[[Path], None], list[str]]] = [
    (made.rcv, ["labels/take-0.json", "images/take-0.png", "clouds/take-0.ply"]),
    (made.argoverse2, ["sensors/lidar/1532402927000000000.feather", "sensors/cameras/*/1532402927012000000.png"]),
    (made.stray_scanner, ["depth/000000.png", "confidence/000000.png"]),
    (made.sunrgbd_scene, ["intrinsics.txt", "extrinsics/*", "image/*", "depth/*"]),
    (made.cloud_folder, ["0.bin"]),
]


@pytest.mark.parametrize(("build", "names"), FILES)
def test_a_frame_has_these_files_and_an_empty_one_is_seen(
    tmp_path: Path, build: Callable[[Path], None], names: list[str]
):
    folder = tmp_path / "take"
    folder.mkdir()
    build(folder)
    recording = open_recording(folder)
    assert isinstance(recording, Recording)
    files = recording.files(0)
    found = [file.relative_to(folder).as_posix() for file in files]
    assert len(found) == len(names) and all(map(fnmatch, found, names))
    assert broken_frames(recording, seconds=-1).errors == {}
    np.testing.assert_array_equal(recording.image(0), recording.frame(0).rgb)
    for file in files:
        content = file.read_bytes()
        file.write_bytes(b"")
        # not from a cache of what was there before
        assert list(broken_frames(open_recording(folder), seconds=-1).errors) == [recording.keys[0]], file
        file.write_bytes(content)


EPOCH, STEP = 1_700_000_000_000_000_000, 100_000_000
TABLE = [
    pytest.param((0, STEP, 2 * STEP), (0, STEP, 2 * STEP), id="start"),
    pytest.param((0, 0, 0), (None, None, None), id="all"),
    pytest.param((0,), (None,), id="only"),
    pytest.param((EPOCH, 0, EPOCH + STEP), (EPOCH, None, EPOCH + STEP), id="one"),
    pytest.param((0, EPOCH, EPOCH + STEP), (None, EPOCH, EPOCH + STEP), id="first"),
    pytest.param((0, None, STEP), (None, None, STEP), id="before a gap"),
]


@pytest.mark.parametrize(("written", "known"), TABLE)
def test_times_of_0_are_unknown(tmp_path: Path, written: tuple[int | None, ...], known: tuple[int | None, ...]):
    assert known_times(written) == known
    lines = [f"{key},{time}\n" for key, time in enumerate(written) if time is not None]
    (tmp_path / "timestamps.csv").write_text("key,timestamp_ns\n" + "".join(lines))
    for key in range(len(written)):
        np.save(tmp_path / f"{key}.npy", np.random.default_rng(key).uniform(2, 9, (20, 3)))
    recording = open_recording(tmp_path)
    assert tuple((recorded_times(recording) or {}).values()) == known
    assert tuple(recording.frame(i).timestamp_ns for i in range(len(written))) == known
    assert has_times(recording) == (sum(time is not None for time in known) > 1)
    told = [note for note in recording.notes if "which is taken as unknown" in note]
    assert len(told) == (written != known)


# Unit in nanoseconds, frames per second, start in seconds, and the step that is told; None: they are read.
UNITS = [
    *((unit, rate, start, 1e9 / rate / unit) for unit in (10**9, 10**3) for rate, start in ((1, 1.7e9), (25, 0.5))),
    # nanoseconds, also of a computer that has run for 20 days, and of fast sensors
    *((1, rate, start, None) for rate, start in ((0.1, 0.5), (30, 20 * 86_400), (500, 1.7e9))),
]


@pytest.mark.parametrize(("unit_ns", "rate", "start_s", "step"), UNITS)
def test_times_in_another_unit_are_refused(
    tmp_path: Path, unit_ns: int, rate: float, start_s: float, step: float | None
):
    times = {f"{n:02}": (round(start_s * 1e9) + n * round(1e9 / rate)) // unit_ns for n in range(40)}
    rows = "".join(f"{key},{time}\n" for key, time in times.items())
    (tmp_path / "timestamps.csv").write_text(f"key,timestamp_ns\n{rows}")
    if step is None:
        assert read_times(tmp_path, [*times]) == (tuple(times.values()), ())
        return
    with pytest.raises(
        RecordingError,
        match=rf"timestamps\.csv: the times are {re.escape(f'{max(step, 1):g}')} ns .*so their unit is probably",
    ):
        read_times(tmp_path, [*times])


def test_lists_of_tum_without_times_are_an_error(tmp_path: Path):
    for name in ("rgb", "depth"):
        (tmp_path / f"{name}.txt").write_text(f"0 {name}/1.png\n0.0 {name}/2.png\n1 {name}/3.png\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt: the time of 2 images is 0"):
        open_recording(tmp_path)


PICTURE = np.random.default_rng(3).integers(0, 255, (40, 56, 3)).astype(np.uint8)
BASELINE = cv2.imencode(".jpg", PICTURE)[1].tobytes()
PROGRESSIVE = cv2.imencode(".jpg", PICTURE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
RESTARTS = cv2.imencode(".jpg", PICTURE, [cv2.IMWRITE_JPEG_RST_INTERVAL, 2])[1].tobytes()
PNG = cv2.imencode(".png", PICTURE)[1].tobytes()
PICTURES = {"baseline": BASELINE, "progressive": PROGRESSIVE, "restarts": RESTARTS, "png": PNG}


@pytest.mark.parametrize("kind", PICTURES)
def test_complete_files_are_accepted_also_with_trailing_bytes(kind: str):
    for data in (PICTURES[kind], PICTURES[kind] + b"\0appended by a camera"):
        assert decode_image(data, cv2.IMREAD_COLOR).shape == PICTURE.shape


@settings(deadline=None)
@given(st.sampled_from(sorted(PICTURES)), st.data())
def test_a_file_cut_anywhere_is_refused(kind: str, data: st.DataObject):
    whole = PICTURES[kind]
    with pytest.raises(ValueError, match=r"is damaged or truncated|cannot be decoded"):
        decode_image(whole[: data.draw(st.integers(9, len(whole) - 1))], cv2.IMREAD_COLOR)


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_image():
    # an application segment may hold a whole small JPEG, end marker included
    thumbnail = b"\xff\xe1" + (2 + 6).to_bytes(2, "big") + b"AB\xff\xd8\xff\xd9"
    with_thumbnail = BASELINE[:2] + thumbnail + BASELINE[2:]
    decode_image(with_thumbnail, cv2.IMREAD_COLOR)
    with pytest.raises(ValueError, match="is damaged or truncated"):
        decode_image(with_thumbnail[:-2], cv2.IMREAD_COLOR)


@settings(deadline=None)
@given(st.integers(8, len(PNG) - 13), st.integers(1, 255))
def test_any_changed_byte_of_a_png_is_detected(at: int, flip: int):
    data = bytearray(PNG)
    data[at] ^= flip
    with pytest.raises(ValueError, match=r"damaged|cannot be decoded|pixels"):
        decode_image(bytes(data), cv2.IMREAD_COLOR)


ODD = [
    cv2.imencode(".tiff", PICTURE)[1].tobytes(),
    b"BM" + struct.pack("<IIIIiiHHIIiiII", 54, 0, 54, 40, 15_000, 15_000, 1, 24, 0, 0, 0, 0, 0, 0),
    # after a marker without a length, decoders and parsers that skip segments find different headers
    BASELINE[:2] + b"\xff\x01\0\4AB" + BASELINE[2:],
]


@pytest.mark.parametrize("content", ODD, ids=["tiff", "large-bmp", "marker"])
def test_other_formats_are_refused_despite_their_suffix(tmp_path: Path, content: bytes):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(FrameError, match=r"a\.png: cannot be decoded as a PNG or JPEG image"):
        read_color_image(tmp_path / "a.png")


def test_a_jpeg_of_too_many_pixels_is_refused():
    at, side = BASELINE.index(b"\xff\xc0"), int(most_pixels() ** 0.5)
    data = BASELINE[: at + 5] + struct.pack(">HH", side + 1, side) + BASELINE[at + 9 :]
    with pytest.raises(ValueError, match=f"{side} x {side + 1} pixels is too large: .* ANNOTATOR_FRAME_MEMORY"):
        decode_image(data, cv2.IMREAD_COLOR)


@pytest.mark.shared
def test_real_images_are_complete(shared: Path):
    files = [path for path in (shared / "data").rglob("*") if path.suffix in (".png", ".jpg")]
    assert len(files) > 100
    for path in files:
        decode_image(path.read_bytes(), cv2.IMREAD_UNCHANGED)


COLOR = np.random.default_rng(5).integers(0, 256, (8, 12, 3)).astype(np.uint8)
COLOR[0, 0] = 255


def rgbd(folder: Path, colors: list[np.ndarray]) -> Path:
    depth = np.full(COLOR.shape[:2], 2000, np.uint16)
    return write_rgbd(folder, {str(number): (color, depth) for number, color in enumerate(colors)})


DEEP = [(8, 3), (10, 1), (12, 3), (16, 1)]


def deep(bits: int, channels: int) -> np.ndarray:
    """The colours in numbers of 16 bits that use so many."""
    values = np.floor(COLOR * ((2**bits - 1) / 255) + 0.5).astype(np.uint16)
    return values if channels == 3 else values[:, :, 0]


def shallow(channels: int) -> np.ndarray:
    return COLOR if channels == 3 else np.repeat(COLOR[:, :, :1], 3, axis=2)


@pytest.mark.parametrize(("bits", "channels"), DEEP)
def test_pictures_of_10_to_16_bits_have_their_own_range(tmp_path: Path, bits: int, channels: int):
    frame = open_recording(rgbd(tmp_path, [deep(bits, channels)])).frame(0)
    np.testing.assert_array_equal(frame.rgb, shallow(channels))
    assert frame.cloud.rgb is not None


def test_one_range_is_that_of_all_pictures(tmp_path: Path):
    """12 bits; the dark picture uses four."""
    dark = 1
    pictures = [deep(12, 3)] * 3
    pictures[dark] = np.full_like(pictures[0], 15)
    recording = open_recording(rgbd(tmp_path, pictures))
    for number in (2, 0, 1):
        np.testing.assert_array_equal(recording.frame(number).rgb, np.zeros_like(COLOR) if number == dark else COLOR)
