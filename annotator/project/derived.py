"""The present state, as tables that follow from the events: kept up with every event, or rebuilt from all of them."""

from __future__ import annotations

from sqlalchemy import Connection, delete, insert, select, update

from annotator.project.events import Event, read_events
from annotator.project.payloads import (
    FrameFinalised,
    FrameReopened,
    ImageBoxesRemoved,
    ImageBoxesRestored,
    ImageBoxesSet,
    ImageBoxesState,
    LabelAccepted,
    LabelChange,
    LabelCreated,
    LabelDeleted,
    LabelEdited,
    LabelRejected,
    LabelRestored,
    ProposalsReplaced,
    ProposedObject,
    ViewBoxesRemoved,
    ViewBoxesRestored,
    ViewBoxesSet,
    ViewBoxesState,
)
from annotator.project.records import BOXES_2D, box_2d_json
from annotator.project.schema import DERIVED, frames, image_labels, labels, revertible, view_labels
from annotator.project.subjects import read_subject, subject_of
from annotator.types import ReviewState, Source
from annotator.types.errors import ProjectError

Value = str | int | float | None


def apply_event(connection: Connection, event: Event) -> None:
    """Bring the derived tables from the state before `event` to the state after it.

    Raises:
        ProjectError: the event does not fit the state, such as a change of a label that is not there.
    """
    if event.action is None:
        _apply(connection, event)
    else:
        # what undo will want to know
        subject = subject_of(event.payload)
        before = read_subject(connection, event.frame_id, subject)
        _apply(connection, event)
        after = read_subject(connection, event.frame_id, subject)
        row = {"event_id": event.id, "subject": subject, "before": before, "after": after}
        connection.execute(insert(revertible), row)
    if event.frame_id is not None:
        connection.execute(update(frames).where(frames.c.id == event.frame_id).values(revision=event.revision))


def _apply(connection: Connection, event: Event) -> None:
    payload = event.payload
    match payload:
        case ImageBoxesSet():
            _put_image_boxes(connection, event, ImageBoxesState.model_validate(_said(event, payload)))
        case ViewBoxesSet():
            state = _said(event, payload) | {"step": payload.step, "geometry": payload.geometry}
            _put_view_boxes(connection, event, payload.view, ViewBoxesState.model_validate(state))
        case ProposalsReplaced():
            _replace_proposals(connection, event, payload)
        case LabelCreated():
            _create_label(connection, event, payload)
        case FrameFinalised() | FrameReopened():
            _set_finalised(connection, event, isinstance(payload, FrameFinalised))
        case LabelAccepted() | LabelEdited() | LabelRejected() | LabelDeleted():
            _change_label(connection, event, payload)
        case LabelRestored():
            _restore_label(connection, event, payload)
        case ImageBoxesRestored():
            _put_image_boxes(connection, event, payload.former)
        case ImageBoxesRemoved():
            _put_image_boxes(connection, event, None)
        case ViewBoxesRestored():
            _put_view_boxes(connection, event, payload.view, payload.former)
        case ViewBoxesRemoved():
            _put_view_boxes(connection, event, payload.view, None)


def rebuild(connection: Connection) -> int:
    """Empty the derived tables and replay every event; returns their number."""
    for table in DERIVED:
        connection.execute(delete(table))
    connection.execute(update(frames).values(revision=0, finalised=False))
    count = 0
    for event in read_events(connection):
        apply_event(connection, event)
        count += 1
    return count


def _stamp(event: Event) -> dict[str, Value]:
    return {
        "author": event.author,
        "time_ns": event.time_ns,
        "source": event.source.value,
        "event_id": event.id,
    }


def _said(event: Event, payload: ImageBoxesSet | ViewBoxesSet) -> dict[str, object]:
    """What the state of new boxes has in common."""
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


def _replace_proposals(connection: Connection, event: Event, payload: ProposalsReplaced) -> None:
    unreviewed = (labels.c.frame_id == event.frame_id) & (labels.c.state == ReviewState.PROPOSED.value)
    connection.execute(delete(labels).where(unreviewed))
    rows = [_proposed_row(event, entry, payload.run) for entry in payload.objects if entry.covered_by is None]
    if rows:
        connection.execute(insert(labels), rows)


