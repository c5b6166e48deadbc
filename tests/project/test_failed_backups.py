"""Backups and repairs that cannot be made say why, and what a killed one left does not stay."""

from __future__ import annotations

import sqlite3
from collections import namedtuple
from contextlib import closing
from pathlib import Path

import pytest

from annotator.project import create_project
from annotator.project.backup import make, snapshot
from annotator.project.backup.make import Reason, automatic_backups, back_up, back_up_automatically
from annotator.project.backup.repair import repair
from annotator.types.errors import ProjectError


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """An empty project."""
    create_project(tmp_path, "room", ("hand",)).close()
    return tmp_path / "room"


def test_a_backup_does_not_fill_the_disk(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "free")
    monkeypatch.setattr(make.shutil, "disk_usage", lambda path: usage(make.SPARE_BYTES))
    with pytest.raises(ProjectError, match=r"may take 33 MiB, .* the disk has 32 MiB; free some space"):
        back_up(room, room.parent / "copy.zip")
    assert [path.name for path in room.parent.iterdir()] == ["room"]


def test_a_backup_of_a_project_without_its_database_says_what_to_do(room: Path) -> None:
    (room / "project.db").unlink()
    with pytest.raises(ProjectError, match=r"project\.db: is missing; .*annotator project restore"):
        back_up(room, room.parent / "copy.zip")


def test_a_killed_backup_is_removed_by_the_next_of_any_name(room: Path, tmp_path: Path) -> None:
    left = tmp_path / ".room-backup.0123.unfinished"
    left.mkdir()
    back_up(room, tmp_path / "other.zip")
    assert not left.exists()


def test_a_project_behind_a_link_has_one_place_for_its_backups(room: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    linked = tmp_path / "elsewhere" / "linked"
    linked.symlink_to(room)
    back_up_automatically(linked, Reason.CHANGES)
    back_up_automatically(room, Reason.CHANGES)
    assert len(automatic_backups(linked)) == len(automatic_backups(room)) == 2


def test_a_locked_project_is_not_taken_for_a_damaged_one(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshot, "BUSY_TIMEOUT_S", 0.01)
    with closing(sqlite3.connect(room / "project.db")) as other:
        other.execute("PRAGMA journal_mode = DELETE")
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(ProjectError, match="is locked by another process"):
            repair(room)
    assert [path.name for path in room.parent.iterdir()] == ["room"]
