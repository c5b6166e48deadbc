"""The files of bags: which are one, what is missing, of any writer, unfinished and damaged; videos in them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bag_writer import IMAGE, MS, START_NS, BagWriter, K, seen_points, write_take
from foxglove_takes import WRITERS, foxglove_take, picture_take, write_mcap
from mcap.writer import CompressionType

from annotator.recordings import detect_format, open_recording
from annotator.recordings.ros import pairing, pictures
from annotator.recordings.ros.bag import Topic, open_bag
from annotator.types.errors import FrameError, RecordingError, UnknownFormatError


def test_a_folder_says_what_is_missing_or_counted_wrong(tmp_path: Path):
    with BagWriter(tmp_path, "mcap") as bag:
        write_take(bag)
    metadata = bag.path / "metadata.yaml"
    text = metadata.read_text()
    assert "message_count: 10" in text
    metadata.write_text(text.replace("message_count: 10", "message_count: 12"))
    assert open_recording(bag.path).notes == ("metadata.yaml declares 12 messages, but the files have 10",)
    metadata.write_text(text.replace("take_mcap.mcap", "other_0.mcap"))
    with pytest.raises(RecordingError, match=r"other_0\.mcap is missing"):
        open_recording(bag.path)
    for damaged in ("[1, 2", "rosbag2_bagfile_information: 2026-13-45"):
        metadata.write_text(damaged)
        with pytest.raises(RecordingError, match="is not the description of a bag"):
            open_recording(bag.path)
    metadata.write_text("rosbag2_bagfile_information: {relative_file_paths: 5}")
    assert len(open_recording(bag.path)) == 3
    metadata.unlink()
    assert "has no metadata.yaml" in open_recording(bag.path).notes[0]


def test_the_parts_of_a_recording_are_one_bag_and_other_files_are_not(tmp_path: Path):
    with BagWriter(tmp_path, "mcap") as bag:
        write_take(bag, 2)
    file = next(bag.path.glob("*.mcap"))
    whole = tmp_path / "whole"
    whole.mkdir()
    for i in range(11):
        shutil.copy(file, whole / f"take_{i}.mcap")
    opened = open_bag(whole)
    assert opened is not None and len(opened.topics["/points"]) == 22
    # two drives, a copy in another format, parts of which the second is missing
    for number, names in enumerate((("a.mcap", "b.mcap"), ("a_0.mcap", "a_0.db3"), ("a_0.mcap", "a_2.mcap"))):
        folder = tmp_path / f"several_{number}"
        folder.mkdir()
        for name in names:
            shutil.copy(file, folder / name)
        with pytest.raises(UnknownFormatError, match="contains recordings; give the path of one of them: a"):
            open_recording(folder)


def test_times_that_are_slow_to_read_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(pairing, "SLOW_S", -1.0)
    # bz2 is read by several threads
    monkeypatch.setattr(pairing.os, "cpu_count", lambda: 4)
    with BagWriter(tmp_path, "ros1", "bz2") as bag:
        write_take(bag)
    opened = open_bag(bag.path)
    assert opened is not None
    topic, expected = opened.topics["/points"], START_NS + np.arange(3) * 100 * MS
    np.testing.assert_array_equal(pairing.stamps_ns.__wrapped__(topic), expected)
    (file,) = pairing.cache_folder().iterdir()
    # the second time they are read from there, unless the file is damaged or the bag has changed
    with monkeypatch.context() as patched:
        patched.setattr(pairing, "quick_stamp_ns", lambda *_: pytest.fail("the bag is read"))
        np.testing.assert_array_equal(pairing.stamps_ns.__wrapped__(topic), expected)
    file.write_bytes(b"damaged")
    np.testing.assert_array_equal(pairing.stamps_ns.__wrapped__(topic), expected)
    bag.path.touch()
    pairing.stamps_ns.__wrapped__(topic)
    assert len(list(pairing.cache_folder().iterdir())) == 2


def cut(path: Path, share: float) -> None:
    with path.open("r+b") as opened:
        opened.truncate(int(path.stat().st_size * share))


def test_a_ros1_bag_without_its_index_is_refused_with_the_command_that_restores_it(tmp_path: Path):
    with BagWriter(tmp_path, "ros1") as bag:
        write_take(bag, 10)
    cut(bag.path, 0.6)
    with pytest.raises(RecordingError, match=r"has no index, or is damaged .*; run rosbag reindex take\.bag"):
        open_recording(bag.path)


def test_files_of_another_content_are_not_bags(tmp_path: Path):
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"no bag")
        assert detect_format(tmp_path / name) is None
    (tmp_path / "b.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    with pytest.raises(RecordingError, match=r"b\.db3: "):
        open_recording(tmp_path / "b.db3")


def test_damage_in_the_middle_loses_only_its_chunk(tmp_path: Path):
    with BagWriter(tmp_path, "mcap", "storage") as bag:
        write_take(bag, 400)
    file = next(bag.path.glob("*.mcap"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 400] = bytes(400)
    file.write_bytes(content)
    recording, readable = open_recording(bag.path), 0
    for i in range(len(recording)):
        try:
            readable += len(recording.frame(i).cloud) > 0
        except FrameError as error:
            assert str(error).startswith(str(bag.path))
    assert 200 < readable < len(recording) == 400


def test_nothing_is_read_from_a_chunk_with_a_wrong_checksum(tmp_path: Path):
    path = tmp_path / "a.mcap"
    moments = [(START_NS + i * 100 * MS, picture_take("protobuf")) for i in range(3)]
    write_mcap(path, "protobuf", moments, compression=CompressionType.LZ4)
    content = bytearray(path.read_bytes())
    # of the first chunk's record: its kind and size, two times, the size of its content
    content[content.index(b"lz4") - 8] ^= 1
    path.write_bytes(content)
    recording = open_recording(path)
    for i in range(3):
        with pytest.raises(FrameError, match="checksum"):
            recording.frame(i)


@pytest.mark.parametrize("how", WRITERS)
def test_a_cut_mcap_file_is_read_as_far_as_it_is_sound(tmp_path: Path, how: dict[str, Any]):
    path, moments = tmp_path / "a.mcap", []
    for i in range(40):
        picture = np.random.default_rng(i).integers(0, 256, IMAGE.shape, np.uint8)
        time_ns = START_NS + i * 20 * MS
        moments.append((time_ns, picture_take("protobuf", picture, time_ns)))
    write_mcap(path, "protobuf", moments, **{"chunk_size": 20_000} | how)
    cut(path, 0.6)
    recording = open_recording(path)
    assert "a.mcap was not closed by its recorder" in recording.notes[0]
    assert 15 < len(recording) < 40
    last = np.random.default_rng(len(recording) - 1).integers(0, 256, IMAGE.shape, np.uint8)
    np.testing.assert_array_equal(recording.frame(len(recording) - 1).rgb, last)


@pytest.mark.parametrize("how", WRITERS)
@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_messages_of_any_writer(tmp_path: Path, encoding: str, how: dict[str, Any]):
    path = tmp_path / "a.mcap"
    write_mcap(path, encoding, [(START_NS, picture_take(encoding))], **how)
    recording = open_recording(path)
    assert recording.notes == ()
    frame = recording.frame(0)
    np.testing.assert_array_equal(frame.rgb, IMAGE)
    np.testing.assert_allclose(frame.cloud.xyz_m, seen_points(), atol=1e-6)
    assert frame.timestamp_ns == START_NS
    np.testing.assert_array_equal(frame.camera.matrix, K)


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
    if hasattr(os, "sched_setscheduler"):
        # SVT-AV1 makes root's processes real-time ones, and so all that they start: on one core, nothing else would run
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
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
    topic = Topic("/video", "foxglove/CompressedVideo", (), np.empty(0))
    return pictures.video_image(topic, i, contents[i])


def test_pictures_of_h265_after_a_lost_one_are_errors_until_the_next_key_frame(monkeypatch: pytest.MonkeyPatch):
    """VP9 and AV1 do not number their pictures so that it can be told."""
    packets = encoded("h265", [40, 90, 140, 190, 60])
    del packets[1]
    for i in (1, 2):
        with pytest.raises(ValueError, match="its video cannot be decoded"):
            picture(monkeypatch, "h265", packets, i)
    for i, level in ((0, 40), (3, 60)):
        assert abs(picture(monkeypatch, "h265", packets, i).mean() - level) <= 4


def test_lost_pictures_of_h264_are_told(monkeypatch: pytest.MonkeyPatch):
    # a decoder of another thread that logs could stop all threads of this process
    monkeypatch.delattr("av.logging.set_level")
    # x264's numbers have 4 bits here, so they begin again; and pictures that are no references may be lost
    levels = [i * 7 for i in range(30)]
    packets = encoded("h264", levels, 30, 1, tune="psnr", **{"x264-params": "b-adapt=0:scenecut=0"})
    references = [i for i in range(1, 29) if packets[i].split(b"\0\0\1")[-1][0] & 0x60]
    assert 10 < len(references) < 20
    for lost in (None, 1, 2, 15, 16, 17, 28):
        left = [packet for i, packet in enumerate(packets) if i != lost]
        if lost in references:
            with pytest.raises(ValueError, match="is lost since the last key frame"):
                picture(monkeypatch, "h264", left, len(left) - 1)
        else:
            assert abs(picture(monkeypatch, "h264", left, len(left) - 1).mean() - levels[-1]) <= 6
