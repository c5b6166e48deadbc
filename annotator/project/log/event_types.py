"""The payloads of events: one model per kind.

Events are never rewritten, so from the first release on, these models must read every database: a new field then needs
a default, and a changed meaning a new kind.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, Field, TypeAdapter, model_validator

from annotator.project.classes.attributes import Attribute, AttributeName, ClassStyle, Relabelling, Value
from annotator.project.log.records import EXACT, BoxRecord, Finite, ProposalRecord, SaidRecord, ViewGeometry
from annotator.types import NO_CORRECTION, Box2D, BoxKind, Correction, LostObject, ReviewState, Source, Suggestion
from annotator.types.label import MOST_TRACK

ViewId = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Uid = Annotated[str, Field(min_length=1, max_length=64)]
ClassName = Annotated[str, Field(min_length=1)]
Values = dict[str, Value]
ChangedValues = dict[AttributeName, Value | None]
TrackId = Annotated[int, Field(ge=-MOST_TRACK, le=MOST_TRACK)]


class Origin(StrEnum):
    """How an operator made a label that no detector proposed.

    DRAWN: by 2D boxes on the image and on pseudo-views. PLACED: as a 3D box. COPIED: from another frame; copies are
    open until they are reviewed.
    """

    DRAWN = "drawn"
    PLACED = "placed"
    COPIED = "copied"


class LabelState(BaseModel):
    """All stored values of a label except its uid and frame, as in `Label` and `StoredLabel`.

    Attributes:
        place: id of its row, which orders the labels of a frame.
        track_linked: True if linking assigned the track id, not a person or a file.
        box_kind: what the 3D box encloses.
        said: what each source says of the object, if other software proposed it.
        attributes: values by name.
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
    expected_iou_loss: float | None = None
    suggestion: Suggestion | None = None
    box_kind: BoxKind = BoxKind.BOX
    said: tuple[SaidRecord, ...] = ()
    attributes: Values = Field(default_factory=dict)


class ImageBoxesState(BaseModel):
    """All stored values of the boxes on a camera image, as in `ImageBoxes`."""

    model_config = EXACT

    boxes: tuple[Box2D, ...]
    box_kind: BoxKind
    author: str
    time_ns: int
    source: Source


class ViewBoxesState(BaseModel):
    """All stored values of the boxes on a pseudo-view, as in `ViewBoxes`."""

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
        """The class names that the payload contains."""
        return set()


class ImageBoxesSet(_Payload):
    """Replaces all 2D boxes on the camera image; empty = the image shows no object."""

    kind: Literal["image_boxes_set"] = "image_boxes_set"
    boxes: tuple[Box2D, ...]
    box_kind: BoxKind

    def classes(self) -> set[str]:
        return {box.label for box in self.boxes}


class ViewBoxesSet(_Payload):
    """Replaces all 2D boxes on one pseudo-view.

    Attributes:
        view: SHA-256 of the view's PNG, as returned by `Views.store`.
        step: the step of the recursion that rendered the view, from 0, if known.
        geometry: pose and scale of the view, if known.
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
        uid: of the label created from it.
        covered_by: uid of the reviewed label of the same object; if set, no label was created.
        track_id: the object's id over the recording, if the pass followed it from another frame.
        attributes: values by name; the store fills them in.
    """

    model_config = EXACT

    uid: Uid
    proposal: ProposalRecord
    covered_by: Uid | None = None
    track_id: TrackId | None = None
    attributes: Values = Field(default_factory=dict)


class ProposalsReplaced(_Payload):
    """An automatic pass: its proposals replace all unreviewed labels but `kept`.

    Attributes:
        run: id of the batch run, if it was part of one.
        objects: every proposal with its trace, also those covered by a reviewed label.
        lost: frustums without a resulting box.
        box_kind: what the proposed boxes enclose.
        kept: uids of open proposals that stay, because a person has set values of their attributes.
    """

    kind: Literal["proposals_replaced"] = "proposals_replaced"
    run: int | None = None
    objects: tuple[ProposedObject, ...]
    lost: tuple[LostObject, ...] = ()
    box_kind: BoxKind = BoxKind.BOX
    kept: tuple[Uid, ...] = ()

    def classes(self) -> set[str]:
        return {entry.proposal.label for entry in self.objects}


class OwnProposal(BaseModel):
    """An open proposal of ours, and what other sources say of its object.

    Attributes:
        attributes: its values, with those that others lend; None: they stay.
    """

    model_config = EXACT

    uid: Uid
    said: tuple[SaidRecord, ...]
    attributes: dict[str, bool | int | Finite | str] | None = None


