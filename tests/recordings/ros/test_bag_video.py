"""Video in bags: pictures are decoded from the last key frame, and none is made up."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from foxglove_takes import foxglove_take, write_mcap
from ros_takes import MS, START_NS

from annotator.recordings import open_recording
from annotator.recordings.ros import pictures
from annotator.recordings.ros.bag import Topic
from annotator.recordings.ros.pictures import lost_before

ENCODERS: dict[str, tuple[str, dict[str, str]]] = {
    "h264": ("libx264", {"tune": "zerolatency"}),
    "h265": ("libx265", {"tune": "zerolatency", "x265-params": "log-level=0"}),
    "vp9": ("libvpx-vp9", {"lag-in-frames": "0", "deadline": "realtime"}),
    "av1": ("libsvtav1", {"preset": "10", "svtav1-params": "pred-struct=1"}),
}


def encoded(form: str, levels: list[int], gop: int = 4, b_frames: int = 0, **options: str) -> list[bytes]:
    """A video of even pictures, one packet each."""
    import av

    codec, quick = ENCODERS[form]
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.framerate = 128, 96, "yuv420p", 10
    encoder.gop_size, encoder.max_b_frames = gop, b_frames
    encoder.options = quick | options
    packets: list[bytes] = []
    for level in [*levels, None]:
        frame = None if level is None else av.VideoFrame.from_ndarray(np.full((96, 128, 3), level, np.uint8), "rgb24")
        packets += [bytes(packet) for packet in encoder.encode(frame)]
    assert len(packets) == len(levels)
    return packets


@pytest.mark.parametrize("form", ENCODERS)
def test_video_is_decoded_from_the_last_key_frame(tmp_path: Path, form: str):
    levels = [20, 60, 100, 140, 180, 220]
    moments = []
    for i, packet in enumerate(encoded(form, levels)):
        time_ns = START_NS + i * 100 * MS
        take = foxglove_take("protobuf", {"data": packet, "format": form}, "foxglove.CompressedVideo", time_ns)
        take["/calibration"][1].update(width=128, height=96)
        moments.append((time_ns, take))
    path = tmp_path / "a.mcap"
    write_mcap(path, "protobuf", moments)
    recording = open_recording(path)
    assert len(recording) == len(levels)
    for i in (5, 0, 3, 4):
        assert abs(int(np.median(recording.frame(i).rgb)) - levels[i]) <= 4


def picture(monkeypatch: pytest.MonkeyPatch, form: str, packets: list[bytes], i: int) -> np.ndarray:
    """The picture of message `i` of a topic with these packets."""
    contents = [SimpleNamespace(data=packet, format=form) for packet in packets]
    monkeypatch.setattr(pictures, "message", lambda _, i: contents[i])
    none = np.empty(0, np.int64)
    return pictures.video_image(Topic("/video", "foxglove/CompressedVideo", (), none, none, none), i, contents[i])


@pytest.mark.parametrize("form", ["h264", "h265"])
def test_pictures_after_a_lost_one_are_errors_until_the_next_key_frame(monkeypatch: pytest.MonkeyPatch, form: str):
    """VP9 and AV1 do not number their pictures so that it can be told."""
    packets = encoded(form, [40, 90, 140, 190, 60])
    del packets[1]
    for i in (1, 2):
        with pytest.raises(ValueError, match=r"is lost since the last key frame|its video cannot be decoded"):
            picture(monkeypatch, form, packets, i)
    for i, level in ((0, 40), (3, 60)):
        assert abs(picture(monkeypatch, form, packets, i).mean() - level) <= 4


def test_pictures_made_up_from_damaged_video_are_errors(monkeypatch: pytest.MonkeyPatch):
    packets = encoded("h264", [40, 90, 140])
    packets[1] = packets[1][:-5]
    for i in (1, 2):
        with pytest.raises(ValueError, match="its video cannot be decoded"):
            picture(monkeypatch, "h264", packets, i)


def test_lost_pictures_of_h264_are_told_by_their_numbers():
    # x264's numbers have 4 bits here, so they begin again; with scaling lists, and pictures that are no references
    levels = [i * 7 for i in range(30)]
    plain = encoded("h264", levels, 30, **{"x264-params": "cqm=jvt"})
    skipping = encoded("h264", levels, 30, 1, tune="psnr", **{"x264-params": "b-adapt=0:scenecut=0"})
    for packets in (plain, skipping):
        assert lost_before(packets) is None
    for i in (1, 15, 16, 28):
        assert lost_before(plain[:i] + plain[i + 1 :]) == i
    references = [i for i in range(1, 29) if skipping[i].split(b"\0\0\1")[-1][0] & 0x60]
    assert 10 < len(references) < 20
    for i in range(1, 29):
        assert lost_before(skipping[:i] + skipping[i + 1 :]) == (i if i in references else None)
