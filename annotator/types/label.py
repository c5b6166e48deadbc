"""3D labels of a frame, from people, automatic passes and files; proposals and their traces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Self

from scipy.spatial.transform import RigidTransform

from annotator.types.boxes import Box2D, OrientedBox

# Track ids range from -MOST_TRACK to MOST_TRACK, the integers that JSON and SQLite represent exactly.
MOST_TRACK = 2**53

AttributeValue = bool | int | float | str


class Source(StrEnum):
    MANUAL = "manual"
    AUTO = "auto"
    IMPORTED = "imported"


class ReviewState(StrEnum):
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
        score: its certainty in 0..1, if known.
        track_id: the object's id within the recording, if known.
        box_kind: what the box encloses.
        attributes: values of its attributes, by name; files of labels have none.
        file_track_id: its id in the source's file, if other labels of the recording use that one.
    """

    source: str
    label: str
    box: OrientedBox
    score: float | None = None
    track_id: int | None = None
    box_kind: BoxKind = BoxKind.BOX
    attributes: dict[str, AttributeValue] = field(default_factory=dict)
    file_track_id: int | None = None

    def transformed(self, T: RigidTransform) -> Said:
        return replace(self, box=self.box.transformed(T))


@dataclass(frozen=True, eq=False)
class Truth:
    """One labelled object from the files of a recording, or from another source.

    Attributes:
        track_id: the object's id within the recording; None if unknown.
        score: as in its file: a confidence in 0..1, or a detector's raw value of any size; None if it has none.
        image_box: the label's own 2D box on the image; None if its file has none.
        box_kind: what the box encloses: the whole object, or what is seen of it.
        attributes: values of its attributes, by name.
        said: what sources of boxes said of the object, as in its file (see `StoredLabel.said`).
    """

    label: str
    box: OrientedBox
    track_id: int | None = None
    score: float | None = None
    image_box: Box2D | None = None
    box_kind: BoxKind = BoxKind.BOX
    attributes: Mapping[str, AttributeValue] = field(default_factory=dict)
    said: tuple[Said, ...] = ()

    def transformed(self, T: RigidTransform) -> Self:
        """The object, and what was said of it, with the boxes moved by `T`."""
        return replace(self, box=self.box.transformed(T), said=tuple(each.transformed(T) for each in self.said))


@dataclass(frozen=True, eq=False, kw_only=True)
class Label(Truth):
    """One 3D box of one frame, in its current state.

    Attributes:
        uid: unique within a project and stable over edits.
        time_ns: time of the last change, nanoseconds since the epoch.
        expected_iou_loss: as in `Quality`, of a proposal that nobody edited; None for other boxes.
        suggestion: the detector that suggested its boxes while the operator drew it, if one did.
    """

    uid: str
    source: Source
    state: ReviewState
    author: str
    time_ns: int
    expected_iou_loss: float | None = None
    suggestion: Suggestion | None = None


Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class StopReason(StrEnum):
    """Why a recursion ended; CONTINUES if it has not."""

    AXES_CONVERGED = "axes converged"
    BOX_CONVERGED = "box converged"
    STEP_LIMIT = "step limit"
    LOST = "lost"
    TOO_FEW_POINTS = "too few points"
    CONTINUES = "continues"


@dataclass(frozen=True)
class ViewTrace:
    """One pseudo-view of a step.

    Attributes:
        axes: rows = the view's x, y, z axes in the camera frame.
        metres_per_px, origin_m, width_px, height_px: as in `PseudoView`.
        boxes: detections of the frustum's class, best first.
        used: index into `boxes` of the detection that contributed to the 3D box, or None.
    """

    axes: Matrix3
    metres_per_px: float
    origin_m: tuple[float, float]
    width_px: int
    height_px: int
    boxes: tuple[Box2D, ...]
    used: int | None


@dataclass(frozen=True)
class BoxTrace:
    """An oriented box as plain numbers: centre and size in metres, columns of `rotation` = box axes, camera frame."""

    center_m: tuple[float, float, float]
    rotation: Matrix3
    size_m: tuple[float, float, float]


@dataclass(frozen=True)
class StepTrace:
    """One step of a recursion.

    Attributes:
        strategy: the projection axes that were used.
        fallback: strategies that failed before, each with the reason; and whether a warm start was used.
        views: all pseudo-views of the step, front and side of each hypothesis in turn.
        box: the step's box, or None if the object was lost.
        points_in, points_kept: number of points before and after the cloud is cropped to the step's box.
        stop: why the recursion ended after this step; CONTINUES if it did not.
    """

    strategy: str
    fallback: tuple[str, ...]
    views: tuple[ViewTrace, ...]
    box: BoxTrace | None
    points_in: int
    points_kept: int
    stop: StopReason


@dataclass(frozen=True)
class Quality:
    """Quality signals by which proposals are sorted for review.

    Attributes:
        view_disagreement: difference of the intervals that the views measured on shared directions (front and
            side for the paper's strategies, residual of the fit for consensus), as a share of the box's size.
        kept_share: share of the points of the last step's views that lie inside its box.
        last_change: 1 - IoU of the boxes of the last two steps.
        image_agreement: IoU on the camera image between the result (the projected box, or for silhouettes the kept
            points) and its image box. Low if the object is partly hidden, or if the result is another object
            next to the detected one. None where it was not measured.
        expected_iou_loss: expected 1 - IoU with the true box, by the uncertainty of the last step's fit. None without a
            fit.
    """

    view_disagreement: float
    kept_share: float
    last_change: float
    image_agreement: float | None = None
    expected_iou_loss: float | None = None


Edges = tuple[float | None, float | None, float | None, float | None]
"""Left, right, top and bottom of a rectangle on an image as x/z and y/z; None at the border, where it may go on."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """An oriented 3D box proposed for one object of one frame.

    Attributes:
        score: 0..1, from both detectors.
        box: camera frame.
        image_box: the box on the camera image whose frustum was processed.
        quality: signals for the review.
        edges: of the expected outline of the whole box on the image; None where they are not known.
    """

    label: str
    score: float
    box: OrientedBox
    image_box: Box2D
    trace: tuple[StepTrace, ...]
    quality: Quality
    edges: Edges | None = None


@dataclass(frozen=True, eq=False)
class LostObject:
    """An object on the image for which no 3D box was found; the trace shows at which step and why."""

    label: str
    image_box: Box2D
    trace: tuple[StepTrace, ...]