class CoveredBox(BaseModel):
    """A box that is not proposed, because the reviewed label with the uid `by` covers it."""

    model_config = EXACT

    said: SaidRecord
    by: Uid


class ProposalsImported(_Payload):
    """The proposals of other software, after one source has changed what it says, or after an automatic pass.

    Attributes:
        source: which has changed; the others are repeated.
        objects: what the sources say of each object, the shown box first; they replace all open imported proposals
            but `kept`.
        ours: all open proposals of ours that stay.
        hidden: uids of those that do not: a surer box of other software is shown.
        covered: boxes of `source` that are not proposed.
        kept: as in `ProposalsReplaced`; the other fields leave them out.
    """

    kind: Literal["proposals_imported"] = "proposals_imported"
    source: str
    objects: tuple[tuple[SaidRecord, ...], ...]
    ours: tuple[OwnProposal, ...] = ()
    hidden: tuple[Uid, ...] = ()
    covered: tuple[CoveredBox, ...] = ()
    kept: tuple[Uid, ...] = ()

    def classes(self) -> set[str]:
        return {group[0].label for group in self.objects}


class LabelCreated(_Payload):
    """A 3D box that no automatic pass proposed: made by an operator, or imported.

    Attributes:
        origin: how an operator made it, if one did.
        image_box: box on the camera image that the label was made from, if any.
        suggestion: the detector that suggested its boxes, if the operator accepted any.
        box_kind: what the 3D box encloses.
        attributes: values by name; the store adds those of its track, and defaults.
        said: what sources said of the object in the dataset that it was imported from.
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
    suggestion: Suggestion | None = None
    box_kind: BoxKind = BoxKind.BOX
    attributes: Values = Field(default_factory=dict)
    said: tuple[SaidRecord, ...] = ()

    @model_validator(mode="after")
    def _reviewed(self) -> LabelCreated:
        # the next automatic pass would remove it
        if self.state is ReviewState.PROPOSED:
            raise ValueError("a created label cannot be in state 'proposed'; only an automatic pass proposes")
        return self

    def classes(self) -> set[str]:
        return {self.label}


class LabelProposed(_Payload):
    """A proposal that an operator requested: copied or interpolated from other frames of its track, or detected.

    Like the proposals of a pass, it waits for a review, and the next pass over the frame replaces it.

    Attributes:
        proposal: with its trace, if the recursion found the box.
        box_kind: what the box encloses.
        attributes: as in `LabelCreated`.
        origin: of a copy, which an operator has made.
        said: what other software says of the object, if this takes the place of its proposal.
    """

    kind: Literal["label_proposed"] = "label_proposed"
    uid: Uid
    label: ClassName
    box: BoxRecord
    track_id: TrackId | None = None
    proposal: ProposalRecord | None = None
    box_kind: BoxKind = BoxKind.BOX
    attributes: Values = Field(default_factory=dict)
    origin: Origin | None = None
    said: tuple[SaidRecord, ...] = ()

    def classes(self) -> set[str]:
        return {self.label}


class LabelTracked(_Payload):
    """Changes the label's track, or removes it from its track; its box and review state stay.

    Attributes:
        attributes: values of the new track; the store fills them in.
    """

    kind: Literal["label_tracked"] = "label_tracked"
    uid: Uid
    track_id: TrackId | None
    attributes: ChangedValues = Field(default_factory=dict)


class LinkedLabel(BaseModel):
    """Result of linking for one label.

    Attributes:
        track_id: the new track id; None keeps the label's own, given by a person or a file.
        box: smoothed over its track; None keeps the label's box, as required for a reviewed label.
        attributes: values of its track that it lacks.
    """

    model_config = EXACT

    uid: Uid
    track_id: TrackId | None = None
    box: BoxRecord | None = None
    attributes: Values = Field(default_factory=dict)


class TracksLinked(_Payload):
    """Result of linking over the recording: track ids of labels of one frame, and smoothed boxes of open proposals."""

    kind: Literal["tracks_linked"] = "tracks_linked"
    labels: tuple[LinkedLabel, ...]


class LabelAccepted(_Payload):
    """Accepts the label unchanged."""

    kind: Literal["label_accepted"] = "label_accepted"
    uid: Uid


class LabelEdited(_Payload):
    """Changes the label's class, box and track.

    Attributes:
        image_box: the new box on the camera image that the label is made from; None = unchanged.
        suggestion: the detector that suggested boxes for the new 3D box, if the operator accepted any. None = the
            operator made the 3D box, and an earlier suggestion counts as corrected if the box is another one.
        box_kind: what the new 3D box encloses; None = as before.
        attributes: values that follow from a new class or track, None = no value; the store fills them in.
    """

    kind: Literal["label_edited"] = "label_edited"
    uid: Uid
    label: ClassName
    box: BoxRecord
    track_id: int | None = None
    image_box: Box2D | None = None
    suggestion: Suggestion | None = None
    box_kind: BoxKind | None = None
    attributes: ChangedValues = Field(default_factory=dict)

    def classes(self) -> set[str]:
        return {self.label}


class LabelAttributesSet(_Payload):
    """Sets values of the label's attributes; None removes one. Its box and review state stay."""

    kind: Literal["label_attributes_set"] = "label_attributes_set"
    uid: Uid
    attributes: ChangedValues


