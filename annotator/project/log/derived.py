"""The tables of the present state, derived from the events: updated with each event, or rebuilt from all."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy import ColumnElement, Connection, bindparam, case, delete, func, insert, select, update

from annotator.project.adjusting import adjust
from annotator.project.classes.applying import relabel, set_frame_values, values_of
from annotator.project.classes.attributes import values_json
from annotator.project.database.schema import DERIVED, frames, image_labels, labels, revertible, view_labels
from annotator.project.log.event_types import (
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
    LabelChange,
    LabelCreated,
    LabelDeleted,
    LabelEdited,
    LabelProposed,
    LabelRejected,
    LabelRestored,
    LabelTracked,
    LinkedLabel,
    ProposalsImported,
    ProposalsReplaced,
    ProposedObject,
    RecordingAdjusted,
    TracksLinked,
    ViewBoxesRemoved,
    ViewBoxesRestored,
    ViewBoxesSet,
    ViewBoxesState,
)
from annotator.project.log.events import Event, read_events
from annotator.project.log.records import (
    BOXES_2D,
    OWN,
    OwnColumns,
    ProposalRecord,
    SaidRecord,
    box_2d_json,
    said_json,
    suggestion_json,
    track_of,
)
from annotator.project.log.undo_state import read_state, target_of
from annotator.project.recordings import hide_removed, is_hidden, next_label_id
from annotator.types import ReviewState, Source
from annotator.types.errors import ProjectError
from annotator.types.label import AttributeValue

# --- the table `labels` -----------------------------------------------------------------------------------------------

Value = str | int | float | None

# Built once, since building a statement takes longer than running it.
_INSERT = insert(labels)
_UPDATE = update(labels).where(labels.c.uid == bindparam("same_uid"), labels.c.frame_id == bindparam("same_frame"))
_DELETE_IMPORTED = delete(labels).where(
    labels.c.frame_id == bindparam("frame"),
    labels.c.state == ReviewState.PROPOSED.value,
    labels.c.source == Source.IMPORTED.value,
)


def replace_proposals(connection: Connection, event: Event, payload: ProposalsReplaced) -> None:
    """Applies an automatic pass: its proposals replace the unreviewed labels of the frame, except imported ones."""
    replaced = (labels.c.source != Source.IMPORTED.value) & labels.c.uid.not_in(payload.kept)
    connection.execute(delete(labels).where(_is_open(event), replaced))
    rows = [_proposed_row(event, entry, payload) for entry in payload.objects if entry.covered_by is None]
    if rows:
        _insert(connection, rows)


def _is_open(event: Event) -> ColumnElement[bool]:
    return (labels.c.frame_id == event.frame_id) & (labels.c.state == ReviewState.PROPOSED.value)


def put_imported(connection: Connection, event: Event, payload: ProposalsImported) -> None:
    """Applies what other software says: replaces the open imported proposals, beside ours."""
    columns: dict[str, OwnColumns] = {}
    if payload.hidden or payload.kept:
        columns = _own_columns(connection, event, payload.hidden)
        hidden = (labels.c.source == Source.IMPORTED.value) | labels.c.uid.in_(payload.hidden)
        connection.execute(delete(labels).where(_is_open(event), hidden, labels.c.uid.not_in(payload.kept)))
    else:
        connection.execute(_DELETE_IMPORTED, {"frame": event.frame_id})
    for own in payload.ours:
        same = _is_open(event) & (labels.c.uid == own.uid)
        values = {} if own.attributes is None else {"attributes": values_json(own.attributes)}
        connection.execute(update(labels).where(same).values(said=said_json(own.said), **values))
    groups = [tuple(_with_columns(each, columns.get(each.uid)) for each in group) for group in payload.objects]
    if rows := [_imported_row(event, group) for group in groups]:
        _insert(connection, rows)


def _own_columns(connection: Connection, event: Event, uids: Collection[str]) -> dict[str, OwnColumns]:
    """What the table alone knows of open proposals of ours, by uid."""
    columns = [labels.c[name] for name in OwnColumns.model_fields]
    rows = connection.execute(select(labels.c.uid, *columns).where(_is_open(event), labels.c.uid.in_(uids)))
    return {
        row.uid: OwnColumns.model_validate({name: row._mapping[name] for name in OwnColumns.model_fields})
        for row in rows
    }


def _with_columns(said: SaidRecord, own: OwnColumns | None) -> SaidRecord:
    return said if own is None else said.model_copy(update={"own": own})


def _imported_row(event: Event, group: tuple[SaidRecord, ...]) -> dict[str, Value]:
    shown = group[0]
    is_ours = shown.source == OWN
    own = shown.own or OwnColumns(author=shown.source)
    return own.model_dump() | {
        "uid": shown.uid,
        "frame_id": event.frame_id,
        "label": shown.label,
        "box": shown.box.model_dump_json(),
        "score": shown.score,
        "state": ReviewState.PROPOSED.value,
        "track_id": track_of(group),
        "box_kind": shown.box_kind.value,
        "said": said_json(group[1:] if is_ours else group),
        "attributes": values_json(shown.attributes),
        "time_ns": event.time_ns,
        "source": (Source.AUTO if is_ours else Source.IMPORTED).value,
        "event_id": event.id,
    }


def _proposed_row(event: Event, entry: ProposedObject, payload: ProposalsReplaced) -> dict[str, Value]:
    proposal = entry.proposal
    row: dict[str, Value] = {
        "uid": entry.uid,
        "frame_id": event.frame_id,
        "label": proposal.label,
        "box": proposal.box.model_dump_json(),
        "score": proposal.score,
        "state": ReviewState.PROPOSED.value,
        "track_id": entry.track_id,
        "track_linked": entry.track_id is not None,
        "run_id": payload.run,
        "box_kind": payload.box_kind.value,
        "attributes": values_json(entry.attributes),
    } | _proposal_values(event, proposal)
    # the source of a proposal is AUTO, whoever started the pass
    return row | _authorship(event) | {"source": Source.AUTO.value}


def _proposal_values(event: Event, proposal: ProposalRecord) -> dict[str, Value]:
    """The columns of a label that come from the recursion; the full trace stays in the event."""
    return {
        "view_disagreement": proposal.quality.view_disagreement,
        "kept_share": proposal.quality.kept_share,
        "last_change": proposal.quality.last_change,
        "image_agreement": proposal.quality.image_agreement,
        "expected_iou_loss": proposal.quality.expected_iou_loss,
        "proposal_event_id": event.id,
    }


def create_label(connection: Connection, event: Event, payload: LabelCreated | LabelProposed) -> None:
    """Inserts a label that does not come from an automatic pass."""
    if connection.execute(select(labels.c.id).where(labels.c.uid == payload.uid)).first():
        raise ProjectError(f"label {payload.uid} exists already")
    row: dict[str, Value] = {
        "uid": payload.uid,
        "frame_id": event.frame_id,
        "label": payload.label,
        "box": payload.box.model_dump_json(),
        "track_id": payload.track_id,
        "track_linked": False,
        "origin": payload.origin,
        "box_kind": payload.box_kind.value,
        "attributes": values_json(payload.attributes),
        "said": said_json(payload.said),
    }
    row |= _authorship(event)
    if isinstance(payload, LabelCreated):
        row |= {"score": payload.score, "state": payload.state.value}
        row |= {"image_box": box_2d_json(payload.image_box), "suggestion": suggestion_json(payload.suggestion)}
    else:
        row |= {"state": ReviewState.PROPOSED.value, "source": Source.AUTO.value}
        row |= {"track_linked": payload.track_id is not None}
        if payload.proposal is not None:
            row |= {"score": payload.proposal.score} | _proposal_values(event, payload.proposal)
    _insert(connection, [row])


def link_label(connection: Connection, event: Event, linked: LinkedLabel) -> None:
    """Sets the track id of one label from linking, and the smoothed box of an open proposal."""
    values: dict[str, Any] = {"event_id": event.id}
    if linked.track_id is not None:
        values |= {"track_id": linked.track_id, "track_linked": True}
    condition = (labels.c.uid == linked.uid) & (labels.c.frame_id == event.frame_id)
    if linked.box is not None:
        # linking never changes a reviewed box
        condition &= labels.c.state == ReviewState.PROPOSED.value
        values["box"] = linked.box.model_dump_json()
    if connection.execute(update(labels).where(condition).values(**values)).rowcount != 1:
        raise ProjectError(
            f"label {linked.uid} is not in this frame, or has been reviewed since; link the tracks again"
        )
    change_values(connection, linked.uid, linked.attributes)


def change_label(connection: Connection, event: Event, payload: LabelChange) -> None:
    """Applies a review."""
    if isinstance(payload, LabelDeleted):
        same = (labels.c.uid == payload.uid) & (labels.c.frame_id == event.frame_id)
        _require_one(payload.uid, connection.execute(delete(labels).where(same)).rowcount)
    else:
        put_label(connection, event, payload.uid, _new_values(payload))
        if isinstance(payload, LabelEdited):
            change_values(connection, payload.uid, payload.attributes)


def change_values(connection: Connection, uid: str, changed: Mapping[str, AttributeValue | None]) -> None:
    """Sets values of a label's attributes; None removes one."""
    if not changed:
        return
    same = labels.c.uid == uid
    present = values_of(connection.execute(select(labels.c.attributes).where(same)).scalar())
    new = {name: value for name, value in (present | dict(changed)).items() if value is not None}
    connection.execute(update(labels).where(same).values(attributes=values_json(new)))


