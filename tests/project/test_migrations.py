"""Older databases are upgraded completely or not at all; newer ones are refused."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest
from old_versions import replaced_by, version_one
from store_samples import by_hand, proposal_at, state_of

from annotator.project import create_project, open_project
from annotator.project.event_types import FrameFinalised, ProposalsReplaced
from annotator.project.migrations import MIGRATIONS, Migration
from annotator.project.schema import METADATA
from annotator.project.store import open_store
from annotator.types import BoxKind, DetectorKind, Source
from annotator.types.errors import ProjectError


@pytest.fixture
def old(tmp_path: Path) -> Path:
    return version_one(tmp_path, {"a": [replaced_by("u", proposal_at()), FrameFinalised()], "b": []})


def _version(path: Path) -> int:
    connection = sqlite3.connect(path)
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    connection.close()
    return version


def test_a_version_1_database_is_upgraded_and_keeps_its_content(old: Path) -> None:
    with open_project(old) as project:
        assert [frame.revision for frame in project.frames.of()] == [2, 0]
        project.log.rebuild()
        (label,) = project.labels.of_frame(1)
        assert label.uid == "u"
        assert label.source is Source.AUTO
        assert project.frames.get(1).finalised
        run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}")
        assert [frame.key for frame in project.jobs.pending(run.key)] == ["b"]
        weights = project.models_folder / "w.pt"
        weights.write_bytes(b"w")
        project.models.register(
            DetectorKind.IMAGE, weights, labels=["hand"], box_kind=BoxKind.BOX, metrics={}, fingerprint="f"
        )
        before = state_of(project)
    assert _version(old / "project.db") == MIGRATIONS[-1].version
    with open_project(old) as project:
        assert state_of(project) == before
        assert project.problems() == []


def test_an_upgraded_database_has_the_same_tables_as_a_new_one(old: Path) -> None:
    create_project(old.parent, "new", ["hand"]).close()
    open_project(old).close()
    schemas = []
    for folder in (old, old.parent / "new"):
        connection = sqlite3.connect(folder / "project.db")
        schemas.append(connection.execute("SELECT type, name, sql FROM sqlite_master ORDER BY name").fetchall())
        connection.close()
    assert schemas[0] == schemas[1]


def test_the_tables_match_the_schema(tmp_path: Path) -> None:
    with create_project(tmp_path, "new", ["hand"]) as project, project.store.read() as connection:
        for name, table in METADATA.tables.items():
            actual = {
                row["name"]: (row["type"], bool(row["notnull"] or row["pk"]))
                for row in connection.exec_driver_sql(f"PRAGMA table_info({name})").mappings()
            }
            types = {"INTEGER": "INTEGER", "BOOLEAN": "INTEGER", "TEXT": "TEXT", "FLOAT": "REAL"}
            expected = {column.name: (types[str(column.type)], not column.nullable) for column in table.columns}
            assert actual == expected, name


def test_labels_of_older_databases_get_the_run_that_proposed_them(tmp_path: Path) -> None:
    path = tmp_path / "project.db"
    with sqlite3.connect(path) as connection:
        for migration in MIGRATIONS[:2]:
            for statement in migration.statements:
                connection.execute(statement)
        connection.execute("INSERT INTO recordings VALUES (1, '/take', 'rgbd', 'take', 1, NULL, 7)")
        connection.execute("INSERT INTO frames VALUES (1, 1, 'a', 0, 2, 0)")
        connection.execute("INSERT INTO runs VALUES (4, 'k', 'image', 'view', '{}', 5, NULL)")
        insert = "INSERT INTO events VALUES (?, 1, NULL, ?, 'proposals_replaced', ?, 'ann', 5, 'auto')"
        connection.execute(insert, (1, 1, ProposalsReplaced(run=4, objects=()).model_dump_json()))
        connection.execute(insert, (2, 2, ProposalsReplaced(objects=()).model_dump_json()))
        for uid, event in (("a", 1), ("b", 2), ("drawn", None)):
            values = (uid, event, event or 1)
            connection.execute(
                "INSERT INTO labels (uid, frame_id, label, box, source, state, author, time_ns, proposal_event_id, "
                "event_id) VALUES (?, 1, 'hand', '{}', 'auto', 'proposed', 'ann', 5, ?, ?)",
                values,
            )
        for statement in MIGRATIONS[2].statements:
            connection.execute(statement)
        runs = dict(connection.execute("SELECT uid, run_id FROM labels").fetchall())
    connection.close()
    assert runs == {"a": 4, "b": None, "drawn": None}


def test_a_newer_database_is_refused_and_not_changed(old: Path) -> None:
    open_project(old).close()
    path = old / "project.db"
    newest = MIGRATIONS[-1].version
    with pytest.raises(
        ProjectError, match=rf"newer annotator \(database version {newest}, this one supports up to 1\)"
    ):
        open_store(path, migrations=MIGRATIONS[:1])
    assert _version(path) == newest


def test_an_upgrade_that_is_killed_afterwards_leaves_a_database_that_opens(tmp_path: Path) -> None:
    create_project(tmp_path, "room", ["hand"]).close()
    next_one = (*MIGRATIONS, Migration(len(MIGRATIONS) + 1, ("CREATE TABLE more (a)",)))
    left = tmp_path / "left"
    store = open_store(tmp_path / "room" / "project.db", migrations=next_one)
    shutil.copytree(tmp_path / "room", left)  # as after a kill: with the `-wal`
    store.close()
    assert (left / "project.db-wal").stat().st_size > 0
    open_store(left / "project.db", migrations=next_one).close()


def test_a_migration_that_fails_leaves_the_database_as_it_was(old: Path) -> None:
    path = old / "project.db"
    bad = (*MIGRATIONS, Migration(len(MIGRATIONS) + 1, ("CREATE TABLE half (a)", "CREATE TABLE frames (a)")))
    with pytest.raises(ProjectError, match=r"its tables are not those of its version; .* already exists"):
        open_store(path, migrations=bad)
    assert _version(path) == 1
    with open_project(old) as project, project.store.read() as connection:
        names = connection.exec_driver_sql("SELECT name FROM sqlite_master").scalars().all()
        assert "half" not in names
        project.frames.finalise(2, by_hand())


def test_versions_are_numbered_without_gaps() -> None:
    assert [migration.version for migration in MIGRATIONS] == list(range(1, len(MIGRATIONS) + 1))
