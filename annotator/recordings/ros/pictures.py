"""Pictures from messages: `Image`, `CompressedImage`, and the forms of Foxglove, also of a video.

Encodings: `sensor_msgs/image_encodings.hpp`; `compressedDepth`: `compressed_depth_image_transport` (a header of twelve
bytes, then PNG or RVL; floats are quantised inverse depths).

RVL (A. D. Wilson, "Fast Lossless Depth Image Compression", ISS 2017, Figure 3): a picture is a list of numbers: how
many zeros follow, how many depths follow, and each depth as the difference to the one before. A number is written in
groups of three bits, lowest first, each with a fourth bit that says whether another group follows; eight such groups
are a little-endian word, the first one in its highest bits.

Each message of a video topic (`foxglove.CompressedVideo`) has the bytes of one picture, without pictures that depend
on later ones. PyAV decodes it from the last key frame on. The decoder of H.264 replaces a lost picture by another one,
and all up to the next key frame are made up: it only logs that. The log is one for all threads of a process, and a
decoder of another thread that logs can stop them all, so it runs in the `fence`.
"""

from __future__ import annotations

import re
import struct
from contextlib import suppress
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from annotator.fence import fenced
from annotator.frame_limits import most_pixels, require_pixels
from annotator.geometry.projection import in_metres
from annotator.image_bytes import decode_image
from annotator.recordings.image_file import (
    STRICT,
    STRICTEST,
    Levels,
    contrast_levels,
    depth_levels,
    pixels_as_eight_bits,
)
from annotator.recordings.ros.bag import Topic
from annotator.recordings.ros.messages import FIELD_ERRORS, byte_array, message

# columns and rows, which `compressed_depth_image_transport` writes before the words
RVL_HEAD_BYTES = 8
LONGEST_NUMBER = 7


def decode_rvl(data: bytes) -> UInt16[np.ndarray, "h w"]:
    """Returns the depths of an RVL picture with its size before it."""
    width, height = np.frombuffer(data[:RVL_HEAD_BYTES], "<u4").tolist() if len(data) >= RVL_HEAD_BYTES else (0, 0)
    require_pixels(width, height, give_points=True)
    numbers = _numbers(data[RVL_HEAD_BYTES:])
    deltas = np.zeros(width * height, np.int64)
    is_depth = np.zeros(width * height, bool)
    at = pixel = 0
    while pixel < len(deltas):
        if at + 2 > len(numbers):
            raise ValueError("its RVL picture is truncated")
        zeros, depths = int(numbers[at]), int(numbers[at + 1])
        start, end = pixel + zeros, pixel + zeros + depths
        if end > len(deltas) or at + 2 + depths > len(numbers) or end == pixel:
            raise ValueError("its RVL picture is damaged or truncated")
        coded = numbers[at + 2 : at + 2 + depths]
        deltas[start:end] = (coded >> 1) ^ -(coded & 1)
        is_depth[start:end] = True
        at, pixel = at + 2 + depths, end
    return np.where(is_depth, np.cumsum(deltas), 0).astype(np.uint16).reshape(height, width)


