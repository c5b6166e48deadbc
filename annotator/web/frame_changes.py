"""Changes of a frame as JSON, and their events."""

from __future__ import annotations

import uuid
from typing import Annotated, Any, Literal

from pydantic import Field

from annotator.project import Origin
from annotator.project.event_types import (
    FrameFinalised,
    FrameReopened,
    ImageBoxesSet,
    LabelAccepted,
    LabelCreated,
    LabelDeleted,
    LabelEdited,
    LabelRejected,
    LabelTracked,
    Payload,
)
from annotator.project.records import BoxRecord
from annotator.types import BoxKind
from annotator.types.label import MOST_TRACK
from annotator.web.schemas import (
    MOST_BOXES,
    Box2DJson,
    Box3DJson,
    ClassName,
    FrameChange,
    Schema,
    SuggestionJson,
    Uid,
)

TrackId = Annotated[int, Field(ge=-MOST_TRACK, le=MOST_TRACK)]


class Accept(Schema):
    """Accepts a label unchanged."""

    kind: Literal["accept"]
    uid: Uid

    def payload(self) -> Payload:
        return LabelAccepted(uid=self.uid)


class Reject(Schema):
    """Rejects a label: the object does not exist."""

    kind: Literal["reject"]
    uid: Uid

    def payload(self) -> Payload:
        return LabelRejected(uid=self.uid)


class Delete(Schema):
    """Removes a label; the object may be proposed again."""

    kind: Literal["delete"]
    uid: Uid

    def payload(self) -> Payload:
        return LabelDeleted(uid=self.uid)


class Edit(Schema):
    """Changes a label's class, box and track; with `box_kind`, also what its box encloses."""

    kind: Literal["edit"]
    uid: Uid
    label: ClassName
    box: Box3DJson
    track_id: TrackId | None = None
    box_kind: BoxKind | None = None

    def payload(self) -> Payload:
        box = BoxRecord.of(self.box.box())
        return LabelEdited(uid=self.uid, label=self.label, box=box, track_id=self.track_id, box_kind=self.box_kind)


class Track(Schema):
    """Changes a label's track, or removes it from its track; its review state stays."""

    kind: Literal["track"]
    uid: Uid
    track_id: TrackId | None

    def payload(self) -> Payload:
        return LabelTracked(uid=self.uid, track_id=self.track_id)


class Create(Schema):
    """Creates an accepted label.

    `image_box` is the box on the image that it was fitted to, if any; `suggestion` the detector that fitted it.
    """

    kind: Literal["create"]
    label: ClassName
    box: Box3DJson
    track_id: TrackId | None = None
    image_box: Box2DJson | None = None
    suggestion: SuggestionJson | None = None

    def payload(self) -> Payload:
        return LabelCreated(
            uid=uuid.uuid4().hex,
            label=self.label,
            box=BoxRecord.of(self.box.box()),
            track_id=self.track_id,
            origin=Origin.PLACED if self.image_box is None else Origin.DRAWN,
            image_box=None if self.image_box is None else self.image_box.box(),
            suggestion=None if self.suggestion is None else self.suggestion.stored(),
        )


class ImageBoxesIn(Schema):
    """Replaces all boxes on the camera image."""

    kind: Literal["image_boxes"]
    boxes: Annotated[list[Box2DJson], Field(max_length=MOST_BOXES)]
    box_kind: BoxKind

    def payload(self) -> Payload:
        return ImageBoxesSet(boxes=tuple(box.box() for box in self.boxes), box_kind=self.box_kind)


class Finalise(Schema):
    """Finalises the frame."""

    kind: Literal["finalise"]

    def payload(self) -> Payload:
        return FrameFinalised()


class Reopen(Schema):
    """Reopens the frame."""

    kind: Literal["reopen"]

    def payload(self) -> Payload:
        return FrameReopened()


ChangeIn = Annotated[
    Accept | Reject | Delete | Edit | Track | Create | ImageBoxesIn | Finalise | Reopen, Field(discriminator="kind")
]


class ChangesIn(FrameChange):
    """Changes of one frame, based on one revision of it."""

    changes: Annotated[list[ChangeIn], Field(min_length=1, max_length=MOST_BOXES)]
    subject: Uid | None = None

    def payloads(self) -> list[Payload]:
        return [entry.payload() for entry in self.changes]

    def sent(self) -> list[Any]:
        changes: list[Any] = self.model_dump(mode="json")["changes"]
        return changes
