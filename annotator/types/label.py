"""What a person or an automatic pass says about a frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from annotator.types.boxes import OrientedBox


class Source(StrEnum):
    """Who made a label."""

    MANUAL = "manual"
    AUTO = "auto"
    IMPORTED = "imported"


class ReviewState(StrEnum):
    """Where a 3D box stands in the review."""

    PROPOSED = "proposed"
    ACCEPTED = "accepted"
    EDITED = "edited"
    REJECTED = "rejected"


class BoxKind(StrEnum):
    """What a 2D box on a view measures.

    BOX: the projection of the object's 3D box, hidden parts included (imported or accepted 3D labels).
    SILHOUETTE: the visible points of the object, as a person draws it.
    """

    BOX = "box"
    SILHOUETTE = "silhouette"


@dataclass(frozen=True, eq=False)
class Label:
    """One 3D box of one frame, in its present state.

    Attributes:
        uid: unique within a project and stable over edits.
        label: class name.
        box: the oriented box, camera frame.
        score: detector confidence in 0..1, or None for a box that no detector saw.
        source: who made the box first.
        state: where it stands in the review.
        author: who changed it last.
        time_ns: when, nanoseconds since the epoch.
        track_id: the object's id over the recording, where known.
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


@dataclass(frozen=True, eq=False)
class Truth:
    """One labelled object that came with a recording, or from elsewhere.

    Attributes:
        label: class name.
        box: the oriented box, camera frame.
        track_id: the object's id over the recording, where known.
        score: as its file says it, where it does: a confidence in 0..1, or a detector's raw figure of any size.
    """

    label: str
    box: OrientedBox
    track_id: int | None = None
    score: float | None = None
