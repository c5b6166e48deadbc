"""The adjustment of a recording (its up direction, its calibration), and how it moves what is stored.

Boxes and pseudo-views stay where they are in the clouds when the correction of the calibration changes. So their poses
in the camera frame move with the clouds.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import TypeAdapter
from scipy.spatial.transform import RigidTransform
from sqlalchemy import Connection, Select, bindparam, delete, insert, select, update

from annotator.project.database.schema import AnyRow, adjustments, events, frames, labels, recordings, view_labels
from annotator.project.log.event_types import PAYLOAD, LabelState, RecordingAdjusted, ViewBoxesState
from annotator.project.log.records import BoxRecord, SaidRecord, ViewGeometry, parsed, said_json, said_of
from annotator.types import NO_CORRECTION, Correction
from annotator.types.errors import ProjectError

Up = tuple[float, float, float]


@dataclass(frozen=True)
class Adjustment:
    """What the project sets for a recording.

    Attributes:
        up: unit vector against gravity in the (corrected) camera frame; None = as the files give it.
        correction: of the calibration.
    """

    up: Up | None
    correction: Correction = NO_CORRECTION


_ADJUSTMENT: TypeAdapter[Adjustment] = TypeAdapter(Adjustment)
_CORRECTION: TypeAdapter[Correction] = TypeAdapter(Correction)


def adjustment_json(adjustment: Adjustment) -> str:
    """An adjustment as JSON; equal texts are equal adjustments."""
    return _ADJUSTMENT.dump_json(adjustment).decode()


def adjustment_of(content: str) -> Adjustment:
    """The adjustment of a JSON text."""
    return parsed(_ADJUSTMENT.validate_json, content)


def read_adjustment(connection: Connection, recording_id: int) -> Adjustment:
    """The present adjustment of a recording; without any event, the up direction that it was added with."""
    row = connection.execute(select(adjustments).where(adjustments.c.recording_id == recording_id)).first()
    if row is not None:
        return Adjustment(_up(row.up), parsed(_CORRECTION.validate_json, row.correction))
    added = select(recordings.c.up).where(recordings.c.id == recording_id)
    return Adjustment(_up(connection.execute(added).scalar_one()))


def put_adjustment(connection: Connection, recording_id: int, adjustment: Adjustment, event_id: int) -> None:
    """Replaces the adjustment of a recording."""
    connection.execute(delete(adjustments).where(adjustments.c.recording_id == recording_id))
    row = {
        "recording_id": recording_id,
        "up": None if adjustment.up is None else json.dumps(adjustment.up),
        "correction": _CORRECTION.dump_json(adjustment.correction).decode(),
        "event_id": event_id,
    }
    connection.execute(insert(adjustments), row)


def adjustment_in(row: AnyRow) -> tuple[Adjustment, int]:
    """The adjustment in a row of recordings joined with adjustments, and the id of its event (0 = none)."""
    if row.adjusted is None:
        return Adjustment(_up(row.up)), 0
    return Adjustment(_up(row.adjusted_up), parsed(_CORRECTION.validate_json, row.correction)), row.adjusted


def _up(content: str | None) -> Up | None:
    return None if content is None else tuple(parsed(json.loads, content))


def unit_up(up: Sequence[float | int] | np.ndarray) -> Up:
    """The unit vector of a direction, (3,), any length."""
    vector = np.asarray(up, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not np.linalg.norm(vector) > 0:
        raise ProjectError(f"the up direction must be three finite numbers, not all zero, not {up}")
    x, y, z = (vector / np.linalg.norm(vector)).tolist()
    return x, y, z


# --- what moves with the clouds ---------------------------------------------------------------------------------------
# Earlier states, which undo compares and restores, are moved when they are read.

ADJUSTED = "recording_adjusted"


def adjust(connection: Connection, event_id: int, payload: RecordingAdjusted) -> None:
    """Stores an adjustment, and moves the recording's labels and views with its clouds.

    All frames of the recording get a new revision, so that changes which are based on the earlier geometry are refused.
    """
    before = read_adjustment(connection, payload.recording).correction
    put_adjustment(connection, payload.recording, Adjustment(payload.up, payload.correction), event_id)
    of_recording = (frames.c.recording_id == payload.recording) & (frames.c.id <= payload.last_frame)
    connection.execute(update(frames).where(of_recording).values(revision=frames.c.revision + 1))
    T = between(before, payload.correction)
    if T is not None:
        ids = select(frames.c.id).where(frames.c.recording_id == payload.recording)
        _move_labels(connection, ids, T)
        _move_views(connection, ids, T)


def between(before: Correction, after: Correction) -> RigidTransform | None:
    """From the camera frame with one correction to that with another; None if both place the clouds alike."""
    if (before.turn_rad, before.shift_m) == (after.turn_rad, after.shift_m):
        return None
    return after.T_camera_recorded * before.T_camera_recorded.inv()


class Moves:
    """How the clouds of each recording were moved over time, within one transaction."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._corrections: dict[int, list[tuple[int, Correction]]] = {}
        self._recordings: dict[int, int] = {}
        query = select(events.c.id, events.c.payload).where(events.c.kind == ADJUSTED).order_by(events.c.id)
        for row in connection.execute(query):
            payload = parsed(PAYLOAD.validate_json, row.payload)
            assert isinstance(payload, RecordingAdjusted)
            self._corrections.setdefault(payload.recording, []).append((row.id, payload.correction))

    @property
    def corrected(self) -> frozenset[int]:
        """Recordings that have, or once had, a correction."""
        steps = self._corrections.items()
        return frozenset(id for id, made in steps if any(correction != NO_CORRECTION for _, correction in made))

    def since(self, frame_id: int | None, event_id: int) -> RigidTransform | None:
        """From the camera frame at the event `event_id` to the present one; None if the clouds are where they were."""
        if not self._corrections or frame_id is None:
            return None
        if frame_id not in self._recordings:
            query = select(frames.c.recording_id).where(frames.c.id == frame_id)
            self._recordings[frame_id] = self._connection.execute(query).scalar_one()
        steps = self._corrections.get(self._recordings[frame_id], [])
        if not steps or steps[-1][0] <= event_id:
            return None
        then = next((correction for id, correction in reversed(steps) if id <= event_id), NO_CORRECTION)
        return between(then, steps[-1][1])


