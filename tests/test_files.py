"""Files and folders are written completely or not at all."""

from __future__ import annotations

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
