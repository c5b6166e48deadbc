"""The containers of bags: MCAP of any writer, unfinished, cut and damaged files."""

from __future__ import annotations

import base64
import json
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer
from ros_takes import IMAGE, MS, POINTS_M, SIZE, START_NS, T_CAMERA_LIDAR, K, seen_points, write_take

from annotator.recordings import detect_format, open_recording
from annotator.recordings.ros import decode, kept_times, pairing, video
from annotator.recordings.ros.bag import Topic
from annotator.recordings.ros.chunks import KEPT, MOST_KEPT_BYTES, Chunk, Chunks, unpack
from annotator.recordings.ros.files import open_bag
from annotator.recordings.ros.h264 import lost_before
from annotator.types.errors import FrameError, MissingExtraError, RecordingError, UnknownFormatError
from benchmarks.bag_writer import CONTAINERS, BagWriter

SECOND = 10**9
DOUBLE, FIXED32, BYTES, STRING, MESSAGE, INT64, INT32 = 1, 7, 12, 9, 11, 3, 5
REPEATED = 3
# names and numbers of fields as in Foxglove's schemas
SCHEMAS: dict[str, list[tuple[int, str, int, str]]] = {
    "google.protobuf.Timestamp": [(1, "seconds", INT64, ""), (2, "nanos", INT32, "")],
    "foxglove.Vector3": [(1, "x", DOUBLE, ""), (2, "y", DOUBLE, ""), (3, "z", DOUBLE, "")],
    "foxglove.Quaternion": [(number, name, DOUBLE, "") for number, name in enumerate("xyzw", 1)],
    "foxglove.Pose": [(1, "position", MESSAGE, "foxglove.Vector3"), (2, "orientation", MESSAGE, "foxglove.Quaternion")],
    "foxglove.PackedElementField": [(1, "name", STRING, ""), (2, "offset", FIXED32, ""), (3, "type", INT32, "")],
    "foxglove.CompressedImage": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"), (4, "frame_id", STRING, ""),
                                 (2, "data", BYTES, ""), (3, "format", STRING, "")],
    "foxglove.CompressedVideo": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"), (2, "frame_id", STRING, ""),
                                 (3, "data", BYTES, ""), (4, "format", STRING, "")],
    "foxglove.CameraCalibration": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"), (9, "frame_id", STRING, ""),
                                   (2, "width", FIXED32, ""), (3, "height", FIXED32, ""),
                                   (4, "distortion_model", STRING, ""), (5, "D", DOUBLE, "*"), (6, "K", DOUBLE, "*"),
                                   (7, "R", DOUBLE, "*"), (8, "P", DOUBLE, "*")],
    "foxglove.PointCloud": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"), (2, "frame_id", STRING, ""),
                            (3, "pose", MESSAGE, "foxglove.Pose"), (4, "point_stride", FIXED32, ""),
                            (5, "fields", MESSAGE, "*foxglove.PackedElementField"), (6, "data", BYTES, "")],
    "foxglove.FrameTransform": [(1, "timestamp", MESSAGE, "google.protobuf.Timestamp"),
                                (2, "parent_frame_id", STRING, ""), (3, "child_frame_id", STRING, ""),
                                (4, "translation", MESSAGE, "foxglove.Vector3"),
                                (5, "rotation", MESSAGE, "foxglove.Quaternion")],
}  # fmt: skip


def file_set() -> descriptor_pb2.FileDescriptorSet:
    files = descriptor_pb2.FileDescriptorSet()
    for full, fields in SCHEMAS.items():
        package, _, name = full.rpartition(".")
        used = {kind.lstrip("*") for _, _, _, kind in fields if kind.lstrip("*")}
        needed = [f"{name}.proto" for name in used]
        file = files.file.add(name=f"{full}.proto", package=package, syntax="proto3", dependency=needed)
        message = file.message_type.add(name=name)
        for number, field, kind, target in fields:
            is_many = target.startswith("*")
            described = message.field.add(name=field, number=number, type=kind, label=REPEATED if is_many else 1)
            if target.lstrip("*"):
                described.type_name = "." + target.lstrip("*")
    return files


