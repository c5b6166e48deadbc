"""Files and folders are written completely or not at all."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from annotator import files
from annotator.files import new_folder, write_atomic
from annotator.types.errors import FormatError


def test_a_file_is_replaced_completely_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    write_atomic(path, b"old")
    write_atomic(path, b"new")
    assert path.read_bytes() == b"new"
    (tmp_path / "plain").write_bytes(b"")
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(files.os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_atomic(path, b"newer")
    assert path.read_bytes() == b"new"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.json", "plain"]


def test_a_folder_is_replaced_completely_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with new_folder(out, lambda _: False) as part:
        (part / "a").touch()
        assert not out.exists()
    with pytest.raises(FormatError, match="exists and is not empty"), new_folder(out, lambda _: False):
        pytest.fail("the folder was replaced")
    with pytest.raises(ValueError, match="half"), new_folder(out, lambda _: True) as part:
        (part / "b").touch()
        raise ValueError("half")
    assert [entry.name for entry in out.iterdir()] == ["a"]
    with new_folder(out, lambda _: True) as part:
        (part / "c").touch()
    assert [entry.name for entry in out.iterdir()] == ["c"]
    assert [entry.name for entry in out.parent.iterdir()] == ["out"]


def test_what_a_killed_process_left_is_put_right(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    out = tmp_path / "out[1]"
    # killed between the two renames: the new folder is complete, the old one moved aside
    for name, content in (
        (".out[1].old-abcdefgh", "old"),
        (".out[1].part-01234567", "new"),
        (".out[1].old-_______0", ""),
    ):
        (tmp_path / name).mkdir()
        if content:
            (tmp_path / name / content).touch()
    others = (".out[1].part-mine", ".out1.part-01234567", ".other.old-01234567")
    for name in others:
        (tmp_path / name).mkdir()
    with pytest.raises(FormatError, match="exists and is not empty"), new_folder(out, lambda _: False):
        pytest.fail("the old dataset was lost")
    assert [entry.name for entry in out.iterdir()] == ["old"]
    assert {entry.name for entry in tmp_path.iterdir()} == {"out[1]", *others}
    assert "put back from .out[1].old-abcdefgh" in caplog.text
    assert "part-01234567: removed" in caplog.text
    # killed after both renames
    (tmp_path / ".out[1].old-abcdefgh").mkdir()
    with new_folder(out, lambda _: True) as part:
        (part / "newer").touch()
        # a second process, before the first one has finished: nothing of it is touched
        with pytest.raises(FormatError), new_folder(out, lambda _: False):
            pytest.fail("the folder was replaced")
        assert (part / "newer").exists()
    assert [entry.name for entry in out.iterdir()] == ["newer"]
    assert {entry.name for entry in tmp_path.iterdir()} == {"out[1]", *others}


def test_a_folder_that_vanishes_before_it_is_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, removed = files.lock_folder, list[Path]()

    def late(folder: Path, *, waits: bool = False) -> int | None:
        if not removed:
            removed.append(folder)
            folder.rmdir()
        return lock(folder, waits=waits)

    monkeypatch.setattr(files, "lock_folder", late)
    with new_folder(tmp_path / "out", lambda _: False) as part:
        (part / "a").touch()
    assert (tmp_path / "out" / "a").exists()
    assert part != removed[0]


@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o755), (0o077, 0o700), (0o002, 0o775)])
def test_a_new_folder_follows_the_umask(tmp_path: Path, mask: int, mode: int) -> None:
    before = os.umask(mask)
    try:
        with new_folder(tmp_path / "out", lambda path: False) as part:
            (part / "file").write_text("x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == mode
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["file"]
