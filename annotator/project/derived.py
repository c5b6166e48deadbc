"""The tables of the present state, derived from the events: updated with each event, or rebuilt from all."""

from __future__ import annotations

from sqlalchemy import Connection, bindparam, delete, insert, update

from annotator.project.adjusting import adjust
from annotator.project.classes.applying import relabel, set_frame_values
from annotator.project.database.schema import DERIVED, frames, image_labels, revertible, view_labels
from annotator.project.derived_labels import (
    change_label,
    change_values,
    create_label,
    link_label,
    put_imported,
    put_label,
    replace_proposals,
    restore_label,
    track_values,
)
from annotator.project.event_types import (
    ClassesChanged,
    FrameAttributesSet,
    FrameFinalised,
    FrameReopened,
    ImageBoxesRemoved,
    ImageBoxesRestored,
    ImageBoxesSet,
    ImageBoxesState,
    LabelAccepted,
    LabelAttributesSet,
    LabelCreated,
    LabelDeleted,
    LabelEdited,
    LabelProposed,
    LabelRejected,
    LabelRestored,
    LabelTracked,
    ProposalsImported,
    ProposalsReplaced,
    RecordingAdjusted,
    TracksLinked,
    ViewBoxesRemoved,
    ViewBoxesRestored,
    ViewBoxesSet,
    ViewBoxesState,
)
from annotator.project.events import Event, read_events
from annotator.project.records import BOXES_2D
from annotator.project.removed import hide_removed
from annotator.project.undo_state import read_state, target_of
from annotator.types.errors import ProjectError

Value = str | int | float | None


# Built once, since building these frequent statements takes longer than running them.
_REVERTIBLE = insert(revertible)
_REVISION = update(frames).where(frames.c.id == bindparam("frame")).values(revision=bindparam("new"))


def apply_event(connection: Connection, event: Event) -> None:
    """Updates the derived tables with one event.

    Raises:
        ProjectError: the event contradicts the state, such as a change of a missing label.
    """
    if event.action is None:
        _apply(connection, event)
    else:
        target = target_of(event.payload)
        before = read_state(connection, event.frame_id, target)
        _apply(connection, event)
        after = read_state(connection, event.frame_id, target)
        row = {"event_id": event.id, "subject": target, "before": before, "after": after}
        connection.execute(_REVERTIBLE, row)
    if event.frame_id is not None:
        connection.execute(_REVISION, {"frame": event.frame_id, "new": event.revision})


def _apply(connection: Connection, event: Event) -> None:
    payload = event.payload
    match payload:
        case ImageBoxesSet():
            _put_image_boxes(connection, event, ImageBoxesState.model_validate(_common_state(event, payload)))
        case ViewBoxesSet():
            state = _common_state(event, payload) | {"step": payload.step, "geometry": payload.geometry}
            _put_view_boxes(connection, event, payload.view, ViewBoxesState.model_validate(state))
        case ProposalsReplaced():
            replace_proposals(connection, event, payload)
        case ProposalsImported():
            put_imported(connection, event, payload)
        case TracksLinked():
            for linked in payload.labels:
                link_label(connection, event, linked)
        case LabelCreated() | LabelProposed():
            create_label(connection, event, payload)
        case LabelTracked():
            put_label(connection, event, payload.uid, track_values(payload.track_id))
            change_values(connection, payload.uid, payload.attributes)
        case LabelAttributesSet():
            put_label(connection, event, payload.uid, {})
            change_values(connection, payload.uid, payload.attributes)
        case FrameAttributesSet():
            set_frame_values(connection, event.frame_id, payload.attributes, event.id)
        case ClassesChanged():
            relabel(connection, payload.change)
        case FrameFinalised() | FrameReopened():
            _set_finalised(connection, event, isinstance(payload, FrameFinalised))
        case LabelAccepted() | LabelEdited() | LabelRejected() | LabelDeleted():
            change_label(connection, event, payload)
        case LabelRestored():
            restore_label(connection, event, payload)
        case ImageBoxesRestored():
            _put_image_boxes(connection, event, payload.former)
        case ImageBoxesRemoved():
            _put_image_boxes(connection, event, None)
        case ViewBoxesRestored():
            _put_view_boxes(connection, event, payload.view, payload.former)
        case ViewBoxesRemoved():
            _put_view_boxes(connection, event, payload.view, None)
        case RecordingAdjusted():
            adjust(connection, event.id, payload)


def rebuild(connection: Connection) -> int:
    """Empties the derived tables and replays all events; returns the number of events."""
    for table in DERIVED:
        connection.execute(delete(table))
    connection.execute(update(frames).values(revision=0, finalised=False))
    count = 0
    for event in read_events(connection):
        apply_event(connection, event)
        count += 1
    hide_removed(connection)
    return count


def _common_state(event: Event, payload: ImageBoxesSet | ViewBoxesSet) -> dict[str, object]:
    """The fields that `ImageBoxesState` and `ViewBoxesState` share."""
    return {
        "boxes": payload.boxes,
        "box_kind": payload.box_kind,
        "author": event.author,
        "time_ns": event.time_ns,
        "source": event.source,
    }


def _put_image_boxes(connection: Connection, event: Event, state: ImageBoxesState | None) -> None:
    connection.execute(delete(image_labels).where(image_labels.c.frame_id == event.frame_id))
    if state is not None:
        row: dict[str, Value] = {"frame_id": event.frame_id, "event_id": event.id}
        connection.execute(insert(image_labels), row | _boxes_row(state))


def _put_view_boxes(connection: Connection, event: Event, view: str, state: ViewBoxesState | None) -> None:
    same = (view_labels.c.view_id == view) & view_labels.c.frame_id.is_not_distinct_from(event.frame_id)
    connection.execute(delete(view_labels).where(same))
    if state is not None:
        row: dict[str, Value] = {
            "view_id": view,
            "frame_id": event.frame_id,
            "revision": event.revision,
            "step": state.step,
            "geometry": state.geometry.model_dump_json() if state.geometry else None,
            "event_id": event.id,
        }
        connection.execute(insert(view_labels), row | _boxes_row(state))


def _boxes_row(state: ImageBoxesState | ViewBoxesState) -> dict[str, Value]:
    return {
        "box_kind": state.box_kind.value,
        "boxes": BOXES_2D.dump_json(state.boxes).decode(),
        "count": len(state.boxes),
        "author": state.author,
        "time_ns": state.time_ns,
        "source": state.source.value,
    }


def _set_finalised(connection: Connection, event: Event, finalised: bool) -> None:
    changes = (frames.c.id == event.frame_id) & (frames.c.finalised != finalised)
    if connection.execute(update(frames).where(changes).values(finalised=finalised)).rowcount != 1:
        raise ProjectError("the frame is already finalised" if finalised else "the frame is not finalised")
