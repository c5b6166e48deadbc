"""Values stored in an event are read back without loss, damage is reported, and no event can be changed."""

from __future__ import annotations

import sqlite3
import zlib

import pytest
from sqlalchemy.exc import IntegrityError
from store_samples import box_at, by_hand

from annotator.project import NewLabel, Project
from annotator.types import BoxKind
from annotator.types.errors import ProjectError


def test_a_damaged_event_is_reported(project: Project, frame: int) -> None:
    connection = sqlite3.connect(project.path / "project.db")
    connection.execute(
        "INSERT INTO events (frame_id, revision, kind, rows, author, time_ns, source) "
        "VALUES (?, 1, 'frame_finalised', ?, 'ann', 5, 'manual')",
        (frame, zlib.compress(b"{}" * 1000)[:-5]),
    )
    connection.commit()
    connection.close()
    with pytest.raises(ProjectError, match=r"event of the project is damaged .* restore it from a backup"):
        project.log.of_frame(frame)


@pytest.mark.parametrize(
    ("table", "column", "damage"),
    [("labels", "box", '{"center_m": [1'), ("labels", "box", "{}"), ("recordings", "up", "[1")],
)
def test_a_damaged_row_is_reported(project: Project, frame: int, table: str, column: str, damage: str) -> None:
    project.labels.create(frame, [NewLabel("hand", box_at(0.0))], by_hand(0))
    with project.store.write() as connection:
        connection.exec_driver_sql(f"UPDATE {table} SET {column} = ?", (damage,))
    with pytest.raises(ProjectError, match=r"a row of the project's database is damaged .* restore it from a backup"):
        _ = project.labels.of_frame(frame), project.recordings.all()


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE events SET author = 'eve'",
        "DELETE FROM events",
        "INSERT OR REPLACE INTO events SELECT * FROM events",
    ],
)
def test_events_are_append_only(project: Project, frame: int, statement: str) -> None:
    project.boxes.set_on_image(frame, [], BoxKind.BOX, by_hand())
    before = list(project.log.since())
    with pytest.raises(IntegrityError, match="append-only"), project.store.write() as connection:
        connection.exec_driver_sql(statement)
    assert list(project.log.since()) == before
