"""Two servers never work on one folder of projects."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from annotator.types.errors import ConfigError
from annotator.web.sole import sole_server


def test_a_second_server_is_refused_while_the_first_one_works(tmp_path: Path) -> None:
    with sole_server(tmp_path / "projects"):
        with (
            pytest.raises(ConfigError, match=r"projects: another `annotator serve` works on these projects"),
            sole_server(tmp_path / "projects"),
        ):
            pass
        with sole_server(tmp_path / "others"):
            pass
    with sole_server(tmp_path / "projects"):
        pass


def test_a_file_system_without_locks_is_told_and_worked_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(file: object, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    with sole_server(tmp_path / "projects"):
        assert "keeps no locks (No locks available)" in caplog.text


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "projects").write_text("a file")
    with pytest.raises(ConfigError, match="choose another folder with --projects"), sole_server(tmp_path / "projects"):
        pass
