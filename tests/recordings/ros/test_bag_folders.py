"""Which files and folders are bags, and what is missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from ros_takes import write_take

from annotator.recordings import detect_format, open_recording
from annotator.recordings.ros import messages
from annotator.recordings.ros.bag import open_bag
from annotator.types.errors import MissingExtraError, RecordingError, UnknownFormatError
from benchmarks.bag_writer import BagWriter


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
    messages._decoder.cache_clear()
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