def foxglove_take(encoding: str, picture: dict[str, Any], kind: str = "foxglove.CompressedImage") -> dict[str, Any]:
    """The messages of one moment as plain values: topic -> (type, values)."""
    stamp = (
        {"seconds": START_NS // SECOND, "nanos": 0}
        if encoding == "protobuf"
        else {"sec": START_NS // SECOND, "nsec": 0}
    )
    place, turn = T_CAMERA_LIDAR.translation, T_CAMERA_LIDAR.rotation.as_quat()
    xyz = np.ascontiguousarray(POINTS_M)
    fields = [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate("xyz")]
    here = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    return {
        "/image": (kind, {"timestamp": stamp, "frame_id": "camera", **picture}),
        "/calibration": ("foxglove.CameraCalibration", {
            "timestamp": stamp, "frame_id": "camera", "width": SIZE[0], "height": SIZE[1], "distortion_model": "",
            "D": [], "K": K.ravel().tolist(), "R": np.eye(3).ravel().tolist(), "P": [0.0] * 12}),
        "/lidar": ("foxglove.PointCloud", {
            "timestamp": stamp, "frame_id": "lidar", "pose": here, "point_stride": 12, "fields": fields,
            "data": xyz.tobytes()}),
        "/tf_static": ("foxglove.FrameTransform", {
            "timestamp": stamp, "parent_frame_id": "camera", "child_frame_id": "lidar",
            "translation": dict(zip("xyz", place.tolist(), strict=True)),
            "rotation": dict(zip("xyzw", turn.tolist(), strict=True))}),
    }  # fmt: skip


def encode(encoding: str, kind: str, values: dict[str, Any]) -> bytes:
    if encoding == "json":
        return json.dumps(values, default=lambda data: base64.b64encode(data).decode()).encode()
    pool = descriptor_pool.DescriptorPool()
    for file in file_set().file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(kind))(**values).SerializeToString()


def write_mcap(path: Path, encoding: str, moments: list[tuple[int, dict[str, Any]]], **how: Any) -> None:
    with path.open("wb") as file:
        writer = Writer(file, **how)
        writer.start("", "test")
        channels: dict[str, int] = {}
        schema = file_set().SerializeToString()
        for time_ns, take in moments:
            for topic, (kind, values) in take.items():
                if topic not in channels:
                    name, data = ("protobuf", schema) if encoding == "protobuf" else ("jsonschema", b"{}")
                    channels[topic] = writer.register_channel(topic, encoding, writer.register_schema(kind, name, data))
                writer.add_message(channels[topic], time_ns, encode(encoding, kind, values), time_ns)
        writer.finish()


WRITERS: list[dict[str, Any]] = [
    {}, {"use_chunking": False}, {"compression": CompressionType.NONE}, {"compression": CompressionType.LZ4},
    {"index_types": IndexType.NONE}, {"repeat_channels": False, "repeat_schemas": False, "chunk_size": 100},
]  # fmt: skip


@pytest.mark.parametrize("how", WRITERS)
@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_messages_of_any_writer(tmp_path: Path, encoding: str, how: dict[str, Any]):
    png = cv2.imencode(".png", IMAGE[:, :, ::-1])[1].tobytes()
    path = tmp_path / "a.mcap"
    write_mcap(path, encoding, [(START_NS, foxglove_take(encoding, {"data": png, "format": "png"}))], **how)
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
    assert len(packets) == len(levels)
    return packets


@pytest.mark.parametrize("form", ENCODERS)
def test_video_is_decoded_from_the_last_key_frame(tmp_path: Path, form: str):
    levels = [20, 60, 100, 140, 180, 220]
    moments = []
    for i, packet in enumerate(encoded(form, levels)):
        take = foxglove_take("protobuf", {"data": packet, "format": form}, "foxglove.CompressedVideo")
        stamp = {"seconds": START_NS // SECOND, "nanos": i * 100 * MS}
        take["/calibration"][1].update(width=128, height=96)
        for _, values in take.values():
            values["timestamp"] = stamp
        moments.append((START_NS + i * 100 * MS, take))
    path = tmp_path / "a.mcap"
    write_mcap(path, "protobuf", moments)
    recording = open_recording(path)
    assert len(recording) == len(levels)
    for i in (5, 0, 3, 4):
        assert abs(int(np.median(recording.frame(i).rgb)) - levels[i]) <= 4


def picture(monkeypatch: pytest.MonkeyPatch, form: str, packets: list[bytes], i: int) -> np.ndarray:
    """The picture of message `i` of a topic with these packets."""
    contents = [SimpleNamespace(data=packet, format=form) for packet in packets]
    monkeypatch.setattr(video, "message", lambda _, i: contents[i])
    none = np.empty(0, np.int64)
    return video.video_image(Topic("/video", "foxglove/CompressedVideo", (), none, none, none), i, contents[i])


def test_pictures_made_up_from_damaged_video_are_errors(monkeypatch: pytest.MonkeyPatch):
    packets = encoded("h264", [40, 90, 140])
    packets[1] = packets[1][:-5]
    assert abs(picture(monkeypatch, "h264", packets, 0).mean() - 40) <= 4
    for i in (1, 2):
        with pytest.raises(ValueError, match="its video cannot be decoded"):
            picture(monkeypatch, "h264", packets, i)


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


@given(st.lists(st.binary(max_size=40).map(lambda data: b"\0\0\1" + data), max_size=4))
def test_any_bytes_are_searched_for_lost_pictures(pictures: list[bytes]):
    assert lost_before(pictures) in (None, *range(len(pictures)))


def cut(path: Path, share: float) -> None:
    with path.open("r+b") as opened:
        opened.truncate(int(path.stat().st_size * share))


@pytest.mark.parametrize("compression", ["", "lz4", "bz2"])
def test_a_cut_ros1_bag_is_read_as_far_as_it_is_sound(tmp_path: Path, compression: str):
    with BagWriter(tmp_path, "ros1", compression) as bag:
        bag.writer.chunk_threshold = 5000
        write_take(bag, 40)
    cut(bag.path, 0.6)
    recording = open_recording(bag.path)
    assert any("truncated" in note or "damaged" in note for note in recording.notes)
    assert 15 < len(recording) < 40
    np.testing.assert_allclose(recording.frame(len(recording) - 1).cloud.xyz_m, seen_points(), atol=1e-6)


@pytest.mark.parametrize("how", WRITERS)
def test_a_cut_mcap_file_is_read_as_far_as_it_is_sound(tmp_path: Path, how: dict[str, Any]):
    path, moments = tmp_path / "a.mcap", []
    for i in range(40):
        picture = np.random.default_rng(i).integers(0, 256, IMAGE.shape, np.uint8)
        png = cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes()
        take = foxglove_take("protobuf", {"data": png, "format": "png"})
        for _, values in take.values():
            values["timestamp"] = {"seconds": START_NS // SECOND, "nanos": i * 20 * MS}
        moments.append((START_NS + i * 20 * MS, take))
    write_mcap(path, "protobuf", moments, **{"chunk_size": 20_000} | how)
    cut(path, 0.6)
    recording = open_recording(path)
    assert "a.mcap was not closed by its recorder" in recording.notes[0]
    assert 15 < len(recording) < 40
    last = np.random.default_rng(len(recording) - 1).integers(0, 256, IMAGE.shape, np.uint8)
    np.testing.assert_array_equal(recording.frame(len(recording) - 1).rgb, last)


def test_a_ros1_bag_that_was_not_closed(tmp_path: Path):
    """The recorder wrote chunks with their indices, but neither connections nor the place of the index."""
    with BagWriter(tmp_path, "ros1") as bag:
        write_take(bag, 3)
    content = bytearray(bag.path.read_bytes())
    at = content.index(b"index_pos=") + 10
    place = int.from_bytes(content[at : at + 8], "little")
    content[at : at + 8] = bytes(8)
    bag.path.write_bytes(content[:place])
    recording = open_recording(bag.path)
    assert recording.notes == ("take.bag was not closed by its recorder; it is read as far as it is sound",)
    assert len(recording.frame(2).cloud)


def test_damage_in_the_middle_loses_only_its_chunk(tmp_path: Path):
    for container, compression in (("ros1", "lz4"), ("mcap", "storage")):
        with BagWriter(tmp_path, container, compression) as bag:
            if container == "ros1":
                bag.writer.chunk_threshold = 5000
            write_take(bag, 400)
        file = bag.path if bag.path.is_file() else next(bag.path.glob("*.mcap"))
        content = bytearray(file.read_bytes())
        middle = len(content) // 2
        content[middle : middle + 400] = bytes(400)
        file.write_bytes(content)
        recording = open_recording(bag.path)
        readable = 0
        for i in range(len(recording)):
            try:
                readable += len(recording.frame(i).cloud) > 0
            except FrameError as error:
                assert str(error).startswith(str(bag.path))
        assert readable > 150


def test_an_index_of_thousands_of_damaged_chunks_is_read_once(tmp_path: Path):
    count = 20_000

    def record(op: int, *fields: bytes) -> bytes:
        named = [b"op=" + bytes([op]), *fields]
        head = b"".join(len(field).to_bytes(4, "little") + field for field in named)
        return len(head).to_bytes(4, "little") + head + bytes(4)

    def start(index_at: int) -> bytes:
        return b"#ROSBAG V2.0\n" + record(3, b"index_pos=" + index_at.to_bytes(8, "little"))

    damaged_at = len(start(0))
    places = range(damaged_at, damaged_at + 4 * count, 4)
    index = b"".join(record(6, b"chunk_pos=" + place.to_bytes(8, "little")) for place in places)
    path = tmp_path / "a.bag"
    path.write_bytes(start(places.stop) + b"\xff" * 4 * count + index)
    started = time.process_time()
    bag = open_bag(path)
    assert bag is not None
    assert time.process_time() - started < 2
    assert bag.notes[0] == f"a.bag is damaged at byte {damaged_at}; 4 bytes are lost"
    assert bag.notes[-1] == "a.bag is damaged at 19992 more places"


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


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with BagWriter(tmp_path, "ros1") as bag:
        write_take(bag)
    decode._decoder.cache_clear()
    monkeypatch.setitem(__import__("sys").modules, "rosbags.typesys", None)
    assert detect_format(bag.path) == "ros_bag"
    with pytest.raises(MissingExtraError, match=r"rosbags is not installed; .*scripts/setup ros"):
        open_recording(bag.path)


def test_files_of_another_content_are_not_bags(tmp_path: Path):
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"no bag")
        assert detect_format(tmp_path / name) is None
    (tmp_path / "b.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    with pytest.raises(RecordingError, match=r"b\.db3: "):
        open_recording(tmp_path / "b.db3")


@given(st.sampled_from(["lz4", "bz2", "zstd", "none"]), st.binary(max_size=300), st.integers(0, 200))
def test_any_bytes_can_be_unpacked_or_are_damaged(compression: str, data: bytes, most: int):
    content, problem = unpack(compression, [data], most)
    assert len(content) <= most
    assert problem or len(content) == most


def test_chunks_are_unpacked_only_as_far_as_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import bz2

    data = np.random.default_rng(0).bytes(4_000_000)
    path = tmp_path / "a"
    path.write_bytes(bz2.compress(data))
    chunks = Chunks(path)
    chunks.add(Chunk(0, path.stat().st_size, "bz2", len(data)))
    assert chunks.read(0, 10, 20) == data[10:30]
    assert 30 <= len(KEPT.get(chunks, 0)) < 100_000
    assert chunks.read(0, 3_999_990, 100) == data[-10:]


def test_the_kept_contents_of_many_files_are_few(tmp_path: Path):
    import bz2

    size = MOST_KEPT_BYTES // 8
    path = tmp_path / "a"
    path.write_bytes(bz2.compress(bytes(size)))
    files = [Chunks(path) for _ in range(12)]
    for file in files:
        file.add(Chunk(0, path.stat().st_size, "bz2", size))
        assert file.read(0, size - 4, 9) == bytes(4)
    kept = [len(KEPT.get(file, 0)) for file in files]
    assert kept[-1] == size
    assert sum(kept) <= MOST_KEPT_BYTES


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    paths = []
    for container, compression in [(name, "") for name in CONTAINERS] + [("ros1", "lz4"), ("mcap", "storage")]:
        folder = tmp_path_factory.mktemp("take")
        with BagWriter(folder, container, compression) as bag:
            write_take(bag, 2)
        paths.append(bag.path)
    png = cv2.imencode(".png", IMAGE[:, :, ::-1])[1].tobytes()
    for encoding in ("protobuf", "json"):
        path = tmp_path_factory.mktemp("take") / "a.mcap"
        how = {"compression": CompressionType.NONE, "enable_crcs": False}
        write_mcap(path, encoding, [(START_NS, foxglove_take(encoding, {"data": png, "format": "png"}))], **how)
        paths.append(path)
    return paths


def _noise(content: bytes, at: int, data: st.DataObject) -> bytes:
    noise = data.draw(st.binary(min_size=1, max_size=8))
    return content[:at] + noise + content[at + data.draw(st.sampled_from([0, len(noise)])) :]


def _other_value(content: bytes, at: int, data: st.DataObject) -> bytes:
    """Replaces a number of JSON by something of another type, of the same length."""
    places = [match.span() for match in re.finditer(rb"(?<=: )[-0-9.]{3,}", content)]
    if not places:
        return content
    begin, end = places[at % len(places)]
    value = data.draw(st.sampled_from([b"[]", b"{}", b'""', b"-9e9", b"9" * 50, b"1"]))[: end - begin]
    return content[:begin] + value.ljust(end - begin) + content[end:]


DAMAGES: list[Callable[[bytes, int, st.DataObject], bytes]] = [
    lambda content, at, _: content[:at],
    _noise,
    lambda content, at, _: content[:at] + content,
    lambda content, at, _: content[:at] + b"\xff" * 8 + content[at + 8 :],
]


@given(st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_bags_give_frames_or_errors_that_name_the_file(takes: list[Path], data: st.DataObject):
    path = data.draw(st.sampled_from(takes))
    files = [path] if path.is_file() else sorted(path.iterdir())
    file = data.draw(st.sampled_from(files))
    whole = file.read_bytes()
    at = min(data.draw(st.one_of(st.integers(0, 300), st.integers(0, len(whole) - 1))), len(whole) - 1)
    damages = [*DAMAGES, *([_other_value] if file.name == "a.mcap" else [])]
    file.write_bytes(data.draw(st.sampled_from(damages))(whole, at, data))
    try:
        recording = open_recording(path)
        for i in range(min(len(recording), 2)):
            frame = recording.frame(i)
            assert np.isfinite(frame.cloud.xyz_m).all()
            assert len(frame.cloud) > 0
    except RecordingError as error:
        assert str(error).startswith(str(path))
    finally:
        file.write_bytes(whole)


def test_times_that_are_slow_to_read_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(kept_times, "SLOW_S", -1.0)
    # bz2 is read by several threads
    monkeypatch.setattr(pairing.os, "cpu_count", lambda: 4)
    with BagWriter(tmp_path, "ros1", "bz2") as bag:
        write_take(bag)
    opened = open_bag(bag.path)
    assert opened is not None
    topic, expected = opened.topics["/points"], START_NS + np.arange(3) * 100 * MS
    np.testing.assert_array_equal(pairing.stamps_ns.__wrapped__(topic), expected)
    (file,) = kept_times.cache_folder().iterdir()
    # the second time they are read from there, unless the file is damaged or the bag has changed
    with monkeypatch.context() as patched:
        patched.setattr(pairing, "quick_stamp_ns", lambda *_: pytest.fail("the bag is read"))
        np.testing.assert_array_equal(pairing.stamps_ns.__wrapped__(topic), expected)
    file.write_bytes(b"damaged")
    np.testing.assert_array_equal(pairing.stamps_ns.__wrapped__(topic), expected)
    bag.path.touch()
    pairing.stamps_ns.__wrapped__(topic)
    assert len(list(kept_times.cache_folder().iterdir())) == 2
