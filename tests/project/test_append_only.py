"""Events cannot be changed or removed, not even with plain SQL."""

from __future__ import annotations

import sqlite3

import pytest
from store_samples import by_hand, proposal_at

from annotator.project import Project
from annotator.types import BoxKind


@pytest.mark.parametrize("careful", [False, True])
@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE events SET author = 'eve'",
        "UPDATE events SET payload = '{}' WHERE id = 1",
        "DELETE FROM events",
        "INSERT OR REPLACE INTO events SELECT * FROM events",
        "INSERT OR REPLACE INTO events (frame_id, revision, kind, payload, author, time_ns, source) "
        "SELECT frame_id, revision, kind, payload, 'eve', time_ns, source FROM events",
    ],
)
def test_events_are_append_only(project: Project, frame: int, statement: str, careful: bool) -> None:
    project.boxes.set_on_image(frame, [], BoxKind.BOX, by_hand())
    connection = sqlite3.connect(project.path / "project.db")
    connection.execute(f"PRAGMA recursive_triggers = {int(careful)}")
    before = connection.execute("SELECT * FROM events").fetchall()
    with pytest.raises(sqlite3.IntegrityError, match="append-only"):
        connection.execute(statement)
    connection.rollback()
    assert connection.execute("SELECT * FROM events").fetchall() == before
    connection.close()


def test_the_log_keeps_every_earlier_event(project: Project, frame: int) -> None:
    uid = project.proposals.replace(frame, [proposal_at(0.0)], by_hand()).uids[0]
    project.labels.accept(frame, uid, by_hand(1))
    project.proposals.replace(frame, [proposal_at(7.0)], by_hand(2))
    kinds = [event.payload.kind for event in project.log.of_frame(frame)]
    assert kinds == ["proposals_replaced", "label_accepted", "proposals_replaced"]
    assert [event.id for event in project.log.since(1)] == [2, 3]