def put_label(connection: Connection, event: Event, uid: str, values: dict[str, Any]) -> None:
    """Sets columns of a label, and the event's author and time."""
    changes = {"author": event.author, "time_ns": event.time_ns, "event_id": event.id} | values
    computed = {name: value for name, value in changes.items() if isinstance(value, ColumnElement)}
    plain = {name: value for name, value in changes.items() if name not in computed}
    statement = _UPDATE.values(computed) if computed else _UPDATE
    same = {"same_uid": uid, "same_frame": event.frame_id}
    _require_one(uid, connection.execute(statement, same | plain).rowcount)


def _require_one(uid: str, changed: int) -> None:
    if changed != 1:
        raise ProjectError(f"label {uid} is not in this frame; it may have been deleted; reload the frame")


def track_values(track_id: int | None) -> dict[str, Any]:
    """Columns for a track id set by a person or a file; `track_linked` is kept if the id does not change."""
    same = labels.c.track_id.is_not_distinct_from(track_id)
    return {"track_id": track_id, "track_linked": case((same, labels.c.track_linked), else_=False)}


def _new_values(payload: LabelAccepted | LabelEdited | LabelRejected) -> dict[str, Any]:
    match payload:
        case LabelAccepted():
            return {"state": ReviewState.ACCEPTED.value}
        case LabelRejected():
            return {"state": ReviewState.REJECTED.value}
        case LabelEdited():
            drawn: dict[str, Any] = {} if payload.image_box is None else {"image_box": box_2d_json(payload.image_box)}
            edited = {"label": payload.label, "box": payload.box.model_dump_json()}
            edited |= {"suggestion": _new_suggestion(payload)}
            if payload.box_kind is not None:
                edited["box_kind"] = payload.box_kind.value
            return drawn | edited | {"state": ReviewState.EDITED.value} | track_values(payload.track_id)