def _numbers(data: bytes) -> np.ndarray:
    words = np.frombuffer(data[: len(data) // 4 * 4], "<u4")
    groups = (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32) & 15).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(groups < 8)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if len(ends) == 0 or (ends - starts).max() > LONGEST_NUMBER:
        raise ValueError("its RVL picture is damaged")
    groups = groups[: ends[-1] + 1]
    place = np.arange(len(groups)) - np.repeat(starts, ends - starts + 1)
    return np.add.reduceat((groups & 7) << 3 * place, starts)


# bytes per value and channels of the encodings without colour conversion
PLAIN: dict[str, tuple[str, int]] = {
    "rgb8": ("u1", 3), "bgr8": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono8": ("u1", 1),
    "8UC1": ("u1", 1), "8UC3": ("u1", 3), "8UC4": ("u1", 4), "mono16": ("u2", 1), "16UC1": ("u2", 1),
    "rgb16": ("u2", 3), "bgr16": ("u2", 3), "32FC1": ("f4", 1),
}  # fmt: skip
# OpenCV names a Bayer pattern by its second row, ROS by its first.
BAYER = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
YUV422 = dict.fromkeys(("yuv422", "uyvy", "yuv422_uyvy"), "UYVY") | dict.fromkeys(
    ("yuv422_yuy2", "yuyv", "yuy2"), "YUY2"
)
DEPTH_ENCODINGS = ("16UC1", "32FC1", "mono16")
COMPRESSED_DEPTH = "compressedDepth"
DEPTH_HEAD = struct.Struct("<iff")


def describe(content: Any, topic: str) -> tuple[str, tuple[int, int], bool]:
    """Returns an image message's encoding, width and height, and whether it is depth, as 16-bit grey of some topics is.

    A compressed one may not name its encoding (""), and only its bytes know its size (0).
    """
    if not hasattr(content, "encoding"):
        encoding = str(content.format).partition(";")[0].strip()
        return encoding, (0, 0), COMPRESSED_DEPTH in str(content.format) or encoding in DEPTH_ENCODINGS[:2]
    encoding, name = str(content.encoding), topic.lower()
    is_depth = encoding == "32FC1" or (encoding == "16UC1" and "infra" not in name and "/ir" not in name)
    is_depth = is_depth or (encoding == "mono16" and "depth" in name)
    return encoding, (int(content.width), int(content.height)), is_depth


def color_image(content: Any, first: tuple[Topic, tuple[int, ...]] | None = None) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the picture of an image message, RGB order.

    `first`: its topic and the numbers of the first messages, whose levels hold for all pictures of more than 8 bits.
    """
    rgb, own = _decoded(content)
    if own is not None:
        rgb = pixels_as_eight_bits(rgb, own if first is None else own.with_all(_levels_of(*first)))
    return np.ascontiguousarray(rgb) if rgb.shape[2] == 3 else np.repeat(rgb, 3, axis=2)


@lru_cache(maxsize=16)
def _levels_of(topic: Topic, numbers: tuple[int, ...]) -> list[Levels]:
    found = []
    for number in numbers:
        # one that is damaged is told by its own frame
        with suppress(*FIELD_ERRORS, OSError):
            found.append(_decoded(message(topic, number))[1])
    return [each for each in found if each is not None]


def _decoded(content: Any) -> tuple[np.ndarray, Levels | None]:
    """Returns the picture of an image message, RGB order or grey, and its levels; None for one of 8 bits."""
    import cv2

    encoding, is_grey = str(getattr(content, "encoding", "")), False
    if not hasattr(content, "encoding"):
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        rgb = decode_image(byte_array(content.data).tobytes(), flags)[:, :, ::-1]
        is_grey = rgb.dtype == np.uint16 and bool((rgb == rgb[:, :, :1]).all())
    elif encoding.startswith("bayer_") and encoding[6:10] in BAYER:
        values = _values(content, "u2" if encoding.endswith("16") else "u1", 1)
        rgb = cv2.cvtColor(values, getattr(cv2, f"COLOR_Bayer{BAYER[encoding[6:10]]}2RGB"))
    elif encoding.lower() in YUV422:
        rgb = cv2.cvtColor(_values(content, "u1", 2), getattr(cv2, f"COLOR_YUV2RGB_{YUV422[encoding.lower()]}"))
    elif encoding in PLAIN and encoding != "32FC1":
        values, is_grey = _values(content, *PLAIN[encoding]), encoding in ("mono16", "16UC1")
        is_bgr = values.shape[2] > 1 and encoding.startswith(("bgr", "8UC"))
        rgb = values[:, :, 2::-1] if is_bgr else values[:, :, :3]
    else:
        known = ", ".join([*PLAIN, *(f"bayer_{pattern}8" for pattern in BAYER), *YUV422])
        raise ValueError(f"has the encoding {encoding!r}, which is not a picture's; known are {known}")
    return rgb, None if rgb.dtype == np.uint8 else contrast_levels(rgb) if is_grey else depth_levels(rgb)


def depth_image(content: Any, unit_m: float | None = None) -> Float32[np.ndarray, "h w"]:
    """Returns the depths of an image message, metres; 0 = none. `unit_m`: of whole numbers; None = millimetres."""
    if hasattr(content, "encoding"):
        encoding = str(content.encoding)
        if encoding not in DEPTH_ENCODINGS:
            raise ValueError(f"has the encoding {encoding!r}, which is not depth (16UC1, mono16 or 32FC1)")
        values = _values(content, *PLAIN[encoding])[:, :, 0]
    else:
        values = _compressed_depth(str(content.format), byte_array(content.data).tobytes())
    if values.dtype.kind == "f":
        return in_metres(values, 1.0)
    return in_metres(values, 1000.0) if unit_m is None else in_metres(values, 1.0) * np.float32(unit_m)


def _compressed_depth(form: str, data: bytes) -> np.ndarray:
    import cv2

    start = DEPTH_HEAD.size if COMPRESSED_DEPTH in form else 0
    if start and len(data) < start:
        raise ValueError("its compressed depth is truncated")
    values = decode_rvl(data[start:]) if "rvl" in form.lower() else decode_image(data[start:], cv2.IMREAD_UNCHANGED)
    if values.ndim != 2 or values.dtype != np.uint16:
        raise ValueError("its picture has no 16-bit depths")
    if not form.startswith("32FC1"):
        return values
    _, quantum, offset = DEPTH_HEAD.unpack_from(data)
    with np.errstate(all="ignore"):
        inverse = np.float32(quantum) / (values.astype(np.float32) - np.float32(offset))
    return np.where(values > 0, inverse, np.float32(0))


def _values(content: Any, kind: str, channels: int) -> np.ndarray:
    """Returns the pixels, (h, w, channels), without the padding of the rows."""
    width, height, step = int(content.width), int(content.height), int(content.step)
    size = np.dtype(kind).itemsize * channels
    data = byte_array(content.data)
    require_pixels(width, height)
    step = step or width * size
    if step < width * size or len(data) < step * (height - 1) + width * size:
        raise ValueError(
            f"contradicts itself: {width} x {height} pixels of {content.encoding} in rows of {step} bytes do not fit "
            f"its {len(data)} bytes"
        )
    own = np.dtype((">" if getattr(content, "is_bigendian", 0) else "<") + kind)
    values = np.ndarray((height, width, channels), own, data, 0, (step, own.itemsize * channels, own.itemsize))
    return np.ascontiguousarray(values, np.dtype(kind))


# The first byte of each NAL unit; of H.264, its lower bits are 5 for a slice of a key frame.
NAL_UNIT, KEY_SLICE = re.compile(rb"\x00\x00\x01(.)", re.DOTALL), 5
AV1_DELIMITER = b"\x12\0"
# What the decoder of H.264 logs where pictures are missing.
LOST = ("Frame num gap", "reference picture missing", "Missing reference picture")
CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "libdav1d"}
# Encoders put a key frame every few seconds.
MOST_BACK = 600


def video_image(topic: Topic, i: int, content: Any) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the picture of message `i`, whose decoded `content` is given, RGB order."""
    form = str(content.format).lower()
    if form not in CODECS:
        raise ValueError(f"has the unknown video format {form!r}; known are {', '.join(CODECS)}")
    data = byte_array(content.data).tobytes()
    packets = [data]
    for before in range(i - 1, max(i - MOST_BACK, -1), -1):
        if is_key_frame(form, packets[-1]):
            break
        packets.append(byte_array(message(topic, before).data).tobytes())
    if not is_key_frame(form, packets[-1]):
        raise ValueError(f"has no key frame among the {len(packets)} pictures before it")
    packets.reverse()
    return np.asarray(fenced(f"{__name__}:decode_last", CODECS[form], packets))


def decode_last(codec: str, packets: list[bytes]) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the picture of the last packet, in this process, whose decoders then log everything."""
    import av.logging

    av.logging.set_level(av.logging.DEBUG)
    pictures = []
    try:
        with av.logging.Capture() as logged:
            decoder: Any = av.CodecContext.create(codec, "r")
            decoder.options = {
                "err_detect": STRICTEST if codec == "hevc" else STRICT,
                "max_pixels": str(most_pixels()),
            }
            for number, packet in enumerate([*packets, None], 1):
                encoded = None if packet is None else av.Packet(packet)
                if encoded is not None:
                    encoded.pts = number
                # only the last one is kept
                for picture in decoder.decode(encoded):
                    pictures = [picture]
                    if picture.is_corrupt:
                        raise ValueError("a picture is incomplete")
    except (av.FFmpegError, ValueError) as error:
        raise ValueError(f"its video cannot be decoded ({error})") from error
    if any(words in text for _, _, text in logged for words in LOST):
        raise ValueError("a picture of its video is lost since the last key frame, and those after it depend on it")
    # of a message without a picture, an earlier one would be shown
    if not pictures or pictures[-1].pts != len(packets):
        raise ValueError("its video has no picture here")
    return np.asarray(pictures[-1].to_ndarray(format="rgb24"))


def is_key_frame(form: str, data: bytes) -> bool:
    """True if a picture can be decoded without those before it."""
    if form == "vp9":
        # 2 bits marker, 2 profile, in profile 3 one more, then: shows an existing frame, is no key frame
        return bool(data) and data[0] >> 6 == 2 and not data[0] & (0x06 if data[0] & 0x30 == 0x30 else 0x0C)
    if form == "av1":
        # each key frame needs a sequence header (AV1 specification, 5.3), before all but a delimiter
        return data.removeprefix(AV1_DELIMITER)[:1] in (b"\x08", b"\x0a", b"\x0c", b"\x0e")
    heads = [unit[1][0] for unit in NAL_UNIT.finditer(data)]
    if form == "h264":
        return any(head & 31 == KEY_SLICE for head in heads)
    return any(16 <= head >> 1 & 63 <= 21 for head in heads)
