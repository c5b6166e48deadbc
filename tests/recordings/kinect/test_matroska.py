"""The Matroska index: as in RFC 8794 and 9559, and robust against any bytes."""

from __future__ import annotations

from pathlib import Path

import av
import kinect_recording as made
import pytest

from annotator.recordings import detect_format
from annotator.recordings.kinect.matroska import Block, element_head, read_index


def test_element_heads_are_parsed():
    assert element_head(b"\xe7\x81") == (0xE7, 1, 2)
    assert element_head(b"\x1f\x43\xb6\x75\x01\xff\xff\xff\xff\xff\xff\xff") == (0x1F43B675, None, 12)
    assert element_head(b"\xa3\x10\x03\x50\x11") == (0xA3, 217105, 5)
    assert [element_head(data) for data in (b"\x00\x81", b"\x08\x11\x11\x11\x11\x81", b"\xa3\x10\x03", b"")] == [
        None
    ] * 4


def test_blocks_are_where_pyav_finds_them(tmp_path: Path):
    path = made.write_recording(tmp_path / "take.mkv", "NV12", frames=4)
    index = read_index(path)
    content = path.read_bytes()
    with av.open(str(path)) as container:
        expected = [(packet.stream.index, packet.pts, bytes(packet)) for packet in container.demux() if packet.size]
    found = [(b.track - 1, b.time_ns // 1_000_000, content[b.offset : b.offset + b.size]) for b in index.blocks]
    assert found == expected
    assert not index.is_truncated
    assert [(track.name, track.width_px, track.height_px) for track in index.tracks] == [
        ("COLOR", 1280, 720), ("DEPTH", 320, 288), ("IR", 320, 288)
    ]  # fmt: skip


def test_a_recording_is_recognised_without_reading_it_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = made.write_recording(tmp_path / "take.mkv", "NV12", frames=1)
    film = tmp_path / "film.mkv"
    film.write_bytes(path.read_bytes().replace(b"DEPTH", b"OTHER"))
    (tmp_path / "text.mkv").write_bytes(b"no film")
    monkeypatch.setattr(
        "annotator.recordings.kinect.mkv_recording.read_index", lambda path: pytest.fail("the whole file is indexed")
    )
    assert [detect_format(tmp_path / name) for name in ("take.mkv", "film.mkv", "text.mkv")] == [
        "azure_kinect", None, None
    ]  # fmt: skip


def test_a_damaged_size_affects_only_its_cluster(tmp_path: Path):
    path = tmp_path / "x.mkv"
    block = b"\xa3\x86\x81\x00\x07\x80xy"
    content = b"\xe7\x81\x05" + block + block
    cluster = b"\x1f\x43\xb6\x75" + (0x80 | len(content)).to_bytes(1) + content
    head = b"\x1a\x45\xdf\xa3\x80" + b"\x18\x53\x80\x67\xff"
    path.write_bytes(head + 3 * cluster)
    assert len(read_index(path).blocks) == 6
    damaged = block.replace(b"\x86", b"\x94", 1)  # as if it were 20 bytes long
    path.write_bytes(head + cluster.replace(block, damaged, 1) + 2 * cluster)
    index = read_index(path)
    assert [block.offset for block in index.blocks] == [
        len(head + cluster) + 5 + 3 + 6, len(head + cluster) + 5 + 3 + 6 + 8,
        len(head + 2 * cluster) + 5 + 3 + 6, len(head + 2 * cluster) + 5 + 3 + 6 + 8,
    ]  # fmt: skip
    assert not index.is_truncated


def test_unknown_and_huge_sizes_are_handled(tmp_path: Path):
    path = tmp_path / "x.mkv"
    head = b"\x1a\x45\xdf\xa3\x80" + b"\x18\x53\x80\x67\xff"
    cluster = b"\x1f\x43\xb6\x75\xff" + b"\xe7\x82\x01\x00"
    block = b"\xa3\x86\x81\x00\x07\x80xy"
    huge = b"\xa3\x01\xff\xff\xff\xff\xff\xff\xf0\x82\x00\x09\x86"
    path.write_bytes(head + cluster + block + huge)
    index = read_index(path)
    assert index.is_truncated
    first, second = index.blocks
    assert first == Block(track=1, time_ns=263_000_000, offset=len(head + cluster) + 6, size=2, is_laced=False)
    assert (second.track, second.is_laced, second.time_ns) == (2, True, 265_000_000)
