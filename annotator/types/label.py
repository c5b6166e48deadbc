"""3D labels of a frame, from people, automatic passes and files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from scipy.spatial.transform import RigidTransform

from annotator.types.boxes import Box2D, OrientedBox

# Track ids range from -MOST_TRACK to MOST_TRACK, the integers that JSON and SQLite represent exactly.
MOST_TRACK = 2**53

AttributeValue = bool | int | float | str


class Source(StrEnum):
    """The origin of a label."""

    MANUAL = "manual"
    AUTO = "auto"
    IMPORTED = "imported"


class ReviewState(StrEnum):
    """The review state of a 3D box."""

    PROPOSED = "proposed"
    ACCEPTED = "accepted"
    EDITED = "edited"
    REJECTED = "rejected"


class BoxKind(StrEnum):
    """What a 2D box on a view, or a 3D box, encloses.

    BOX: the whole object, hidden parts included; in 2D, the projection of its 3D box.
    SILHOUETTE: the visible points of the object (drawn boxes).
    """

    BOX = "box"
    SILHOUETTE = "silhouette"


@dataclass(frozen=True)
class Suggestion:
    """The view detector that suggested boxes from which an operator made a label.

    Attributes:
        detector: its name.
        fingerprint: as in `Detector`.
        corrected: True if the operator drew some of the boxes, or has changed the 3D box since.
    """

    detector: str
    fingerprint: str
    corrected: bool = False


@dataclass(frozen=True, eq=False)
class Said:
    """What one source of boxes, such as a detector, said of an object before its review.

    Attributes:
        source: name of the detector, person or file.
        label: class name.
        box: the oriented box, camera frame.
        score: its certainty in 0..1, if known.
        track_id: the object's id within the recording, if known.
        box_kind: what the box encloses.
    """

    source: str
    label: str
    box: OrientedBox
    score: float | None = None
    track_id: int | None = None
    box_kind: BoxKind = BoxKind.BOX

    def transformed(self, T: RigidTransform) -> Said:
        """Returns it with the box moved by `T`."""
        return replace(self, box=self.box.transformed(T))


@dataclass(frozen=True, eq=False)
class Label:
    """One 3D box of one frame, in its current state.

    Attributes:
        uid: unique within a project and stable over edits.
        label: class name.
        box: the oriented box, camera frame.
        score: detector confidence in 0..1; None for a box that does not come from a detector.
        source: origin of the box.
        state: review state.
        author: author of the last change.
        time_ns: time of the last change, nanoseconds since the epoch.
        track_id: the object's id within the recording; None if unknown.
        expected_iou_loss: as in `Quality`, of a proposal that nobody edited; None for other boxes.
        suggestion: the detector that suggested its boxes while the operator drew it, if one did.
        box_kind: what the box encloses: the whole object, or what is seen of it.
        attributes: values of its attributes, by name.
        said: what sources of boxes said of the object; known in exports and their files (see `StoredLabel.said`).
    """

    uid: str
    label: str
    box: OrientedBox
    score: float | None
    source: Source
    state: ReviewState
    author: str
    time_ns: int
    track_id: int | None = None
    expected_iou_loss: float | None = None
    suggestion: Suggestion | None = None
    box_kind: BoxKind = BoxKind.BOX
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)
    said: tuple[Said, ...] = ()


@dataclass(frozen=True, eq=False)
class Truth:
    """One labelled object from the files of a recording, or from another source.

    Attributes:
        label: class name.
        box: the oriented box, camera frame.
        track_id: the object's id within the recording; None if unknown.
        score: as in its file: a confidence in 0..1, or a detector's raw value of any size; None if the file has none.
        image_box: the label's own 2D box on the image; None if its file has none.
        box_kind: what the box encloses.
        attributes: values of its attributes as in its file, by name.
        said: what sources of boxes said of the object, as in its file.
    """

    label: str
    box: OrientedBox
    track_id: int | None = None
    score: float | None = None
    # not compared: formats without 2D boxes give equal objects
    image_box: Box2D | None = field(default=None, compare=False)
    box_kind: BoxKind = BoxKind.BOX
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)
    said: tuple[Said, ...] = ()
