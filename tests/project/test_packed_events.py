"""Long events are compressed in the database; the project's API does not show it."""

from __future__ import annotations

import sqlite3
import zlib

import pytest
from store_samples import box_at, by_hand, by_machine, proposal_at, state_of

from annotator.project import NewLabel, Project
from annotator.project.database.schema import PACKED_FROM
from annotator.types import Box2D, BoxKind
from annotator.types.errors import ProjectError


def stored(project: Project) -> list[str | bytes]:
    connection = sqlite3.connect(project.path / "project.db")
    rows = [row[0] for row in connection.execute("SELECT payload FROM events ORDER BY id")]
    connection.close()
    return rows


def fill(project: Project, frame: int) -> None:
    project.proposals.replace(frame, [proposal_at(5.0 * n, steps=3, views=8) for n in range(3)], by_machine())
    project.boxes.set_on_image(frame, [Box2D("hand", 1.0, 2.0, 3.0, 4.0)], BoxKind.BOX, by_hand(1))


def test_long_events_are_compressed_and_read_back(project: Project, frame: int) -> None:
    fill(project, frame)
    packed, text = stored(project)
    assert isinstance(packed, bytes)
    assert isinstance(text, str)
    passed, _ = project.log.of_frame(frame)
    content = passed.payload.model_dump_json()
    assert zlib.decompress(packed).decode() == content
    assert len(content) > max(PACKED_FROM, 3 * len(packed))
    before = state_of(project)
    assert project.log.rebuild() == 2
    assert state_of(project) == before
    latest = project.proposals.latest(frame)
    assert latest is not None
    assert [found.proposal.trace for found in latest.objects] == [proposal_at(steps=3, views=8).trace] * 3


def test_a_damaged_event_is_reported(project: Project, frame: int) -> None:
    connection = sqlite3.connect(project.path / "project.db")
    connection.execute(
        "INSERT INTO events (frame_id, revision, kind, payload, author, time_ns, source) "
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
