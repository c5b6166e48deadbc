"""The target of an event and its state as text, for undo to compare and restore.

A target is `label:UID`, `image` (the boxes on the camera image), `view:ID` (the boxes on a pseudo-view), `frame`
(finalised or open), `values` (of the frame's attributes) or `source:NAME` (what other software says of the objects that
are not reviewed), each within its frame; or `recording:ID` (its up direction
and calibration). The database calls it `subject`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sqlalchemy import Connection, select

from annotator.geometry.oriented_box import same_box
from annotator.project.adjusting import (
    Moves,
    adjustment_json,
    adjustment_of,
    moved_label,
    moved_said,
    moved_view,
    read_adjustment,
)
from annotator.project.classes.applying import ClassChanges, frame_values, values_of
from annotator.project.classes.attributes import Attribute, AttributeOf, fitting, values_json
from annotator.project.classes.completing import given_back
from annotator.project.database.schema import LABEL_OF_UID, AnyRow, frames, image_labels, labels, view_labels
from annotator.project.log.event_types import (
    ClassesChanged,
    FrameAttributesSet,
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
    ProposalsImported,
    ProposalsReplaced,
    RecordingAdjusted,
    TracksLinked,
    ViewBoxesRemoved,
    ViewBoxesRestored,
    ViewBoxesSet,
    ViewBoxesState,
)
from annotator.project.log.records import (
    BOXES_2D,
    BoxRecord,
    SaidRecord,
    ViewGeometry,
    box_2d_of,
    parsed,
    said_json,
    said_of,
    suggestion_of,
)
from annotator.types import ReviewState
from annotator.types.errors import ProjectError
from annotator.types.label import AttributeValue

Values = dict[str, AttributeValue]
LABEL, IMAGE, VIEW, FRAME, RECORDING = "label", "image", "view", "frame", "recording"
VALUES, SOURCE = "values", "source"
FINALISED = "finalised"
# Tolerance of a view's axes and origin (metres).
SAME_VIEW = 1e-6


def target_of(payload: Payload) -> str:
    """The target of an event."""
    match payload:
        case ProposalsImported():
            return f"{SOURCE}:{payload.source}"
        case ProposalsReplaced() | TracksLinked():
            raise ProjectError("an automatic pass cannot be undone")
        case ClassesChanged():
            raise ProjectError("a change of the classes cannot be undone")
        case FrameAttributesSet():
            return VALUES
        case ImageBoxesSet() | ImageBoxesRestored() | ImageBoxesRemoved():
            return IMAGE
        case ViewBoxesSet() | ViewBoxesRestored() | ViewBoxesRemoved():
            return f"{VIEW}:{payload.view}"
        case FrameFinalised() | FrameReopened():
            return FRAME
        case RecordingAdjusted():
            return f"{RECORDING}:{payload.recording}"
        case _:
            return f"{LABEL}:{payload.uid}"


def read_state(connection: Connection, frame_id: int | None, target: str) -> str | None:
    """The state of a target as JSON; equal texts are equal states. None for an absent target and for an open frame."""
    kind, _, key = target.partition(":")
    if kind == LABEL:
        state = label_state(connection, key)
        return None if state is None else state.model_dump_json()
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
    if kind == RECORDING:
        return adjustment_json(read_adjustment(connection, int(key)))
    if kind == VALUES:
        values = frame_values(connection, frame_id)
        return values_json(values) if values else None
    if kind == SOURCE:
        is_open = (labels.c.frame_id == frame_id) & (labels.c.state == ReviewState.PROPOSED.value)
        rows = connection.execute(select(labels.c.uid, labels.c.said).where(is_open, labels.c.said.is_not(None)))
        said = [each for row in rows for each in given_back(row.uid, said_of(row.said)) if each.source == key]
        return said_json(tuple(sorted(said, key=lambda each: each.uid)))
    finalised = connection.execute(select(frames.c.finalised).where(frames.c.id == frame_id)).scalar_one()
    return FINALISED if finalised else None


def restoring(target: str, state: str | None) -> Payload:
    """The event that restores a target to `state`, a result of `read_state`; of a source, `sources.bring` has it."""
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
    if kind == RECORDING:
        assert state is not None  # as `read_state` returns it
        adjustment = adjustment_of(state)
        return RecordingAdjusted(recording=int(key), up=adjustment.up, correction=adjustment.correction)
    if kind == VALUES:
        return FrameAttributesSet(attributes=values_of(state))
    return FrameReopened() if state is None else FrameFinalised()


class Since:
    """What has changed all states since they were stored, within one transaction.

    Attributes:
        moves: of the recordings' clouds.
        classes: changes of the classes.
    """

    def __init__(self, connection: Connection) -> None:
        self.moves = Moves(connection)
        self.classes = ClassChanges(connection)


def present_state(since: Since, frame_id: int | None, target: str, state: str | None, event_id: int) -> str | None:
    """The state of a target after the event `event_id`, moved and relabelled as its recording and project since."""
    kind = target.partition(":")[0]
    if state is not None and since.classes.has_since(event_id):
        if kind == LABEL:
            state = since.classes.label_state(state, event_id)
        elif kind == IMAGE:
            state = since.classes.image_state(state, event_id)
        elif kind == VIEW:
            state = since.classes.view_state(state, event_id)
        elif kind == VALUES:
            state = since.classes.frame_state(state, event_id)
        elif kind == SOURCE:
            state = since.classes.said_state(state, event_id)
    if state is None or kind not in (LABEL, VIEW, SOURCE):
        return state
    T = since.moves.since(frame_id, event_id)
    if T is None:
        return state
    if kind == SOURCE:
        return said_json(moved_said(said_of(state), T))
    return moved_label(state, T) if kind == LABEL else moved_view(state, T)


class AllowedValues:
    """The values that the attributes of a project allow now; older states may have others.

    Attributes:
        left_out: names of the attributes of which `state` has left out values.
    """

    def __init__(self, attributes: Sequence[Attribute]) -> None:
        self._attributes = attributes
        self.left_out = set[str]()

    def state(self, target: str, state: str | None) -> str | None:
        """A state, as `present_state` returns it, with these values only."""
        kind = target.partition(":")[0]
        if state is None or kind not in (LABEL, VALUES, SOURCE):
            return state
        if kind == VALUES:
            values = self._of([each for each in self._attributes if each.of is AttributeOf.FRAME], values_of(state))
            return values_json(values) if values else None
        if kind == SOURCE:
            said = said_of(state)
            return said_json(tuple(each.model_copy(update=self._of_label(each)) for each in said))
        label = parsed(LabelState.model_validate_json, state)
        return label.model_copy(update=self._of_label(label)).model_dump_json()

    def _of_label(self, label: LabelState | SaidRecord) -> dict[str, Values]:
        of_label = [each for each in self._attributes if each.is_of(label.label)]
        return {"attributes": self._of(of_label, label.attributes)}

    def _of(self, attributes: Sequence[Attribute], values: Values) -> Values:
        kept = fitting(attributes, values)
        self.left_out |= values.keys() - kept.keys()
        return kept


def same_state(target: str, a: str | None, b: str | None) -> bool:
    """True if two states are equal, apart from a label's position in the list and the rounding of moved poses.

    The time of an open proposal does not count: each import into its frame stores it anew.
    """
    kind = target.partition(":")[0]
    if a is None or b is None or a == b or kind not in (LABEL, VIEW, SOURCE):
        return a == b
    if kind == SOURCE:
        return _same_said(said_of(a), said_of(b))
    if kind == VIEW:
        return _same_view(*(parsed(ViewBoxesState.model_validate_json, state) for state in (a, b)))
    first, second = (parsed(LabelState.model_validate_json, state) for state in (a, b))
    other: dict[str, object] = {"place": second.place, "box": second.box, "said": second.said}
    if first.state is ReviewState.PROPOSED:
        other["time_ns"] = second.time_ns
    return first.model_copy(update=other) == second and same_box(first.box.box(), second.box.box())


def _same_said(first: Sequence[SaidRecord], second: Sequence[SaidRecord]) -> bool:
    # the store adds values: defaults, and those of a track
    return len(first) == len(second) and all(
        a.model_copy(update={"box": b.box, "attributes": b.attributes}) == b and same_box(a.box.box(), b.box.box())
        for a, b in zip(first, second, strict=True)
    )


def _same_view(first: ViewBoxesState, second: ViewBoxesState) -> bool:
    if first.geometry is None or second.geometry is None:
        return first == second
    a, b = ((*np.ravel(each.axes), *each.origin_m) for each in (first.geometry, second.geometry))
    geometry = first.geometry.model_copy(update={"axes": second.geometry.axes, "origin_m": second.geometry.origin_m})
    return np.allclose(a, b, rtol=0, atol=SAME_VIEW) and first.model_copy(update={"geometry": geometry}) == second


def label_state(connection: Connection, uid: str) -> LabelState | None:
    """The state of a label; None if there is none of this uid."""
    row = connection.execute(LABEL_OF_UID, {"uid": uid}).first()
    if row is None:
        return None
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
        said=said_of(row.said),
        attributes=values_of(row.attributes),
    )


def _boxes(row: AnyRow) -> dict[str, object]:
    return {
        "boxes": parsed(BOXES_2D.validate_json, row.boxes),
        "box_kind": row.box_kind,
        "author": row.author,
        "time_ns": row.time_ns,
        "source": row.source,
    }
