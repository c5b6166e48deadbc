"""A file project.db-wal that is left beside a database is used only if it belongs to it."""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import pytest
from store_samples import box_at, by_hand, stored_state, use_next
from time_limit import time_limit

from annotator.project import NewLabel, open_project
from annotator.project.backup.repair import repair
from annotator.project.backup.verify import verify
from annotator.project.database import generation
from annotator.project.database.generation import Lineage, has_foreign_wal
from annotator.project.database.store import open_store
from annotator.types.errors import ProjectError


def write_and_be_killed(project: Path) -> None:
    """Adds three labels, and leaves the files as they are while the database is open: as after a kill."""
    left = project.parent / "left"
    with open_project(project) as opened:
        for _ in range(3):
            frame = opened.frames.of()[4]
            opened.labels.create(frame.id, [NewLabel("hand", box_at(9.0))], by_hand(frame.revision))
        shutil.copytree(project, left)
    for name in ("project.db", "project.db-wal"):
        (left / name).replace(project / name)
    shutil.rmtree(left)


def test_a_database_copied_beside_a_left_wal_is_not_mixed_with_it(full: Path, tmp_path: Path) -> None:
    shutil.copyfile(full / "project.db", tmp_path / "by_hand.db")
    before = stored_state(full)
    write_and_be_killed(full)
    shutil.copyfile(tmp_path / "by_hand.db", full / "project.db")
    with pytest.raises(ProjectError, match=r"does not belong to the file project\.db-wal beside it"):
        open_project(full)
    assert "does not belong" in verify(full).problems[0]
    repaired = repair(full)
    assert (repaired.path, repaired.is_new, repaired.lost) == (tmp_path / "hands-repaired", True, {})
    assert stored_state(repaired.path) == before
    assert verify(repaired.path, deep=True).problems == ()
    assert (full / "project.db-wal").exists()


def test_a_left_wal_of_the_database_itself_is_used(full: Path, tmp_path: Path) -> None:
    for _ in range(2):
        write_and_be_killed(full)
    moved = full.rename(tmp_path / "moved")
    with open_project(moved) as project:
        assert len(project.labels.of_frame(project.frames.of()[4].id)) == 6
    assert verify(moved, deep=True).problems == ()


def test_a_database_copied_in_the_middle_of_a_session_is_not_mixed_with_a_later_wal(full: Path, tmp_path: Path) -> None:
    write_and_be_killed(full)
    with open_project(full) as project:
        frame = project.frames.of()[3]
        project.labels.create(frame.id, [NewLabel("hand", box_at())], by_hand(frame.revision))
        shutil.copyfile(full / "project.db", tmp_path / "by_hand.db")
        with closing(sqlite3.connect(full / "project.db")) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    write_and_be_killed(full)
    shutil.copyfile(tmp_path / "by_hand.db", full / "project.db")
    with pytest.raises(ProjectError, match="does not belong"):
        open_project(full)


def test_a_database_in_the_middle_of_a_checkpoint_is_not_taken_for_another(full: Path) -> None:
    # A reader holds the checkpoint up: it moves the first page, but not the last ones, which have changed since. So the
    # file is shorter than its first page says.
    with open_project(full) as project, closing(sqlite3.connect(full / "project.db")) as reader:
        store = project.store
        with store.write() as connection:
            connection.exec_driver_sql("CREATE TABLE filler (x BLOB)")
            connection.exec_driver_sql("INSERT INTO filler VALUES (zeroblob(400000))")
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM filler").fetchone()
        with store.write() as connection:
            connection.exec_driver_sql("UPDATE filler SET x = randomblob(400000)")
        with closing(sqlite3.connect(full / "project.db")) as other:
            other.execute("PRAGMA wal_checkpoint(PASSIVE)")
        first_page = (full / "project.db").read_bytes()[:32]
        assert int.from_bytes(first_page[28:32], "big") * 4096 > (full / "project.db").stat().st_size
        assert not has_foreign_wal(full / "project.db")
        assert store.file.is_current()
        with store.write() as connection:
            connection.exec_driver_sql("DROP TABLE filler")


@pytest.mark.parametrize(("wrong", "is_broken"), [(1, False), (3, False), (4, True)])
def test_several_looks_must_find_another_database(
    full: Path, monkeypatch: pytest.MonkeyPatch, wrong: int, is_broken: bool
) -> None:
    lineage, answers = Lineage(), iter([True] * wrong + [False] * 4)
    lineage.begin(full / "project.db")
    monkeypatch.setattr(generation, "_looks_foreign", lambda path, wal: next(answers))
    os.utime(full / "project.db")
    assert lineage.is_broken() == is_broken
    assert lineage.is_broken() == is_broken


def test_an_upgrade_stores_a_new_token(full: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a copy from before the upgrade would pass for the upgraded database."""
    use_next(monkeypatch)

    def token() -> str:
        with closing(sqlite3.connect(full / "project.db")) as connection:
            return str(connection.execute("SELECT substr(chain, -32) FROM generation").fetchone()[0])

    before = token()
    open_store(full / "project.db").close()
    assert token() != before


@pytest.mark.parametrize(
    "header",
    [struct.pack(">IIII", 0x377F0682, 3007000, 2**32 - 1, 0), struct.pack(">IIII", 0x377F0682, 3007000, 4096, 0)],
)
def test_a_huge_empty_wal_does_not_hold_up_an_open(full: Path, header: bytes) -> None:
    with (full / "project.db-wal").open("wb") as file:
        file.write(header)
        file.truncate(2**33)
    with time_limit(20), open_project(full) as project:
        assert project.problems() == []
