"""What callers ask the store to change, one model for each kind; `audit/making.py` makes changed rows of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, ClassVar

from pydantic import Field

from annotator.project.classes.attributes import AttributeName, Value
from annotator.project.records import BoxRecord, Exact, ViewGeometry
from annotator.project.rows import new_uid
from annotator.types import Box2D, BoxKind, OrientedBox, Proposal, ReviewState, Suggestion
from annotator.types.bases import TrackId
from annotator.types.errors import ProjectError
from annotator.types.label import MOST_TRACK, AttributeValue, Said

ViewId = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Uid = Annotated[str, Field(min_length=1, max_length=64)]
ClassName = Annotated[str, Field(min_length=1)]
ChangedValues = dict[AttributeName, Value | None]


class Origin(StrEnum):
    """How an operator made a label that no detector proposed.

    DRAWN: by 2D boxes on the image and on pseudo-views. PLACED: as a 3D box. COPIED: from another frame; copies are
    open until they are reviewed. STILL: of an object that stands still, from any frame.
    """

    DRAWN = "drawn"
    PLACED = "placed"
    COPIED = "copied"
    STILL = "still"


class Payload:
    """One change of a frame."""

    kind: ClassVar[str]


class _Checked(Exact, Payload):
    kind: ClassVar[str]


class ImageBoxesSet(_Checked):
    """Replaces all 2D boxes on the camera image; empty = the image shows no object."""

    kind = "image_boxes_set"
    boxes: tuple[Box2D, ...]
    box_kind: BoxKind


class ViewBoxesSet(_Checked):
    """Replaces all 2D boxes on one pseudo-view."""

    kind = "view_boxes_set"
    view: ViewId
    boxes: tuple[Box2D, ...]
    box_kind: BoxKind
    step: int | None = None
    geometry: ViewGeometry | None = None


class ViewBoxesRemoved(_Checked):
    """The pseudo-view is unlabelled again: its object is being redrawn, or was removed."""

    kind = "view_boxes_removed"
    view: ViewId


@dataclass(frozen=True, eq=False)
class NewLabel(Payload):
    """A 3D box, camera frame, that no automatic pass proposed: made by an operator, or imported.

    In the state PROPOSED, an operator has requested it: copied or interpolated from other frames of its track, or
    detected. Like the proposals of a pass, it waits for a review, and the next pass over the frame replaces it.

    Attributes:
        image_box: box on the camera image that it was drawn from, if any.
        suggestion: the detector that suggested its boxes, if the operator accepted any.
        attributes: values by name; those of its track and defaults are added. Of a proposal, those that do not fit are
            left out.
        origin: how an operator made it, if one did.
        said: what other sources say of the object.
        file_track_id: as in `Said`, of a box that `Proposals.bring` gets.
        proposal: if the recursion found the box.

    Raises ProjectError for a track id beyond `MOST_TRACK`.
    """

    kind = "label_created"
    label: str
    box: OrientedBox
    score: float | None = None
    track_id: int | None = None
    state: ReviewState = ReviewState.ACCEPTED
    origin: Origin | None = None
    suggestion: Suggestion | None = None
    image_box: Box2D | None = None
    box_kind: BoxKind = BoxKind.BOX
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)
    said: tuple[Said, ...] = ()
    file_track_id: int | None = None
    proposal: Proposal | None = None
    uid: str = field(default_factory=new_uid)

    def __post_init__(self) -> None:
        # the limit of the database and of exported files
        if self.track_id is not None and abs(self.track_id) > MOST_TRACK:
            raise ProjectError(f"a track id must lie in -{MOST_TRACK}..{MOST_TRACK}; renumber the tracks")
        if self.score is not None and not math.isfinite(self.score):
            raise ProjectError(f"a score must be a finite number, not {self.score}; correct it in its source")

    @property
    def is_requested(self) -> bool:
        """Whether it is a proposal."""
        return self.state is ReviewState.PROPOSED


@dataclass(frozen=True, eq=False)
class ProposalsReplaced(Payload):
    """An automatic pass: its proposals replace all unreviewed labels, except kept ones and those of other software.

    Attributes:
        found: all proposals, also those that a reviewed label covers.
        new: the labels of the others.
    """

    kind = "proposals_replaced"
    found: Sequence[Proposal]
    new: Sequence[NewLabel]
    run: int | None = None


REQUESTED = "label_proposed"
"""The kind of the event of a requested proposal."""


class LabelChanged(_Checked):
    """Changes what is given of a label; the rest stays, its review state too.

    Attributes:
        state: a decision. Accepted: unchanged. Edited: by a person; a box that is the present one but for its last
            digits stays bit for bit. Rejected: the object does not exist; the label stays, so that later passes do not
            propose it again.
        track_id: None removes the label from its track; its values become those of its new track.
        image_box: the box on the camera image that the label is made from.
        suggestion: the detector that suggested boxes for the new 3D box, if the operator accepted any. Without one, the
            operator made the 3D box, and an earlier suggestion counts as corrected.
        box_kind: what the new 3D box encloses.
        attributes: values to set; None removes one.
        here: of an object that stands still: only in this frame, which gets a box of its own.
    """

    kind = "label_changed"
    uid: Uid
    state: ReviewState | None = None
    label: ClassName | None = None
    box: BoxRecord | None = None
    track_id: TrackId | None = None
    image_box: Box2D | None = None
    suggestion: Suggestion | None = None
    box_kind: BoxKind | None = None
    attributes: ChangedValues = Field(default_factory=dict)
    here: bool = False


class TracksLinked(_Checked):
    """Result of linking over the recording, of the labels of one frame: new track ids, smoothed boxes of open
    proposals, and values of their tracks that they lack. Their authors stay."""

    kind = "tracks_linked"
    labels: tuple[LabelChanged, ...]


class LabelDeleted(_Checked):
    """Removes the label; a later pass may propose the object again. `here`: an object that stands still is not visible
    in this frame."""

    kind = "label_deleted"
    uid: Uid
    here: bool = False


class StillMade(_Checked):
    """The track of a label stands still: its box becomes the one in the world. An open proposal counts as accepted.

    Attributes:
        still: the uid of the still object; its labels have the uids `still_moment`.
    """

    kind = "still_made"
    uid: Uid
    still: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")] = Field(default_factory=new_uid)


@dataclass(frozen=True, eq=False)
class StillProposal:
    """An object that stands still, as one proposal for all moments that see it.

    Attributes:
        box: in the camera frame of the frame.
        track_id: one that the rig has not used.
        uid: of the still object.
    """

    label: str
    box: OrientedBox
    track_id: int
    score: float
    expected_iou_loss: float
    box_kind: BoxKind = BoxKind.BOX
    uid: str = field(default_factory=new_uid)


@dataclass(frozen=True, eq=False)
class StillsProposed(Payload):
    """An automatic pass: what stands still in a rig. `removed`: uids of the open ones of the pass before."""

    kind = "stills_proposed"
    new: Sequence[StillProposal]
    removed: Sequence[str] = ()


class StillEnded(_Checked):
    """The object of a label is no longer said to stand still."""

    kind = "still_ended"
    uid: Uid


class FrameFinalised(_Checked):
    """Finalises the frame, so that automatic passes may not change it, or reopens it."""

    kind = "frame_finalised"
    finalised: bool = True


class FrameAttributesSet(_Checked):
    """Sets values of the frame's attributes; None removes one."""

    kind = "frame_attributes_set"
    attributes: ChangedValues
