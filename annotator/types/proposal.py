"""Proposals of Recursive Cross-View, and the trace of their recursions."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from annotator.types.boxes import Box2D, OrientedBox

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


@dataclass(frozen=True, eq=False)
class Proposal:
    """An oriented 3D box proposed for one object of one frame.

    Attributes:
        label: class name, from the image detector.
        score: 0..1, from both detectors.
        box: camera frame.
        image_box: the box on the camera image whose frustum was processed.
        trace: every step.
        quality: signals for the review.
    """

    label: str
    score: float
    box: OrientedBox
    image_box: Box2D
    trace: tuple[StepTrace, ...]
    quality: Quality


@dataclass(frozen=True, eq=False)
class LostObject:
    """An object on the image for which no 3D box was found; the trace shows at which step and why."""

    label: str
    image_box: Box2D
    trace: tuple[StepTrace, ...]
