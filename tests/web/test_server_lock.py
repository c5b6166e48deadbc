"""Only one server may use a projects folder."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from annotator.types.errors import ConfigError
from annotator.web.folders import hold_server_lock


def test_a_second_server_is_refused_while_the_first_one_runs(tmp_path: Path) -> None:
    with hold_server_lock(tmp_path / "projects"):
        with (
            pytest.raises(ConfigError, match=r"projects: another `annotator serve` uses these projects"),
            hold_server_lock(tmp_path / "projects"),
        ):
            pass
        with hold_server_lock(tmp_path / "others"):
            pass
    with hold_server_lock(tmp_path / "projects"):
        pass


def test_a_file_system_without_locks_causes_only_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(file: object, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    with hold_server_lock(tmp_path / "projects"):
        assert "does not support locks (No locks available)" in caplog.text


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "projects").write_text("a file")
    with (
        pytest.raises(ConfigError, match="choose another folder with --projects"),
        hold_server_lock(tmp_path / "projects"),
    ):
        pass
