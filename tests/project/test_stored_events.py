"""Values stored in an event are read back without loss."""

from __future__ import annotations

import sqlite3
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import RigidTransform
from store_samples import (
    box_at,
    boxes_2d,
    by_hand,
    by_machine,
    oriented_boxes,
    proposal_at,
    proposals,
    same_box,
    state_of,
)

from annotator.project import NewLabel, Project
from annotator.project.audit.events import rows_json
from annotator.project.changes import LabelCreated
from annotator.project.database.schema import PACKED_FROM
from annotator.project.records import BOXES_2D, BoxRecord, ProposalRecord, ViewGeometry, storable
from annotator.types import Box2D, BoxKind, OrientedBox, PseudoView
from annotator.types.errors import ProjectError


@given(oriented_boxes())
def test_a_box_is_read_back_bit_for_bit(box: OrientedBox) -> None:
    assert same_box(BoxRecord.model_validate_json(BoxRecord.of(box).model_dump_json()).box(), box)


@given(proposals())
def test_a_proposal_is_read_back_exactly(proposal) -> None:
    back = ProposalRecord.model_validate_json(ProposalRecord.of(proposal).model_dump_json()).proposal()
    assert same_box(back.box, proposal.box)
    for field in ("label", "score", "image_box", "trace", "quality"):
        assert getattr(back, field) == getattr(proposal, field)


@given(st.lists(boxes_2d(), max_size=4).map(tuple))
def test_boxes_are_read_back_exactly(boxes: tuple[Box2D, ...]) -> None:
    assert BOXES_2D.validate_json(BOXES_2D.dump_json(boxes)) == boxes


def test_the_geometry_of_a_view_is_read_back() -> None:
    axes = np.eye(3)[[1, 2, 0]]
    picture, no_points = np.zeros((4, 5, 3), np.uint8), np.zeros((0, 3), np.float32)
    view = PseudoView(picture, axes, 0.01, np.array([-1.0, 0.5]), no_points, look_px=224)
    geometry = ViewGeometry.model_validate_json(ViewGeometry.of(view).model_dump_json())
    assert np.array_equal(np.array(geometry.axes), axes)
    assert (geometry.metres_per_px, geometry.origin_m, geometry.look_px) == (0.01, (-1.0, 0.5), 224)


NEW = LabelCreated(uid="a", label="hand", box=BoxRecord.of(OrientedBox.at(RigidTransform.identity(), np.ones(3))))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"uid":"a"', '"uid":"a","extra":1'),
        ('"size_m":[1.0,1.0,1.0]', '"size_m":[1.0,1.0,-1.0]'),
        ('"size_m":[1.0,1.0,1.0]', '"size_m":[1.0,1.0,"NaN"]'),
        ("[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]", "[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,-1.0]]"),
        ("[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]", "[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.1,1.0]]"),
        ('"state":"accepted"', '"state":"proposed"'),
    ],
)
def test_an_invalid_event_is_refused(old: str, new: str) -> None:
    content = NEW.model_dump_json()
    assert old in content
    assert LabelCreated.model_validate_json(content) == NEW
    with pytest.raises(ValidationError):
        LabelCreated.model_validate_json(content.replace(old, new))


def test_unknown_fields_deep_in_a_trace_are_refused() -> None:
    content = ProposalRecord.of(proposal_at()).model_dump_json()
    assert '"metres_per_px"' in content
    with pytest.raises(ValidationError, match="Unexpected keyword"):
        ProposalRecord.model_validate_json(content.replace('"metres_per_px"', '"typo":1,"metres_per_px"', 1))


def test_a_pose_with_an_invalid_rotation_is_refused_with_a_clear_error() -> None:
    sheared = np.eye(4)
    sheared[0, 1] = 0.5
    with (
        pytest.raises(ProjectError, match=r"this box cannot be stored: rotation: .*not a rotation"),
        storable("this box"),
    ):
        BoxRecord.of(OrientedBox(sheared, np.ones(3)))


# --- long events are compressed in the database; the project's API does not show it -----------------------------------


def stored(project: Project) -> list[str | bytes]:
    connection = sqlite3.connect(project.path / "project.db")
    rows = [row[0] for row in connection.execute("SELECT rows FROM events ORDER BY id")]
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
    content = rows_json(passed.rows)
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


# --- events cannot be changed or removed, not even with plain SQL -----------------------------------------------------


@pytest.mark.parametrize("careful", [False, True])
@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE events SET author = 'eve'",
        "UPDATE events SET rows = '[]' WHERE id = 1",
        "DELETE FROM events",
        "INSERT OR REPLACE INTO events SELECT * FROM events",
        "INSERT OR REPLACE INTO events (frame_id, revision, kind, rows, author, time_ns, source) "
        "SELECT frame_id, revision, kind, rows, 'eve', time_ns, source FROM events",
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