class LabelRejected(_Payload):
    """Rejects the label: the object does not exist. The label stays, so that later passes do not propose it again."""

    kind: Literal["label_rejected"] = "label_rejected"
    uid: Uid


class LabelDeleted(_Payload):
    """Removes the label; a later pass may propose the object again."""

    kind: Literal["label_deleted"] = "label_deleted"
    uid: Uid


class LabelRestored(_Payload):
    """Restores a former state of the label: reverts an edit, a review or a deletion."""

    kind: Literal["label_restored"] = "label_restored"
    uid: Uid
    former: LabelState

    def classes(self) -> set[str]:
        return {self.former.label}


class ImageBoxesRestored(_Payload):
    """Restores former boxes on the camera image."""

    kind: Literal["image_boxes_restored"] = "image_boxes_restored"
    former: ImageBoxesState

    def classes(self) -> set[str]:
        return {box.label for box in self.former.boxes}


class ImageBoxesRemoved(_Payload):
    """The camera image is unlabelled again."""

    kind: Literal["image_boxes_removed"] = "image_boxes_removed"


class ViewBoxesRestored(_Payload):
    """Restores former boxes on one pseudo-view."""

    kind: Literal["view_boxes_restored"] = "view_boxes_restored"
    view: ViewId
    former: ViewBoxesState

    def classes(self) -> set[str]:
        return {box.label for box in self.former.boxes}


class ViewBoxesRemoved(_Payload):
    """The pseudo-view is unlabelled again: its object is being redrawn, or was removed."""

    kind: Literal["view_boxes_removed"] = "view_boxes_removed"
    view: ViewId


class FrameFinalised(_Payload):
    """Finalises the frame: automatic passes may not change it."""

    kind: Literal["frame_finalised"] = "frame_finalised"


class FrameReopened(_Payload):
    """Reopens a finalised frame."""

    kind: Literal["frame_reopened"] = "frame_reopened"


class FrameAttributesSet(_Payload):
    """Replaces all values of the frame's attributes."""

    kind: Literal["frame_attributes_set"] = "frame_attributes_set"
    attributes: Values


class ClassesChanged(_Payload):
    """Changes the project's classes or attributes. It belongs to no frame.

    Attributes:
        names: the classes after it.
        styles: colours and keys after it.
        attributes: after it.
        change: what happens to the stored labels.
    """

    kind: Literal["classes_changed"] = "classes_changed"
    names: tuple[str, ...]
    styles: dict[str, ClassStyle] = Field(default_factory=dict)
    attributes: tuple[Attribute, ...] = ()
    change: Relabelling = Relabelling()


class RecordingAdjusted(_Payload):
    """Sets the up direction and the correction of the calibration of the frame's recording, for all its frames.

    Attributes:
        up: as in `Adjustment`.
        last_frame: greatest id of the recording's frames at that time; the store fills it in.
    """

    kind: Literal["recording_adjusted"] = "recording_adjusted"
    recording: int
    up: tuple[Finite, Finite, Finite] | None
    correction: Correction = NO_CORRECTION
    last_frame: int = 0


LabelChange = LabelAccepted | LabelEdited | LabelRejected | LabelDeleted

Payload = (
    ImageBoxesSet
    | ViewBoxesSet
    | ProposalsReplaced
    | ProposalsImported
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
    | RecordingAdjusted
    | LabelAttributesSet
    | FrameAttributesSet
    | ClassesChanged
)

PAYLOAD: TypeAdapter[Payload] = TypeAdapter(Annotated[Payload, Field(discriminator="kind")])
