"""The target of an event and its state as text, for undo to compare and restore.

A target is `label:UID`, `image` (the boxes on the camera image), `view:ID` (the boxes on a pseudo-view) or `frame`
(finalised or open), each within its frame. The database calls it `subject`.
"""

from __future__ import annotations

from sqlalchemy import Connection, select

from annotator.project.event_types import (
    FrameFinalised,
    FrameReopened,
    ImageBoxesRemoved,
    ImageBoxesRestored,
    ImageBoxesSet,
    ImageBoxesState,
    LabelDeleted,
    LabelRestored,
    LabelState,
    Payload,
    ProposalsReplaced,
    TracksLinked,
    ViewBoxesRemoved,
    ViewBoxesRestored,
    ViewBoxesSet,
    ViewBoxesState,
)
from annotator.project.records import BOXES_2D, BoxRecord, ViewGeometry, box_2d_of, parsed, suggestion_of
from annotator.project.schema import AnyRow, frames, image_labels, labels, view_labels
from annotator.types.errors import ProjectError

LABEL, IMAGE, VIEW, FRAME = "label", "image", "view", "frame"
FINALISED = "finalised"


def target_of(payload: Payload) -> str:
    """The target of an event.

    Raises:
        ProjectError: an automatic pass, which has many targets.
    """
    match payload:
        case ProposalsReplaced() | TracksLinked():
            raise ProjectError("an automatic pass cannot be undone")
        case ImageBoxesSet() | ImageBoxesRestored() | ImageBoxesRemoved():
            return IMAGE
        case ViewBoxesSet() | ViewBoxesRestored() | ViewBoxesRemoved():
            return f"{VIEW}:{payload.view}"
        case FrameFinalised() | FrameReopened():
            return FRAME
        case _:
            return f"{LABEL}:{payload.uid}"


def read_state(connection: Connection, frame_id: int | None, target: str) -> str | None:
    """The state of a target as JSON; equal texts are equal states. None for an absent target and for an open frame."""
    kind, _, key = target.partition(":")
    if kind == LABEL:
        row = connection.execute(select(labels).where(labels.c.uid == key)).first()
        return None if row is None else _label_state(row).model_dump_json()
    if kind == IMAGE:
        row = connection.execute(select(image_labels).where(image_labels.c.frame_id == frame_id)).first()
        return None if row is None else ImageBoxesState.model_validate(_boxes(row)).model_dump_json()
    if kind == VIEW:
        same = (view_labels.c.view_id == key) & view_labels.c.frame_id.is_not_distinct_from(frame_id)
        row = connection.execute(select(view_labels).where(same)).first()
        if row is None:
            return None
        geometry = None if row.geometry is None else parsed(ViewGeometry.model_validate_json, row.geometry)
        return ViewBoxesState.model_validate(_boxes(row) | {"step": row.step, "geometry": geometry}).model_dump_json()
    finalised = connection.execute(select(frames.c.finalised).where(frames.c.id == frame_id)).scalar_one()
    return FINALISED if finalised else None


def restoring(target: str, state: str | None) -> Payload:
    """The event that restores a target to `state`, a result of `read_state`."""
    kind, _, key = target.partition(":")
    if kind == LABEL:
        if state is None:
            return LabelDeleted(uid=key)
        return LabelRestored(uid=key, former=parsed(LabelState.model_validate_json, state))
    if kind == IMAGE:
        if state is None:
            return ImageBoxesRemoved()
        return ImageBoxesRestored(former=parsed(ImageBoxesState.model_validate_json, state))
    if kind == VIEW:
        if state is None:
            return ViewBoxesRemoved(view=key)
        return ViewBoxesRestored(view=key, former=parsed(ViewBoxesState.model_validate_json, state))
    return FrameReopened() if state is None else FrameFinalised()


def same_state(target: str, a: str | None, b: str | None) -> bool:
    """True if two states are equal, apart from a label's position in the list."""
    if a is None or b is None or not target.startswith(LABEL):
        return a == b
    first, second = parsed(LabelState.model_validate_json, a), parsed(LabelState.model_validate_json, b)
    return first.model_copy(update={"place": second.place}) == second


def _label_state(row: AnyRow) -> LabelState:
    return LabelState(
        label=row.label,
        box=parsed(BoxRecord.model_validate_json, row.box),
        score=row.score,
        source=row.source,
        state=row.state,
        author=row.author,
        time_ns=row.time_ns,
        track_id=row.track_id,
        view_disagreement=row.view_disagreement,
        kept_share=row.kept_share,
        last_change=row.last_change,
        proposal_event_id=row.proposal_event_id,
        run_id=row.run_id,
        origin=row.origin,
        image_box=box_2d_of(row.image_box),
        place=row.id,
        image_agreement=row.image_agreement,
        track_linked=row.track_linked,
        expected_iou_loss=row.expected_iou_loss,
        suggestion=suggestion_of(row.suggestion),
        box_kind=row.box_kind,
    )


def _boxes(row: AnyRow) -> dict[str, object]:
    return {
        "boxes": parsed(BOXES_2D.validate_json, row.boxes),
        "box_kind": row.box_kind,
        "author": row.author,
        "time_ns": row.time_ns,
        "source": row.source,
    }
