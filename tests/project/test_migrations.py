"""Older databases are upgraded completely or not at all; newer ones, and those from before the release, are refused."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from store_samples import NOW, by_hand, state_of, use_next, version_of

from annotator.project import create_project, open_project
from annotator.project.backup.repair import repair
from annotator.project.backup.verify import verify
from annotator.project.database.store import open_store
from annotator.types.errors import ProjectError


def test_an_upgraded_database_keeps_its_content_and_has_the_tables_of_a_new_one(
    full: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_project(full) as project:
        before = state_of(project)
    use_next(monkeypatch)
    with open_project(full) as project:
        assert state_of(project) == before
        project.log.rebuild()
        assert state_of(project) == before
        assert project.problems() == []
    assert version_of(full / "project.db") == NOW + 1
    assert verify(full, deep=True).problems == ()
    create_project(full.parent, "new", ["hand"]).close()
    schemas = []
    for folder in (full, full.parent / "new"):
        with closing(sqlite3.connect(folder / "project.db")) as connection:
            schemas.append(connection.execute("SELECT type, name, sql FROM sqlite_master ORDER BY name").fetchall())
    assert schemas[0] == schemas[1]


def test_a_newer_database_is_refused_and_not_changed(full: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        use_next(patch)
        open_project(full).close()
    with pytest.raises(
        ProjectError, match=rf"newer annotator \(database version {NOW + 1}, this one supports up to {NOW}\)"
    ):
        open_project(full)
    assert version_of(full / "project.db") == NOW + 1


def test_a_project_from_before_the_first_release_is_refused_with_the_way_out(full: Path) -> None:
    database = full / "project.db"
    with closing(sqlite3.connect(database)) as connection:
        connection.execute(f"PRAGMA application_id = {int.from_bytes(b'Anno')}")
        connection.execute("PRAGMA user_version = 19")
    before = database.read_bytes()
    refusal = "from before the first release of annotator.* export its labels with the version that made it"
    for refused in (open_project, repair):
        with pytest.raises(ProjectError, match=refusal):
            refused(full)
    assert [path.name for path in full.parent.iterdir()] == ["hands"]
    (problem,) = verify(full).problems
    assert "before the first release" in problem
    assert database.read_bytes() == before


def test_an_upgrade_that_is_killed_afterwards_leaves_a_database_that_opens(
    full: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_next(monkeypatch)
    left = tmp_path / "left"
    store = open_store(full / "project.db")
    shutil.copytree(full, left)  # as after a kill: with the `-wal`
    store.close()
    assert (left / "project.db-wal").stat().st_size > 0
    open_store(left / "project.db").close()


def test_a_migration_that_fails_leaves_the_database_as_it_was(full: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        use_next(patch, ("CREATE TABLE half (a)", "CREATE TABLE frames (a)"))
        with pytest.raises(ProjectError, match=r"its tables are not those of its version; .* already exists"):
            open_store(full / "project.db")
    assert version_of(full / "project.db") == NOW
    with open_project(full) as project, project.store.read() as connection:
        names = connection.exec_driver_sql("SELECT name FROM sqlite_master").scalars().all()
        assert "half" not in names
        project.frames.finalise(2, by_hand(project.frames.get(2).revision))
