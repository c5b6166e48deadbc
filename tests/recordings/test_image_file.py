"""Complete images are accepted; images truncated at any place are not."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.frame_limits import most_pixels
from annotator.image_bytes import decode_image, image_problem
from annotator.recordings.image_file import read_rgb
from annotator.types.errors import FrameError

PICTURE = np.random.default_rng(3).integers(0, 255, (40, 56, 3)).astype(np.uint8)
BASELINE = cv2.imencode(".jpg", PICTURE)[1].tobytes()
PROGRESSIVE = cv2.imencode(".jpg", PICTURE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
RESTARTS = cv2.imencode(".jpg", PICTURE, [cv2.IMWRITE_JPEG_RST_INTERVAL, 2])[1].tobytes()
PNG = cv2.imencode(".png", PICTURE)[1].tobytes()
FILES = {"baseline": BASELINE, "progressive": PROGRESSIVE, "restarts": RESTARTS, "png": PNG}


@pytest.mark.parametrize("kind", FILES)
def test_complete_files_are_accepted_also_with_trailing_bytes(kind: str):
    assert image_problem(FILES[kind]) == ""
    assert image_problem(FILES[kind] + b"\0appended by a camera") == ""


@settings(deadline=None)
@given(st.sampled_from(sorted(FILES)), st.data())
def test_a_file_cut_anywhere_is_truncated(kind: str, data: st.DataObject):
    whole = FILES[kind]
    length = data.draw(st.integers(9, len(whole) - 1))
    assert image_problem(whole[:length]).endswith("truncated")


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_image():
    # an application segment may hold a whole small JPEG, end marker included
    thumbnail = b"\xff\xe1" + (2 + 6).to_bytes(2, "big") + b"AB\xff\xd8\xff\xd9"
    with_thumbnail = BASELINE[:2] + thumbnail + BASELINE[2:]
    assert image_problem(with_thumbnail) == ""
    assert image_problem(with_thumbnail[:-2]) == "the JPEG image is truncated"


@settings(deadline=None)
@given(st.integers(8, len(PNG) - 1), st.integers(1, 255))
def test_any_changed_byte_of_a_png_is_detected(at: int, flip: int):
    data = bytearray(PNG)
    data[at] ^= flip
    assert image_problem(bytes(data))


def test_a_missing_image_is_named(tmp_path: Path):
    with pytest.raises(FrameError, match=r"nothing\.png: cannot be read"):
        read_rgb(tmp_path / "nothing.png")


def bmp_header(width: int, height: int) -> bytes:
    """The first bytes of a file of another format, which OpenCV decodes."""
    return b"BM" + struct.pack("<IIIIiiHHIIiiII", 54, 0, 54, 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    "content",
    [cv2.imencode(suffix, PICTURE)[1].tobytes() for suffix in (".tiff", ".bmp", ".webp")]
    + [
        bmp_header(15_000, 15_000),
        # after a marker without a length, decoders and parsers that skip segments find different headers
        BASELINE[:2] + b"\xff\x01\0\4AB" + BASELINE[2:],
    ],
    ids=["tiff", "bmp", "webp", "large", "marker"],
)
def test_other_formats_are_refused_despite_their_suffix(tmp_path: Path, content: bytes):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(FrameError, match=r"a\.png: cannot be decoded as a PNG or JPEG image"):
        read_rgb(tmp_path / "a.png")


def test_a_jpeg_of_too_many_pixels_is_refused():
    at = BASELINE.index(b"\xff\xc0")
    side = int(most_pixels() ** 0.5)
    for height, refused in ((side + 1, True), (40, False)):
        data = BASELINE[: at + 5] + struct.pack(">HH", height, side if refused else 56) + BASELINE[at + 9 :]
        if refused:
            with pytest.raises(ValueError, match=f"{side} x {height} pixels is too large: .* ANNOTATOR_FRAME_MEMORY"):
                decode_image(data, cv2.IMREAD_COLOR)
        else:
            assert decode_image(data, cv2.IMREAD_COLOR).shape == PICTURE.shape


@pytest.mark.shared
def test_real_images_are_complete(shared: Path):
    files = [path for path in (shared / "data").rglob("*") if path.suffix in (".png", ".jpg")]
    assert len(files) > 100
    assert [path for path in files if image_problem(path.read_bytes())] == []
