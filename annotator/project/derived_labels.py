"""Updates of the table `labels` by the events about 3D boxes."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection, case, delete, func, insert, select, update

from annotator.project.event_types import (
    LabelAccepted,
    LabelChange,
    LabelCreated,
    LabelDeleted,
    LabelEdited,
    LabelProposed,
    LabelRejected,
    LabelRestored,
    LinkedLabel,
    ProposalsReplaced,
    ProposedObject,
)
from annotator.project.events import Event
from annotator.project.records import ProposalRecord, box_2d_json, suggestion_json
from annotator.project.schema import labels
from annotator.types import ReviewState, Source
from annotator.types.errors import ProjectError

Value = str | int | float | None


def replace_proposals(connection: Connection, event: Event, payload: ProposalsReplaced) -> None:
    """Applies an automatic pass: its proposals replace the unreviewed labels of the frame."""
    unreviewed = (labels.c.frame_id == event.frame_id) & (labels.c.state == ReviewState.PROPOSED.value)
    connection.execute(delete(labels).where(unreviewed))
    rows = [_proposed_row(event, entry, payload) for entry in payload.objects if entry.covered_by is None]
    if rows:
        connection.execute(insert(labels), rows)


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
    """Inserts a label that does not come from an automatic pass.

    Raises:
        ProjectError: its uid exists already.
    """
    if connection.execute(select(labels.c.id).where(labels.c.uid == payload.uid)).first():
        raise ProjectError(f"label {payload.uid} exists already")
    row: dict[str, Value] = {
        "uid": payload.uid,
        "frame_id": event.frame_id,
        "label": payload.label,
        "box": payload.box.model_dump_json(),
        "track_id": payload.track_id,
        "track_linked": False,
        "box_kind": payload.box_kind.value,
    }
    row |= _authorship(event)
    if isinstance(payload, LabelCreated):
        row |= {"score": payload.score, "state": payload.state.value}
        row |= {"origin": payload.origin, "image_box": box_2d_json(payload.image_box)}
        row |= {"suggestion": suggestion_json(payload.suggestion)}
    else:
        row |= {"state": ReviewState.PROPOSED.value, "source": Source.AUTO.value}
        row |= {"track_linked": payload.track_id is not None}
        if payload.proposal is not None:
            row |= {"score": payload.proposal.score} | _proposal_values(event, payload.proposal)
    connection.execute(insert(labels), row)


def link_label(connection: Connection, event: Event, linked: LinkedLabel) -> None:
    """Sets the track id of one label from linking, and the smoothed box of an open proposal.

    Raises:
        ProjectError: the label is missing, or its box would change although it has been reviewed.
    """
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


def change_label(connection: Connection, event: Event, payload: LabelChange) -> None:
    """Applies a review.

    Raises:
        ProjectError: the label is not in the frame.
    """
    if isinstance(payload, LabelDeleted):
        same = (labels.c.uid == payload.uid) & (labels.c.frame_id == event.frame_id)
        _require_one(payload.uid, connection.execute(delete(labels).where(same)).rowcount)
    else:
        put_label(connection, event, payload.uid, _new_values(payload))


def put_label(connection: Connection, event: Event, uid: str, values: dict[str, Any]) -> None:
    """Sets columns of a label, and the event's author and time.

    Raises:
        ProjectError: it is not in the frame.
    """
    same = (labels.c.uid == uid) & (labels.c.frame_id == event.frame_id)
    changes = {"author": event.author, "time_ns": event.time_ns, "event_id": event.id} | values
    _require_one(uid, connection.execute(update(labels).where(same).values(**changes)).rowcount)


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
    """Restores a label to a former state.

    Raises:
        ProjectError: a label with its uid is in another frame.
    """
    former = payload.former
    same = labels.c.uid == payload.uid
    if connection.execute(select(labels.c.id).where(same, labels.c.frame_id != event.frame_id)).first():
        raise ProjectError(f"label {payload.uid} is in another frame")
    connection.execute(delete(labels).where(same))
    row: dict[str, Value] = former.model_dump(exclude={"box", "image_box", "suggestion", "place"}, mode="json")
    row |= {
        "uid": payload.uid,
        "frame_id": event.frame_id,
        "box": former.box.model_dump_json(),
        "image_box": box_2d_json(former.image_box),
        "suggestion": suggestion_json(former.suggestion),
        "event_id": event.id,
    }
    # the former row id restores the order of the frame's labels, unless another label uses it now
    if not connection.execute(select(labels.c.id).where(labels.c.id == former.place)).first():
        row["id"] = former.place
    connection.execute(insert(labels), row)


def _authorship(event: Event) -> dict[str, Value]:
    return {
        "author": event.author,
        "time_ns": event.time_ns,
        "source": event.source.value,
        "event_id": event.id,
    }
