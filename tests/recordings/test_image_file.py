"""Images: complete ones are accepted, damaged and large ones are not; depths that are none; more than 8 bits."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rgbd_samples import write_rgbd

from annotator.frame_limits import most_pixels
from annotator.image_bytes import decode_image
from annotator.recordings import open_recording
from annotator.recordings.image_file import read_color_image
from annotator.types.errors import FrameError

PICTURE = np.random.default_rng(3).integers(0, 255, (40, 56, 3)).astype(np.uint8)
BASELINE = cv2.imencode(".jpg", PICTURE)[1].tobytes()
PROGRESSIVE = cv2.imencode(".jpg", PICTURE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
RESTARTS = cv2.imencode(".jpg", PICTURE, [cv2.IMWRITE_JPEG_RST_INTERVAL, 2])[1].tobytes()
PNG = cv2.imencode(".png", PICTURE)[1].tobytes()
FILES = {"baseline": BASELINE, "progressive": PROGRESSIVE, "restarts": RESTARTS, "png": PNG}


@pytest.mark.parametrize("kind", FILES)
def test_complete_files_are_accepted_also_with_trailing_bytes(kind: str):
    for data in (FILES[kind], FILES[kind] + b"\0appended by a camera"):
        assert decode_image(data, cv2.IMREAD_COLOR).shape == PICTURE.shape


@settings(deadline=None)
@given(st.sampled_from(sorted(FILES)), st.data())
def test_a_file_cut_anywhere_is_refused(kind: str, data: st.DataObject):
    whole = FILES[kind]
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
