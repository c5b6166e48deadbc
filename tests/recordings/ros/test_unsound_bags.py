"""Unfinished, cut and damaged bags are read as far as they are sound."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_takes import WRITERS, picture_take, write_mcap
from ros_takes import IMAGE, MS, START_NS, write_take

from annotator.recordings import open_recording
from annotator.types.errors import FrameError, RecordingError
from benchmarks.bag_writer import BagWriter


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
