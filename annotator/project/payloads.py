"""What an event says: one model a kind.

Events are never rewritten, so a model here is a promise about every database in the field: a field may be added with a
default; a change of meaning is a new kind.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, Field, TypeAdapter, model_validator

from annotator.project.records import EXACT, BoxRecord, Finite, ProposalRecord, ViewGeometry
from annotator.types import Box2D, BoxKind, LostObject, ReviewState, Source
from annotator.types.tracks import MOST_TRACK

ViewId = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Uid = Annotated[str, Field(min_length=1, max_length=64)]
ClassName = Annotated[str, Field(min_length=1)]
TrackId = Annotated[int, Field(ge=-MOST_TRACK, le=MOST_TRACK)]


class Origin(StrEnum):
    """How an operator made a label that nobody proposed.

    DRAWN: by 2D boxes on the image and on pseudo-views. PLACED: as a 3D box. COPIED: from another frame.
    """

    DRAWN = "drawn"
    PLACED = "placed"
    COPIED = "copied"


class LabelState(BaseModel):
    """All that is kept of a label but its uid and frame, as `Label` and `StoredLabel` have it.

    Attributes:
        place: number of its row, which orders the labels of a frame.
        track_linked: True where linking gave the track id, and no person or file.
    """

    model_config = EXACT

    label: ClassName
    box: BoxRecord
    score: float | None
    source: Source
    state: ReviewState
    author: str
    time_ns: int
    track_id: int | None
    view_disagreement: float | None
    kept_share: float | None
    last_change: float | None
    proposal_event_id: int | None
    run_id: int | None
    origin: Origin | None
    image_box: Box2D | None
    place: int
    image_agreement: float | None = None
    track_linked: bool = False


class ImageBoxesState(BaseModel):
    """All that is kept of the boxes on a camera image, as in `ImageBoxes`."""

    model_config = EXACT

    boxes: tuple[Box2D, ...]
    box_kind: BoxKind
    author: str
    time_ns: int
    source: Source


class ViewBoxesState(BaseModel):
    """All that is kept of the boxes on a pseudo-view, as in `ViewBoxes`."""

    model_config = EXACT

    boxes: tuple[Box2D, ...]
    box_kind: BoxKind
    step: int | None
    geometry: ViewGeometry | None
    author: str
    time_ns: int
    source: Source


class _Payload(BaseModel):
    model_config = EXACT

    def classes(self) -> set[str]:
        """The class names that the event brings in."""
        return set()


class ImageBoxesSet(_Payload):
    """All 2D boxes on the camera image, in place of the ones before; none of them = nothing to be found here."""

    kind: Literal["image_boxes_set"] = "image_boxes_set"
    boxes: tuple[Box2D, ...]
    box_kind: BoxKind

    def classes(self) -> set[str]:
        return {box.label for box in self.boxes}


class ViewBoxesSet(_Payload):
    """All 2D boxes on one pseudo-view, in place of the ones before.

    Attributes:
        view: SHA-256 of the view's PNG, as `Views.store` gives it.
        step: the step of the recursion that drew the view, from 0, where known.
        geometry: how the view lies in space, where known.
    """

    kind: Literal["view_boxes_set"] = "view_boxes_set"
    view: ViewId
    boxes: tuple[Box2D, ...]
    box_kind: BoxKind
    step: int | None = None
    geometry: ViewGeometry | None = None

    def classes(self) -> set[str]:
        return {box.label for box in self.boxes}


class ProposedObject(BaseModel):
    """One proposal of an automatic pass.

    Attributes:
        uid: of the label that it became.
        covered_by: uid of the reviewed label that says the same already, so that no label was made; else None.
        track_id: the object's id over the recording, where the pass followed it from another frame.
    """

    model_config = EXACT

    uid: Uid
    proposal: ProposalRecord
    covered_by: Uid | None = None
    track_id: TrackId | None = None


class ProposalsReplaced(_Payload):
    """An automatic pass: its proposals in place of all labels that nobody has reviewed.

    Attributes:
        run: id of the batch run, where it was one.
        objects: every proposal with its trace, also those that became no label.
        lost: frustums that led to no box.
    """

    kind: Literal["proposals_replaced"] = "proposals_replaced"
    run: int | None = None
    objects: tuple[ProposedObject, ...]
    lost: tuple[LostObject, ...] = ()

    def classes(self) -> set[str]:
        return {entry.proposal.label for entry in self.objects}


class LabelCreated(_Payload):
    """A 3D box that no automatic pass proposed: made by an operator, or imported.

    Attributes:
        origin: how, where an operator made it.
        image_box: on the camera image, where the label was made from it.
    """

    kind: Literal["label_created"] = "label_created"
    uid: Uid
    label: ClassName
    box: BoxRecord
    score: Finite | None = None
    track_id: int | None = None
    state: ReviewState = ReviewState.ACCEPTED
    origin: Origin | None = None
    image_box: Box2D | None = None

    @model_validator(mode="after")
    def _reviewed(self) -> LabelCreated:
        # the next automatic pass would silently remove it
        if self.state is ReviewState.PROPOSED:
            raise ValueError("a created label cannot be in state 'proposed'; only an automatic pass proposes")
        return self

    def classes(self) -> set[str]:
        return {self.label}


class LabelProposed(_Payload):
    """A box that an operator had proposed: carried over from other frames of its track, or found from there.

    It waits for a review as the proposals of a pass do, and the next pass over the frame takes its place.

    Attributes:
        proposal: with its trace, where the recursion found the box.
    """

    kind: Literal["label_proposed"] = "label_proposed"
    uid: Uid
    label: ClassName
    box: BoxRecord
    track_id: TrackId | None = None
    proposal: ProposalRecord | None = None

    def classes(self) -> set[str]:
        return {self.label}


class LabelTracked(_Payload):
    """The label belongs to another track, or to none; its box and its review stay as they are."""

    kind: Literal["label_tracked"] = "label_tracked"
    uid: Uid
    track_id: TrackId | None


class LinkedLabel(BaseModel):
    """One label that was linked.

    Attributes:
        track_id: found by linking; None leaves the label's own, which somebody gave it.
        box: smoothed over its track; None leaves the label's box, as it must for a reviewed one.
    """

    model_config = EXACT

    uid: Uid
    track_id: TrackId | None = None
    box: BoxRecord | None = None


class TracksLinked(_Payload):
    """Linking over the recording: the track ids of some labels of a frame, and smoothed boxes of open proposals."""

    kind: Literal["tracks_linked"] = "tracks_linked"
    labels: tuple[LinkedLabel, ...]


class LabelAccepted(_Payload):
    """The label is right as it stands."""

    kind: Literal["label_accepted"] = "label_accepted"
    uid: Uid


class LabelEdited(_Payload):
    """The label's class, box and track from now on.

    Attributes:
        image_box: on the camera image, where the label is made from another one now.
    """

    kind: Literal["label_edited"] = "label_edited"
    uid: Uid
    label: ClassName
    box: BoxRecord
    track_id: int | None = None
    image_box: Box2D | None = None

    def classes(self) -> set[str]:
        return {self.label}


class LabelRejected(_Payload):
    """There is no such object; kept, so that a later pass does not propose it again."""

    kind: Literal["label_rejected"] = "label_rejected"
    uid: Uid


class LabelDeleted(_Payload):
    """The label is gone, and a later pass may propose the object again."""

    kind: Literal["label_deleted"] = "label_deleted"
    uid: Uid


class LabelRestored(_Payload):
    """The label is again what it was: an edit, a review or a deletion is taken back."""

    kind: Literal["label_restored"] = "label_restored"
    uid: Uid
    former: LabelState

    def classes(self) -> set[str]:
        return {self.former.label}


class ImageBoxesRestored(_Payload):
    """The boxes on the camera image are again what they were."""

    kind: Literal["image_boxes_restored"] = "image_boxes_restored"
    former: ImageBoxesState

    def classes(self) -> set[str]:
        return {box.label for box in self.former.boxes}


class ImageBoxesRemoved(_Payload):
    """Nobody has looked for boxes on the camera image."""

    kind: Literal["image_boxes_removed"] = "image_boxes_removed"


class ViewBoxesRestored(_Payload):
    """The boxes on one pseudo-view are again what they were."""

    kind: Literal["view_boxes_restored"] = "view_boxes_restored"
    view: ViewId
    former: ViewBoxesState

    def classes(self) -> set[str]:
        return {box.label for box in self.former.boxes}


class ViewBoxesRemoved(_Payload):
    """Nobody has looked for boxes on the pseudo-view: its object is drawn anew, or was none."""

    kind: Literal["view_boxes_removed"] = "view_boxes_removed"
    view: ViewId


class FrameFinalised(_Payload):
    """The operator is done with the frame; automatic passes leave it alone."""

    kind: Literal["frame_finalised"] = "frame_finalised"


class FrameReopened(_Payload):
    """The frame may change again."""

    kind: Literal["frame_reopened"] = "frame_reopened"


LabelChange = LabelAccepted | LabelEdited | LabelRejected | LabelDeleted

Payload = (
    ImageBoxesSet
    | ViewBoxesSet
    | ProposalsReplaced
    | TracksLinked
    | LabelCreated
    | LabelProposed
    | LabelTracked
    | LabelAccepted
    | LabelEdited
    | LabelRejected
    | LabelDeleted
    | LabelRestored
    | ImageBoxesRestored
    | ImageBoxesRemoved
    | ViewBoxesRestored
    | ViewBoxesRemoved
    | FrameFinalised
    | FrameReopened
)

PAYLOAD: TypeAdapter[Payload] = TypeAdapter(Annotated[Payload, Field(discriminator="kind")])