def _new_suggestion(payload: LabelEdited) -> Any:
    """The column `suggestion` after an edit: another 3D box than the suggested one counts as corrected."""
    if payload.suggestion is not None:
        return suggestion_json(payload.suggestion)
    is_same = labels.c.box == payload.box.model_dump_json()
    corrected = func.json_set(labels.c.suggestion, "$.corrected", func.json("true"))
    return case((is_same, labels.c.suggestion), else_=corrected)


def restore_label(connection: Connection, event: Event, payload: LabelRestored) -> None:
    """Restores a label to a former state."""
    former = payload.former
    same = labels.c.uid == payload.uid
    if connection.execute(select(labels.c.id).where(same, labels.c.frame_id != event.frame_id)).first():
        raise ProjectError(f"label {payload.uid} is in another frame")
    connection.execute(delete(labels).where(same))
    row: dict[str, Value] = former.model_dump(
        exclude={"box", "image_box", "suggestion", "said", "place", "attributes"}, mode="json"
    )
    row |= {
        "uid": payload.uid,
        "frame_id": event.frame_id,
        "box": former.box.model_dump_json(),
        "image_box": box_2d_json(former.image_box),
        "suggestion": suggestion_json(former.suggestion),
        "said": said_json(former.said),
        "attributes": values_json(former.attributes),
        "event_id": event.id,
    }
    # the former row id restores the order of the frame's labels, unless another label uses it now
    taken = connection.execute(select(labels.c.id).where(labels.c.id == former.place)).first() is not None
    if not taken and not is_hidden(connection, former.place):
        row["id"] = former.place
    _insert(connection, [row])


def _insert(connection: Connection, rows: list[dict[str, Value]]) -> None:
    """Inserts labels; those without an id get the next ones."""
    if (first := next_label_id(connection)) is not None:
        rows = [{"id": number} | row for number, row in enumerate(rows, first)]
    connection.execute(_INSERT, rows)


def _authorship(event: Event) -> dict[str, Value]:
    return {
        "author": event.author,
        "time_ns": event.time_ns,
        "source": event.source.value,
        "event_id": event.id,
    }


# --- all tables -------------------------------------------------------------------------------------------------------

# Built once, since building these frequent statements takes longer than running them.
_REVERTIBLE = insert(revertible)
_REVISION = update(frames).where(frames.c.id == bindparam("frame")).values(revision=bindparam("new"))


def apply_event(connection: Connection, event: Event) -> None:
    """Updates the derived tables with one event."""
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
