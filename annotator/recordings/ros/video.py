"""Pictures of a video topic (`foxglove.CompressedVideo`), decoded by PyAV from the last key frame on.

Each message has the bytes of one picture, without pictures that depend on later ones (Foxglove's schema).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import UInt8

from annotator.frame_limits import most_pixels
from annotator.recordings.ros.bag import Topic
from annotator.recordings.ros.h264 import KEY_SLICE, lost_before, nal_units
from annotator.recordings.ros.messages import byte_array, message
from annotator.recordings.video_file import STRICT, STRICTEST

CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "libdav1d"}
# Encoders put a key frame every few seconds.
MOST_BACK = 600


def video_image(topic: Topic, i: int, content: Any) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the picture of message `i`, whose decoded `content` is given, RGB order.

    Raises:
        ValueError: it cannot be decoded.
    """
    import av

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
    if form == "h264" and lost_before(packets) is not None:
        raise ValueError("a picture of its video is lost since the last key frame, and those after it depend on it")
    pictures = []
    try:
        decoder: Any = av.CodecContext.create(CODECS[form], "r")
        decoder.options = {
            "err_detect": STRICTEST if CODECS[form] == "hevc" else STRICT,
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
        return _has_sequence_header(data)
    heads = [head for head, _ in nal_units(data)]
    if form == "h264":
        return any(head & 31 == KEY_SLICE for head in heads)
    return any(16 <= head >> 1 & 63 <= 21 for head in heads)


def _has_sequence_header(data: bytes) -> bool:
    """True if a temporal unit of AV1 has a sequence header, which every key frame needs (AV1 specification, 5.3)."""
    at = 0
    while at < len(data):
        kind, has_extension, has_size = data[at] >> 3 & 15, data[at] & 4, data[at] & 2
        if kind == 1:
            return True
        if not has_size:
            return False
        at += 2 if has_extension else 1
        size = shift = 0
        while at < len(data):
            size |= (data[at] & 127) << shift
            shift += 7
            at += 1
            if not data[at - 1] & 128:
                break
        at += size
    return False
