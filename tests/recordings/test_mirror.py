"""Recordings on remote storage: copied file by file in bounded space, with the same frames as the folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from annotator.recordings import open_recording
from annotator.recordings.mirror import open_mirror
from annotator.types.errors import FrameError, RecordingError, UnknownFormatError

MEGABYTE = 10**6


@pytest.fixture
def bucket(generated: Path) -> Iterator[str]:
    """The generated people in fsspec's memory file system."""
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.put(str(generated / "people"), "/bucket/people", recursive=True)
    yield "memory://bucket/people"
    memory.rm("/bucket", recursive=True)


def held_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_a_mirror_has_the_folders_frames_and_bounded_size(bucket: str, generated: Path, tmp_path: Path) -> None:
    plain = open_recording(generated / "people")
    sizes = [held_bytes(generated / "people" / name) for name in ("color", "depth")]
    limit = held_bytes(generated / "people") - sum(sizes) * 2 // 5  # some frames, not all
    mirror = open_mirror(bucket, tmp_path, limit)
    assert (mirror.keys, mirror.format, mirror.name, len(mirror)) == (plain.keys, plain.format, "people", 5)
    for index in (0, 4, 2, 3, 1, 0):
        ours, theirs = mirror.frame(index), plain.frame(index)
        assert (ours.key, ours.index) == (theirs.key, theirs.index)
        assert np.array_equal(ours.rgb, theirs.rgb) and np.array_equal(ours.cloud.xyz_m, theirs.cloud.xyz_m)
        assert np.array_equal(ours.up, theirs.up)
        assert held_bytes(tmp_path) <= limit
    mirror.close()
    assert list(tmp_path.iterdir()) == []


def test_only_files_of_the_frame_and_shared_files_are_copied(tmp_path: Path) -> None:
    """Files with the frame's key in their name belong to the frame; other files are shared by all frames."""
    folder = tmp_path / "clouds"
    for name in ("points", "calib", "notes"):
        (folder / name).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for key in ("000007", "000010"):
        points = np.concatenate([rng.uniform([5, -2, -1], [9, 2, 1], (50, 3)), np.ones((50, 1))], axis=1)
        points.astype(np.float32).tofile(folder / "points" / f"{key}.bin")
    (folder / "notes" / "all.txt").write_text("of nobody\n")
    mirror = open_mirror(folder.as_uri(), tmp_path / "copy", MEGABYTE)
    plain = open_recording(folder)
    assert np.array_equal(mirror.frame(1).cloud.xyz_m, plain.frame(1).cloud.xyz_m)
    copied = {path.name: path.stat().st_size for path in (tmp_path / "copy").rglob("*") if path.is_file()}
    assert copied["000007.bin"] == 0 and copied["all.txt"] == 10


def test_failed_downloads_leave_no_files_and_are_not_counted(bucket: str, tmp_path: Path) -> None:
    """If one file of a frame cannot be copied, its other files are neither counted nor left in the copy."""
    import fsspec

    memory = fsspec.filesystem("memory")
    depth = memory.cat("/bucket/people/depth/000002.png")
    memory.pipe("/bucket/people/depth/000003.png", b"no picture")
    mirror = open_mirror(bucket, tmp_path, 50 * MEGABYTE)
    with pytest.raises(FrameError, match=r"memory://bucket/people/depth/000003\.png"):
        mirror.frame(3)
    held = held_bytes(tmp_path)
    memory.rm("/bucket/people/depth/000002.png")
    for _ in range(3):
        with pytest.raises(RecordingError, match=r"people/depth/000002\.png: cannot be reached"):
            mirror.frame(2)
    assert held_bytes(tmp_path) == held == mirror.store.used_bytes
    memory.pipe("/bucket/people/depth/000002.png", depth)
    mirror.frame(2)


def test_shared_files_that_have_arrived_stay_if_a_later_one_fails(bucket: str, tmp_path: Path) -> None:
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.pipe({"/bucket/people/notes/all.txt": b"of nobody", "/bucket/people/notes/more.txt": b"lost"})
    mirror = open_mirror(bucket, tmp_path, 50 * MEGABYTE)
    used = mirror.store.used_bytes
    memory.rm("/bucket/people/notes/more.txt")
    with pytest.raises(RecordingError, match=r"notes/more\.txt: cannot be reached"):
        mirror.frame(0)
    assert next(tmp_path.rglob("all.txt")).read_bytes() == b"of nobody"
    assert held_bytes(tmp_path) == mirror.store.used_bytes >= used + len(b"of nobody")


def test_a_frame_larger_than_the_limit_is_an_error(bucket: str, tmp_path: Path) -> None:
    mirror = open_mirror(bucket, tmp_path, 5000)
    with pytest.raises(RecordingError, match="raise --cache-mb"):
        mirror.frame(0)


def test_urls_without_a_recording_are_errors(tmp_path: Path) -> None:
    for url, says in (("memory://bucket/nothing", "has no files"), ("xyz://bucket/room", "Protocol not known: xyz")):
        with pytest.raises(RecordingError, match=says):
            open_mirror(url, tmp_path, MEGABYTE)


def test_a_folder_that_is_not_a_recording_leaves_no_copy(tmp_path: Path) -> None:
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "a.md").write_text("a")
    with pytest.raises(UnknownFormatError):
        open_mirror((tmp_path / "texts").as_uri(), tmp_path / "copy", MEGABYTE)
    assert list((tmp_path / "copy").iterdir()) == []


def test_copies_of_killed_processes_are_removed(bucket: str, tmp_path: Path) -> None:
    left = tmp_path / ".recording.01234567.unfinished"
    left.mkdir()
    (left / "file").touch()
    open_mirror(bucket, tmp_path, 50 * MEGABYTE)
    assert not left.exists()
