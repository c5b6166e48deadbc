"""Unfinished, cut and damaged bags are read as far as they are sound."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_takes import WRITERS, picture_take, write_mcap
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from ros_takes import IMAGE, MS, START_NS, write_take

from annotator.recordings import open_recording
from annotator.types.errors import FrameError, RecordingError
from benchmarks.bag_writer import CONTAINERS, BagWriter


def cut(path: Path, share: float) -> None:
    with path.open("r+b") as opened:
        opened.truncate(int(path.stat().st_size * share))


@pytest.mark.parametrize("share", [0.6, 0.999])
def test_a_ros1_bag_without_its_index_is_refused_with_the_command_that_restores_it(tmp_path: Path, share: float):
    with BagWriter(tmp_path, "ros1") as bag:
        write_take(bag, 10)
    cut(bag.path, share)
    with pytest.raises(RecordingError, match=r"has no index, or is damaged .*; run rosbag reindex take\.bag"):
        open_recording(bag.path)


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


def test_damage_in_the_middle_loses_only_its_chunk(tmp_path: Path):
    for container, compression in (("ros1", "lz4"), ("mcap", "storage")):
        with BagWriter(tmp_path, container, compression) as bag:
            if container == "ros1":
                bag.writer.chunk_threshold = 5000
            write_take(bag, 400 if container == "mcap" else 100)
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
        assert readable > 30


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    paths = []
    for container, compression in [(name, "") for name in CONTAINERS] + [("ros1", "lz4"), ("mcap", "storage")]:
        folder = tmp_path_factory.mktemp("take")
        with BagWriter(folder, container, compression) as bag:
            write_take(bag, 2)
        paths.append(bag.path)
    for encoding in ("protobuf", "json"):
        path = tmp_path_factory.mktemp("take") / "a.mcap"
        how = {"compression": CompressionType.NONE, "enable_crcs": False}
        write_mcap(path, encoding, [(START_NS, picture_take(encoding))], **how)
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
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
