"""What each requested change does to the rows of its frame."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from annotator.geometry.oriented_box import same_box
from annotator.project.audit.writing import STILL_COLUMNS, Write
from annotator.project.changes import (
    REQUESTED,
    FrameAttributesSet,
    FrameFinalised,
    ImageBoxesSet,
    LabelChanged,
    LabelDeleted,
    NewLabel,
    Payload,
    ProposalsReplaced,
    StillEnded,
    StillMade,
    StillProposal,
    StillsProposed,
    TracksLinked,
    ViewBoxesRemoved,
    ViewBoxesSet,
)
from annotator.project.classes.attributes import Attribute, AttributeOf, fitting
from annotator.project.classes.values import Values, after_edit, checked, new_values, of_tracks
from annotator.project.database.schema import columns_of
from annotator.project.records import OWN, BoxRecord, suggestion_json
from annotator.project.rows import Row, said_json, still_of, values_json, values_of
from annotator.types import Proposal, ReviewState, Source
from annotator.types.errors import ProjectError, StaleRevisionError
from annotator.types.label import AttributeValue, Said


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
                _change(write, linked, is_linked=True)
        case LabelChanged():
            _change(write, payload)
            kind = _kind_of(payload)
        case LabelDeleted(here=True) if still_of(payload.uid) is not None:
            rejected = {"state": ReviewState.REJECTED.value} | write.author
            write.put_label(payload.uid, write.label(payload.uid) | rejected, here=True)
            kind = "label_rejected"
        case LabelDeleted() | StillEnded():
            write.label(payload.uid)
            _remove(write, payload.uid)
        case StillMade():
            _make_still(write, payload)
        case StillsProposed():
            for uid in payload.removed:
                _remove_open_still(write, uid)
            for each in payload.new:
                _propose_still(write, each)
        case FrameAttributesSet():
            of_frames = [each for each in write.terms.attributes if each.of is AttributeOf.FRAME]
            row = _frame(write)
            values = _with_values(values_of(row["attributes"]), payload.attributes, of_frames, "a frame")
            write.put("frames", row["id"], row | {"attributes": values_json(values) if values else None})
        case FrameFinalised():
            _set_finalised(write, payload.finalised)
            kind = kind if payload.finalised else "frame_reopened"
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


def put_said(write: Write, said: Said, behind: str | None = None) -> Row:
    """Puts the row of an open proposal that a source has made; returns it."""
    is_ours = said.source == OWN
    if said.score is not None and not 0 <= said.score <= 1:
        raise ProjectError(f"{write.where}: a score of {said.source} must be in 0..1, not {said.score:g}; scale it")
    values = fitting(write.terms.attributes_of(said.label), said.attributes) if said.attributes else {}
    row = new_label(
        write,
        write.new_uid(),
        said.label,
        box=write.box_json(said.box),
        score=said.score,
        state=ReviewState.PROPOSED.value,
        source=(Source.AUTO if is_ours else Source.IMPORTED).value,
        author=said.source,
        track_id=said.track_id,
        box_kind=said.box_kind.value,
        attributes=values_json(values),
        behind=behind,
        of_source=None if is_ours else said.source,
    )
    if said.file_track_id is not None and not is_ours:
        row["said"] = said_json(row, said.file_track_id)
    write.put("labels", row["uid"], row)
    return row


def _found(write: Write, proposal: Proposal) -> Row:
    """The columns of a label that come from the recursion."""
    # SQLite has NULL for NaN
    known = {name: value for name, value in vars(proposal.quality).items() if value is not None and value == value}
    signals = {name: float(known[name]) if name in known else None for name in vars(proposal.quality)}
    return {"score": proposal.score, "proposed_box": write.box_json(proposal.box)} | signals


def _of_track(write: Write, track_id: int | None) -> Values:
    """The values of a track. An operation may write to 1,000 of its boxes, so they are read once in a transaction."""
    if track_id is None:
        return {}
    known = write.terms.of_tracks
    if (place := (write.rig_id, track_id)) not in known:
        known[place] = of_tracks(write.connection, write.terms, write.frame_id, [track_id]).get(track_id, {})
    return known[place]


def _joins(write: Write, track_id: int | None, values: Values) -> None:
    """A label has come to a track: what the track lacks, it now has from the label."""
    if track_id is None or (of_track := write.terms.of_tracks.get((write.rig_id, track_id))) is None:
        return
    along = {each.name for each in write.terms.attributes if each.of is AttributeOf.TRACK}
    of_track |= {name: value for name, value in values.items() if name in along and name not in of_track}


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
    values = new_values(of_label, _of_track(write, payload.track_id), given)
    _joins(write, payload.track_id, values)
    row["attributes"] = values_json(values)
    write.put("labels", payload.uid, row)
    for said in payload.said:
        put_said(write, said, payload.uid)


def _replace_proposals(write: Write, payload: ProposalsReplaced) -> None:
    """Applies an automatic pass: its proposals replace the unreviewed labels made here, except imported ones."""
    for row in write.open_proposals():
        if row["source"] != Source.IMPORTED.value:
            write.put("labels", row["uid"], None)
    for each in payload.new:
        _create(write, each, payload.run)
    if payload.run is not None and write.frame_id is not None and (frame := write.row("frames", write.frame_id)):
        write.put("frames", write.frame_id, frame | {"run_id": payload.run})
    found = [(write.class_id(each.label), each.score, write.box_json(each.box), each.edges) for each in payload.found]
    write.found = json.dumps(found, separators=(",", ":"))


def _kind_of(payload: LabelChanged) -> str:
    """The kind of the event: by the decision, else by what is given."""
    if payload.state is not None:
        return f"label_{payload.state.value}"
    given = {"track_id": "label_tracked", "attributes": "label_attributes_set"}
    return next((kind for name, kind in given.items() if name in payload.model_fields_set), "label_moved")


def _change(write: Write, payload: LabelChanged, *, is_linked: bool = False) -> None:
    row, terms = write.label(payload.uid), write.terms
    # linking never changes a reviewed box
    if is_linked and payload.box is not None and row["state"] != ReviewState.PROPOSED.value:
        raise ProjectError(f"{write.where}: label {payload.uid} has been reviewed since; link the tracks again")
    before = terms.names[row["class_id"]]
    name = before if payload.label is None else payload.label
    changed: Row = {} if is_linked else dict(write.author)
    if payload.label is not None:
        changed["class_id"] = write.class_id(name)
    if payload.state is not None:
        changed["state"] = payload.state.value
    # An edit that keeps the box gets it bit for bit: the page's box has other last digits. Otherwise, the edit would
    # count as a correction of a suggested box.
    if payload.box is not None and not (
        payload.state is ReviewState.EDITED and same_box(terms.box(row["box"], write.frame_id), payload.box.box())
    ):
        is_still = still_of(payload.uid) is not None and not payload.here
        changed["box"] = (terms.world_json if is_still else terms.box_json)(payload.box, write.frame_id)
    if payload.image_box is not None:
        write.class_id(payload.image_box.label)
        changed |= {"image_box": terms.box_2d_json(payload.image_box), "frame_id": write.frame_id}
    if payload.box_kind is not None:
        changed["box_kind"] = payload.box_kind.value
    if payload.suggestion is not None:
        changed["suggestion"] = suggestion_json(payload.suggestion)
    elif row["suggestion"] is not None and payload.state is ReviewState.EDITED and "box" in changed:
        changed["suggestion"] = json.dumps(json.loads(row["suggestion"]) | {"corrected": True}, separators=(",", ":"))
    is_other = "track_id" in payload.model_fields_set and payload.track_id != row["track_id"]
    if is_other and still_of(payload.uid) is not None:
        raise ProjectError(f"{write.where}: track {row['track_id']} stands still, and keeps its number")
    if is_other or (is_linked and "track_id" in payload.model_fields_set):
        changed |= {"track_id": payload.track_id, "track_linked": int(is_linked)}
    values = values_of(row["attributes"])
    if terms.attributes and (name != before or (is_other and not is_linked)):
        of_track = _of_track(write, payload.track_id) if is_other else {}
        values = after_edit(terms.attributes, values, before, name, of_track)
        _joins(write, payload.track_id if is_other else None, values)
    if "attributes" in payload.model_fields_set:  # also without any: none may be what a person wants
        values = _with_values(values, payload.attributes, terms.attributes_of(name), name)
        is_own = write.context.source is Source.MANUAL and write.context.effort_target in (None, payload.uid)
        changed["values_set"] = int(is_own or row["values_set"])
        if terms.of_tracks:  # what is known of its track may be another value now
            terms.of_tracks.pop((write.rig_id, (row | changed)["track_id"]), None)
    write.put_label(payload.uid, row | changed | {"attributes": values_json(values)}, payload.here)


def _remove(write: Write, uid: str) -> None:
    """Removes a label with the boxes behind it, or the still object that it shows."""
    if (still := still_of(uid)) is not None:
        write.put("stills", still, None)
    for behind in [row["uid"] for row in write.labels() if uid in (row["uid"], row["behind"])]:
        write.put("labels", behind, None)


def _make_still(write: Write, payload: StillMade) -> None:
    row = write.label(payload.uid)
    is_there = still_of(payload.uid) is not None or write.row("stills", payload.still) is not None
    if row["track_id"] is None or is_there:
        why = "stands still already" if is_there else "has no track; give it one first"
        raise ProjectError(f"{write.where}: label {payload.uid} {why}")
    box = write.terms.world_json(BoxRecord.of(write.terms.box(row["box"], write.frame_id)), write.frame_id)
    if row["state"] == ReviewState.PROPOSED.value:
        row = row | {"state": ReviewState.ACCEPTED.value, "source": write.context.source.value} | write.author
    _remove(write, payload.uid)
    still = {"uid": payload.still, "rig_id": write.rig_id, "track_id": row["track_id"], "box": box}
    write.put("stills", payload.still, {name: row[name] for name in STILL_COLUMNS} | still)


def _remove_open_still(write: Write, uid: str) -> None:
    """Removes the proposal of the pass before; refused if somebody has decided about it since, from any frame."""
    row, revision = write.row("stills", uid), write.context.revision
    if row is None or row["state"] != ReviewState.PROPOSED.value or row["values_set"]:
        raise StaleRevisionError(f"{write.where}: an object that stands still", revision, revision + 1)
    write.put("stills", uid, None)


def _propose_still(write: Write, new: StillProposal) -> None:
    row = new_label(write, "", new.label, box_kind=new.box_kind.value, state=ReviewState.PROPOSED.value)
    values = new_values(write.terms.attributes_of(new.label), _of_track(write, new.track_id), {})
    still: Row = {"uid": new.uid, "rig_id": write.rig_id, "track_id": new.track_id, "attributes": values_json(values)}
    still |= {"score": new.score, "expected_iou_loss": new.expected_iou_loss}
    still["box"] = write.terms.world_json(BoxRecord.of(new.box), write.frame_id)
    write.put("stills", new.uid, {name: row[name] for name in STILL_COLUMNS} | still)


def _with_values(
    present: Values, changed: Mapping[str, AttributeValue | None], attributes: Sequence[Attribute], what: str
) -> Values:
    """Values with changed ones, of which None removes one; `what` has them, for messages."""
    new = checked(attributes, {name: value for name, value in changed.items() if value is not None}, what)
    return {name: value for name, value in present.items() if name not in changed} | new


def _frame(write: Write) -> Row:
    assert write.frame_id is not None  # only frames have values, and are finalised
    row = write.row("frames", write.frame_id)
    assert row is not None  # `require_writable` has found it
    return row


def _set_finalised(write: Write, finalised: bool) -> None:
    row = _frame(write)
    if bool(row["finalised"]) == finalised:
        raise ProjectError(f"{write.where}: the frame is {'already' if finalised else 'not'} finalised")
    write.put("frames", row["id"], row | {"finalised": int(finalised)})