def _proposed_row(event: Event, entry: ProposedObject, run_id: int | None) -> dict[str, Value]:
    proposal = entry.proposal
    row: dict[str, Value] = {
        "uid": entry.uid,
        "frame_id": event.frame_id,
        "label": proposal.label,
        "box": proposal.box.model_dump_json(),
        "score": proposal.score,
        "state": ReviewState.PROPOSED.value,
        "track_id": None,
        "view_disagreement": proposal.quality.view_disagreement,
        "kept_share": proposal.quality.kept_share,
        "last_change": proposal.quality.last_change,
        "image_agreement": proposal.quality.image_agreement,
        "proposal_event_id": event.id,
        "run_id": run_id,
    }
    # an automatic pass proposes, whoever started it
    return row | _stamp(event) | {"source": Source.AUTO.value}


def _create_label(connection: Connection, event: Event, payload: LabelCreated) -> None:
    if connection.execute(select(labels.c.id).where(labels.c.uid == payload.uid)).first():
        raise ProjectError(f"label {payload.uid} exists already")
    row: dict[str, Value] = {
        "uid": payload.uid,
        "frame_id": event.frame_id,
        "label": payload.label,
        "box": payload.box.model_dump_json(),
        "score": payload.score,
        "state": payload.state.value,
        "track_id": payload.track_id,
        "origin": payload.origin,
        "image_box": box_2d_json(payload.image_box),
    }
    connection.execute(insert(labels), row | _stamp(event))


def _change_label(connection: Connection, event: Event, payload: LabelChange) -> None:
    chosen = (labels.c.uid == payload.uid) & (labels.c.frame_id == event.frame_id)
    if isinstance(payload, LabelDeleted):
        changed = connection.execute(delete(labels).where(chosen)).rowcount
    else:
        changes: dict[str, Value] = {"author": event.author, "time_ns": event.time_ns, "event_id": event.id}
        changed = connection.execute(update(labels).where(chosen).values(**changes | _new_values(payload))).rowcount
    if changed != 1:
        raise ProjectError(f"label {payload.uid} is not in this frame (any more); reload the frame")


def _new_values(payload: LabelAccepted | LabelEdited | LabelRejected) -> dict[str, Value]:
    match payload:
        case LabelAccepted():
            return {"state": ReviewState.ACCEPTED.value}
        case LabelRejected():
            return {"state": ReviewState.REJECTED.value}
        case LabelEdited():
            moved: dict[str, Value] = {} if payload.image_box is None else {"image_box": box_2d_json(payload.image_box)}
            return moved | {
                "state": ReviewState.EDITED.value,
                "label": payload.label,
                "box": payload.box.model_dump_json(),
                "track_id": payload.track_id,
            }


def _restore_label(connection: Connection, event: Event, payload: LabelRestored) -> None:
    former = payload.former
    chosen = labels.c.uid == payload.uid
    if connection.execute(select(labels.c.id).where(chosen, labels.c.frame_id != event.frame_id)).first():
        raise ProjectError(f"label {payload.uid} is in another frame")
    connection.execute(delete(labels).where(chosen))
    row: dict[str, Value] = former.model_dump(exclude={"box", "image_box", "place"}, mode="json")
    row |= {
        "uid": payload.uid,
        "frame_id": event.frame_id,
        "box": former.box.model_dump_json(),
        "image_box": box_2d_json(former.image_box),
        "event_id": event.id,
    }
    # back in its place among the frame's labels, unless another label has taken the row
    if not connection.execute(select(labels.c.id).where(labels.c.id == former.place)).first():
        row["id"] = former.place
    connection.execute(insert(labels), row)


def _set_finalised(connection: Connection, event: Event, finalised: bool) -> None:
    other = (frames.c.id == event.frame_id) & (frames.c.finalised != finalised)
    if connection.execute(update(frames).where(other).values(finalised=finalised)).rowcount != 1:
        raise ProjectError("the frame is finalised already" if finalised else "the frame is open already")
