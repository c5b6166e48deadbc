"""What is kept of bags: unpacked chunks, few of them, and times that are slow to read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ros_takes import MS, START_NS, write_take

from annotator.recordings.ros import pairing
from annotator.recordings.ros.bag import open_bag
from annotator.recordings.ros.bag_files import KEPT, MOST_KEPT_BYTES, Chunk, ChunkedFile
from benchmarks.bag_writer import BagWriter


def test_chunks_are_unpacked_only_as_far_as_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import bz2

    data = np.random.default_rng(0).bytes(500_000)
    path = tmp_path / "a"
    path.write_bytes(bz2.compress(data))
    chunks = ChunkedFile(path)
    chunks.chunks.append(Chunk(0, path.stat().st_size, "bz2", len(data)))
    assert chunks.content(0, 10, 20) == data[10:30]
    assert 30 <= len(KEPT.get(chunks, 0)[0]) < 100_000
    assert chunks.content(0, 499_990, 100) == data[-10:]


def test_the_kept_contents_of_many_files_are_few(tmp_path: Path):
    import bz2

    size = MOST_KEPT_BYTES // 8
    path = tmp_path / "a"
    path.write_bytes(bz2.compress(bytes(size)))
    files = [ChunkedFile(path) for _ in range(12)]
    for file in files:
        file.chunks.append(Chunk(0, path.stat().st_size, "bz2", size))
        assert file.content(0, size - 4, 9) == bytes(4)
    kept = [len(KEPT.get(file, 0)[0]) for file in files]
    assert kept[-1] == size
    assert sum(kept) <= MOST_KEPT_BYTES


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
