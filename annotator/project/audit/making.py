"""What each requested change does to the rows of its frame."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any

from annotator.geometry.oriented_box import same_box
from annotator.project.audit.writing import Write
from annotator.project.changes import (
    REQUESTED,
    FrameAttributesSet,
    FrameFinalised,
    FrameReopened,
    ImageBoxesSet,
    LabelAccepted,
    LabelAttributesSet,
    LabelDeleted,
    LabelEdited,
    LabelMoved,
    LabelRejected,
    LabelTracked,
    LinkedLabel,
    NewLabel,
    Payload,
    ProposalsReplaced,
    TracksLinked,
    ViewBoxesRemoved,
    ViewBoxesSet,
)
from annotator.project.classes.attributes import AttributeOf, fitting
from annotator.project.classes.values import Values, after_edit, checked, new_values, of_tracks
from annotator.project.database.schema import columns_of
from annotator.project.records import OWN, SaidRecord, suggestion_json
from annotator.project.rows import Row, number_or_none, values_json, values_of
from annotator.types import Proposal, ReviewState, Source
from annotator.types.errors import NotFoundError, ProjectError
from annotator.types.label import AttributeValue


def make(write: Write, payload: Payload) -> None:
    """Makes one change."""
    kind, view = payload.kind, None
    match payload:
        case ImageBoxesSet():
            _set_boxes(write, payload, "image_labels", {"frame_id": write.frame_id})
        case ViewBoxesSet():
            view = payload.view
            key = view_key(view, write.frame_id)
            if payload.geometry is not None and payload.geometry.image_box is not None:
                write.class_id(payload.geometry.image_box.label)
            geometry = write.terms.geometry_json(payload.geometry, write.frame_id)
            place = {"key": key, "view_id": view, "frame_id": write.frame_id}
            _set_boxes(write, payload, "view_labels", place | {"step": payload.step, "geometry": geometry})
        case ViewBoxesRemoved():
            view = payload.view
            write.put("view_labels", view_key(view, write.frame_id), None)
        case NewLabel():
            _create(write, payload)
            kind = REQUESTED if payload.is_requested else kind
        case ProposalsReplaced():
            _replace_proposals(write, payload)
        case TracksLinked():
            for linked in payload.labels:
                _link(write, linked)
        case LabelAccepted() | LabelRejected():
            state = ReviewState.ACCEPTED if isinstance(payload, LabelAccepted) else ReviewState.REJECTED
            write.put("labels", payload.uid, write.label(payload.uid) | write.author | {"state": state.value})
        case LabelEdited():
            _edit(write, payload)
        case LabelMoved():
            box = write.terms.box_json(payload.box, write.frame_id)
            write.put("labels", payload.uid, write.label(payload.uid) | write.author | {"box": box})
        case LabelTracked():
            row = write.label(payload.uid)
            name = write.terms.names[row["class_id"]]
            write.put("labels", payload.uid, row | write.author | _tracked(write, row, name, name, payload.track_id))
        case LabelAttributesSet():
            _set_values(write, payload)
        case LabelDeleted():
            write.label(payload.uid)
            for uid in [row["uid"] for row in write.labels() if payload.uid in (row["uid"], row["behind"])]:
                write.put("labels", uid, None)
        case FrameAttributesSet():
            _set_frame_values(write, payload.attributes)
        case FrameFinalised() | FrameReopened():
            _set_finalised(write, isinstance(payload, FrameFinalised))
        case _:
            raise TypeError(f"{payload.kind} is no change that the store knows")
    write.event(kind, view)


def view_key(view_id: str, frame_id: int | None) -> str:
    """The key of a row of `view_labels`."""
    return f"{view_id}:{'' if frame_id is None else frame_id}"


def _set_boxes(write: Write, payload: ImageBoxesSet | ViewBoxesSet, table: str, place: Row) -> None:
    for box in payload.boxes:
        write.class_id(box.label)
    row = {
        "box_kind": payload.box_kind.value,
        "boxes": write.terms.boxes_2d_json(payload.boxes),
        "count": len(payload.boxes),
        "source": write.context.source.value,
    }
    write.put(table, next(iter(place.values())), place | row | write.author)


def new_label(write: Write, uid: str, label: str, **values: Any) -> Row:
    """The row of a new label; columns that are not given have no value."""
    row: Row = dict.fromkeys(columns_of("labels"))
    row |= {"id": write.terms.next_label_id(), "uid": uid, "class_id": write.class_id(label)}
    row |= {"frame_id": write.frame_id, "moment_id": write.moment_id}
    row |= {"source": write.context.source.value, "track_linked": 0, "values_set": 0, "attributes": "{}"}
    return row | write.author | values


def said_row(write: Write, said: SaidRecord, **columns: Any) -> Row:
    """The row of an open proposal that a source has made."""
    is_ours = said.source == OWN
    write.class_id(said.label)  # its words name it by id, too
    row = new_label(
        write,
        write.new_uid(),
        said.label,
        box=write.terms.box_json(said.box, write.frame_id),
        score=said.score,
        state=ReviewState.PROPOSED.value,
        source=(Source.AUTO if is_ours else Source.IMPORTED).value,
        author=said.source,
        track_id=said.track_id,
        box_kind=said.box_kind.value,
        attributes=values_json(said.attributes),
        said=None if is_ours else write.terms.said_json(said, write.frame_id),
        of_source=None if is_ours else said.source,
    )
    return row | columns


def _found(write: Write, proposal: Proposal) -> Row:
    """The columns of a label that come from the recursion."""
    signals = {name: number_or_none(value) for name, value in vars(proposal.quality).items()}
    return {"score": proposal.score, "proposed_box": write.box_json(proposal.box)} | signals


def _values_of_tracks(write: Write, tracks: Collection[int | None]) -> Mapping[int | None, Values]:
    return of_tracks(write.connection, write.terms, write.frame_id, tracks)


def _create(write: Write, payload: NewLabel, run: int | None = None) -> None:
    if write.row("labels", payload.uid) is not None:
        raise ProjectError(f"{write.where}: label {payload.uid} exists already")
    of_label = write.terms.attributes_of(payload.label)
    if payload.image_box is not None:
        write.class_id(payload.image_box.label)
    row = new_label(
        write,
        payload.uid,
        payload.label,
        box=write.box_json(payload.box),
        score=payload.score,
        state=payload.state.value,
        track_id=payload.track_id,
        origin=None if payload.origin is None else payload.origin.value,
        box_kind=payload.box_kind.value,
        image_box=write.terms.box_2d_json(payload.image_box),
        suggestion=suggestion_json(payload.suggestion),
        run_id=run,
    )
    if payload.is_requested:
        given = fitting(of_label, payload.attributes)
        row |= {"source": Source.AUTO.value, "track_linked": int(payload.track_id is not None)}
        row |= {} if payload.proposal is None else _found(write, payload.proposal)
    else:
        given = checked(of_label, payload.attributes, payload.label)
    of_track = _values_of_tracks(write, [payload.track_id]).get(payload.track_id, {})
    row["attributes"] = values_json(new_values(of_label, of_track, given))
    write.put("labels", payload.uid, row)
    for each in payload.said:
        said = each if isinstance(each, SaidRecord) else SaidRecord.of(each)
        behind = said_row(write, said, behind=payload.uid)
        write.put("labels", behind["uid"], behind)


def _replace_proposals(write: Write, payload: ProposalsReplaced) -> None:
    """Applies an automatic pass: its proposals replace the unreviewed labels made here, except imported ones."""
    for row in write.open_proposals():
        if row["source"] != Source.IMPORTED.value:
            write.put("labels", row["uid"], None)
    for each in payload.new:
        _create(write, each, payload.run)
    if payload.run is not None and write.frame_id is not None and (frame := write.row("frames", write.frame_id)):
        write.put("frames", write.frame_id, frame | {"run_id": payload.run})
    found = [(write.class_id(each.label), each.score, write.box_json(each.box)) for each in payload.found]
    write.keep_pass(json.dumps(found, separators=(",", ":")))


def _link(write: Write, linked: LinkedLabel) -> None:
    row = write.row("labels", linked.uid)
    # linking never changes a reviewed box
    is_free = linked.box is None or (row is not None and row["state"] == ReviewState.PROPOSED.value)
    if row is None or row["moment_id"] != write.moment_id or not is_free:
        raise ProjectError(
            f"{write.where}: label {linked.uid} is not in this frame, or has been reviewed since; link the tracks again"
        )
    changed: Row = {"attributes": values_json(values_of(row["attributes"]) | linked.attributes)}
    if linked.track_id is not None:
        changed |= {"track_id": linked.track_id, "track_linked": 1}
    if linked.box is not None:
        changed["box"] = write.terms.box_json(linked.box, write.frame_id)
    write.put("labels", linked.uid, row | changed)


def _edit(write: Write, payload: LabelEdited) -> None:
    row, terms = write.label(payload.uid), write.terms
    # An edit that keeps the box gets it bit for bit: the page's box has other last digits. Otherwise, the edit would
    # count as a correction of a suggested box.
    present = terms.record(row["box"], write.frame_id)
    is_kept = same_box(present.box(), payload.box.box())
    changed: Row = {"class_id": write.class_id(payload.label), "state": ReviewState.EDITED.value}
    if not is_kept:
        changed["box"] = terms.box_json(payload.box, write.frame_id)
    if payload.image_box is not None:
        write.class_id(payload.image_box.label)
        changed |= {"image_box": terms.box_2d_json(payload.image_box), "frame_id": write.frame_id}
    if payload.box_kind is not None:
        changed["box_kind"] = payload.box_kind.value
    if payload.suggestion is not None:
        changed["suggestion"] = suggestion_json(payload.suggestion)
    elif row["suggestion"] is not None and not is_kept:
        changed["suggestion"] = json.dumps(json.loads(row["suggestion"]) | {"corrected": True}, separators=(",", ":"))
    before = terms.names[row["class_id"]]
    changed |= _tracked(write, row, before, payload.label, payload.track_id)
    write.put("labels", payload.uid, row | write.author | changed)


def _tracked(write: Write, row: Row, before: str, after: str, track_id: int | None) -> Row:
    """What changes of a label with its class and its track; a track set by linking stays one if the id is the same."""
    is_other = track_id != row["track_id"]
    changed: Row = {"track_id": track_id, "track_linked": 0 if is_other else row["track_linked"]}
    if write.terms.attributes and (is_other or after != before):
        of_track = _values_of_tracks(write, [track_id]).get(track_id, {}) if is_other else {}
        present = values_of(row["attributes"])
        changed["attributes"] = values_json(after_edit(write.terms.attributes, present, before, after, of_track))
    return changed


def _set_values(write: Write, payload: LabelAttributesSet) -> None:
    row = write.row("labels", payload.uid)
    if row is None or row["moment_id"] != write.moment_id:
        raise NotFoundError(
            f"{write.where}: there is no label {payload.uid}; it may have been deleted; reload the frame"
        )
    name = write.terms.names[row["class_id"]]
    given = {key: value for key, value in payload.attributes.items() if value is not None}
    both = (
        values_of(row["attributes"]) | dict(payload.attributes) | checked(write.terms.attributes_of(name), given, name)
    )
    values = {key: value for key, value in both.items() if value is not None}
    is_own = write.context.source is Source.MANUAL and write.context.effort_target in (None, payload.uid)
    changed = {"attributes": values_json(values), "values_set": int(is_own or row["values_set"])}
    write.put("labels", payload.uid, row | write.author | changed)


def _set_frame_values(write: Write, values: Mapping[str, AttributeValue]) -> None:
    assert write.frame_id is not None  # only frames have values
    row = write.row("frames", write.frame_id)
    assert row is not None  # `require_writable` has found it
    of_frames = [each for each in write.terms.attributes if each.of is AttributeOf.FRAME]
    after = checked(of_frames, values, "a frame")
    write.put("frames", write.frame_id, row | {"attributes": values_json(after) if after else None})


def _set_finalised(write: Write, finalised: bool) -> None:
    assert write.frame_id is not None  # only frames are finalised
    row = write.row("frames", write.frame_id)
    assert row is not None  # `require_writable` has found it
    if bool(row["finalised"]) == finalised:
        raise ProjectError(f"{write.where}: the frame is {'already' if finalised else 'not'} finalised")
    write.put("frames", write.frame_id, row | {"finalised": int(finalised)})
