"""Changes to a frame as JSON, and the events that they are."""

from __future__ import annotations

import uuid
from typing import Annotated, Literal

from pydantic import Field

from annotator.project import Change, Origin
from annotator.project.payloads import (
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
from annotator.types.tracks import MOST_TRACK
from annotator.web.wire import MOST_BOXES, Box2DJson, Box3DJson, ClassName, Effort, RowId, Uid, Wire

TrackId = Annotated[int, Field(ge=-MOST_TRACK, le=MOST_TRACK)]


class Accept(Wire):
    """The label is right as it stands."""

    kind: Literal["accept"]
    uid: Uid

    def payload(self) -> Payload:
        return LabelAccepted(uid=self.uid)


class Reject(Wire):
    """There is no such object."""

    kind: Literal["reject"]
    uid: Uid

    def payload(self) -> Payload:
        return LabelRejected(uid=self.uid)


class Delete(Wire):
    """The label goes; the object may be proposed again."""

    kind: Literal["delete"]
    uid: Uid

    def payload(self) -> Payload:
        return LabelDeleted(uid=self.uid)


class Edit(Wire):
    """The label's new class, box and track."""

    kind: Literal["edit"]
    uid: Uid
    label: ClassName
    box: Box3DJson
    track_id: TrackId | None = None

    def payload(self) -> Payload:
        return LabelEdited(uid=self.uid, label=self.label, box=BoxRecord.of(self.box.box()), track_id=self.track_id)


class Track(Wire):
    """The label belongs to another track, or to none; its review stays as it is."""

    kind: Literal["track"]
    uid: Uid
    track_id: TrackId | None

    def payload(self) -> Payload:
        return LabelTracked(uid=self.uid, track_id=self.track_id)


class Create(Wire):
    """A new label, accepted; `image_box` where it was fitted to a box that was drawn on the image."""

    kind: Literal["create"]
    label: ClassName
    box: Box3DJson
    track_id: TrackId | None = None
    image_box: Box2DJson | None = None

    def payload(self) -> Payload:
        return LabelCreated(
            uid=uuid.uuid4().hex,
            label=self.label,
            box=BoxRecord.of(self.box.box()),
            track_id=self.track_id,
            origin=Origin.PLACED if self.image_box is None else Origin.DRAWN,
            image_box=None if self.image_box is None else self.image_box.box(),
        )


class ImageBoxesIn(Wire):
    """All boxes on the camera image, in place of those before."""

    kind: Literal["image_boxes"]
    boxes: Annotated[list[Box2DJson], Field(max_length=MOST_BOXES)]
    box_kind: BoxKind

    def payload(self) -> Payload:
        return ImageBoxesSet(boxes=tuple(box.box() for box in self.boxes), box_kind=self.box_kind)


class Finalise(Wire):
    """The operator is done with the frame."""

    kind: Literal["finalise"]

    def payload(self) -> Payload:
        return FrameFinalised()


class Reopen(Wire):
    """The frame may change again."""

    kind: Literal["reopen"]

    def payload(self) -> Payload:
        return FrameReopened()


ChangeIn = Annotated[
    Accept | Reject | Delete | Edit | Track | Create | ImageBoxesIn | Finalise | Reopen, Field(discriminator="kind")
]


class ChangesIn(Wire):
    """Changes to one frame, based on one revision of it."""

    revision: RowId
    changes: Annotated[list[ChangeIn], Field(min_length=1, max_length=MOST_BOXES)]
    effort: Effort | None = None
    subject: Uid | None = None

    def payloads(self) -> list[Payload]:
        return [entry.payload() for entry in self.changes]

    def change(self, author: str) -> Change:
        effort = None if self.effort is None else self.effort.stored()
        return Change(self.revision, author, effort=effort, subject=self.subject)