def moved_box(box: BoxRecord, T: RigidTransform) -> BoxRecord:
    """A box that is moved with the cloud."""
    return BoxRecord.of(box.box().transformed(T))


def moved_geometry(geometry: ViewGeometry, T: RigidTransform) -> ViewGeometry:
    """The geometry of a pseudo-view that is moved with the cloud; its picture stays the same."""
    axes = np.array(geometry.axes) @ T.rotation.inv().as_matrix()
    origin = np.array(geometry.origin_m) + axes[:2] @ T.translation
    return geometry.model_copy(update={"axes": tuple(map(tuple, axes.tolist())), "origin_m": tuple(origin.tolist())})


def moved_label(state: str, T: RigidTransform) -> str:
    """A label's state, as `read_state` returns it, moved with the cloud."""
    label = parsed(LabelState.model_validate_json, state)
    update = {"box": moved_box(label.box, T), "said": moved_said(label.said, T)}
    return label.model_copy(update=update).model_dump_json()


def moved_said(said: tuple[SaidRecord, ...], T: RigidTransform) -> tuple[SaidRecord, ...]:
    """What sources say of objects, moved with the cloud."""
    return tuple(each.model_copy(update={"box": moved_box(each.box, T)}) for each in said)


def moved_view(state: str, T: RigidTransform) -> str:
    """A pseudo-view's state, as `read_state` returns it, moved with the cloud."""
    view = parsed(ViewBoxesState.model_validate_json, state)
    if view.geometry is None:
        return state
    return view.model_copy(update={"geometry": moved_geometry(view.geometry, T)}).model_dump_json()


def _move_labels(connection: Connection, frame_ids: Select[tuple[int]], T: RigidTransform) -> None:
    columns = (labels.c.id, labels.c.box, labels.c.said)
    rows = connection.execute(select(*columns).where(labels.c.frame_id.in_(frame_ids)))
    moved = [
        {
            "row": row.id,
            "moved": moved_box(parsed(BoxRecord.model_validate_json, row.box), T).model_dump_json(),
            "moved_said": said_json(moved_said(said_of(row.said), T)),
        }
        for row in rows
    ]
    if moved:
        same = labels.c.id == bindparam("row")
        change = update(labels).where(same).values(box=bindparam("moved"), said=bindparam("moved_said"))
        connection.execute(change, moved)


def _move_views(connection: Connection, frame_ids: Select[tuple[int]], T: RigidTransform) -> None:
    known = view_labels.c.geometry.is_not(None) & view_labels.c.frame_id.in_(frame_ids)
    rows = connection.execute(select(view_labels.c.id, view_labels.c.geometry).where(known))
    moved = [
        {
            "row": row.id,
            "moved": moved_geometry(parsed(ViewGeometry.model_validate_json, row.geometry), T).model_dump_json(),
        }
        for row in rows
    ]
    if moved:
        same = view_labels.c.id == bindparam("row")
        connection.execute(update(view_labels).where(same).values(geometry=bindparam("moved")), moved)
