"""Values stored in an event are read back without loss, damage is reported, and no event can be changed."""

from __future__ import annotations

import math
import sqlite3
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from sqlalchemy.exc import IntegrityError
from store_samples import box_at, by_hand, matrix3, same_box

from annotator.project import NewLabel, Project
from annotator.project.records import BoxRecord, ProposalRecord, storable
from annotator.types import (
    Box2D,
    BoxKind,
    BoxTrace,
    OrientedBox,
    Proposal,
    Quality,
    StepTrace,
    StopReason,
    ViewTrace,
)
from annotator.types.errors import ProjectError


def three(low: float | None, high: float | None) -> st.SearchStrategy[tuple[float, float, float]]:
    return st.tuples(*[st.floats(low, high, allow_nan=False)] * 3)


@given(three(-1e4, 1e4), three(-4.0, 4.0), three(1e-6, 1e3), three(None, None), st.text(min_size=1, max_size=8))
def test_a_proposal_is_read_back_exactly(
    center: tuple[float, float, float],
    turn: tuple[float, float, float],
    size: tuple[float, float, float],
    signals: tuple[float, float, float],
    word: str,
) -> None:
    rotation = Rotation.from_rotvec(turn).as_matrix()
    found = Box2D(word, center[0], center[1], center[0] + size[0], center[1] + size[1], 1 / 3)
    view = ViewTrace(matrix3(rotation), size[0], center[:2], 320, 200, (found,), 0)
    step = StepTrace(word, (word,), (view,), BoxTrace(center, matrix3(rotation), size), 5, 3, StopReason.CONTINUES)
    box = OrientedBox.from_parts(np.array(center), rotation, np.array(size))
    proposal = Proposal(word, 2 / 3, box, found, (step,), Quality(*signals, None, 0.1))
    back = ProposalRecord.model_validate_json(ProposalRecord.of(proposal).model_dump_json()).proposal()
    assert same_box(back.box, proposal.box)
    for field in ("label", "score", "image_box", "trace", "quality"):
        assert getattr(back, field) == getattr(proposal, field)


@pytest.mark.parametrize(
    ("field", "value"),
    [("size_m", (1.0, 1.0, -1.0)), ("size_m", (1.0, 1.0, math.nan)), ("rotation", np.diag([1.0, 1.0, -1.0]).tolist())],
)
def test_a_box_that_is_none_is_refused(field: str, value: object) -> None:
    fields = BoxRecord.of(box_at()).model_dump()
    assert BoxRecord.model_validate(fields) == BoxRecord.of(box_at())
    with pytest.raises(ValidationError):
        BoxRecord.model_validate(fields | {field: value})


def test_a_pose_with_an_invalid_rotation_is_refused_with_a_clear_error() -> None:
    sheared = np.eye(4)
    sheared[0, 1] = 0.5
    with (
        pytest.raises(ProjectError, match=r"this box cannot be stored: rotation: .*not a rotation"),
        storable("this box"),
    ):
        BoxRecord.of(OrientedBox(sheared, np.ones(3)))


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
