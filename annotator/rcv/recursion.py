"""The recursion of one object: draw a step's pseudo-views, fuse the detections on them, continue or stop.

A step has two halves, `plan_step` and `absorb_step`. Between them the caller sends the views of all objects of all
frames through the detector in one batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners, canonical_box, contains
from annotator.geometry.outline import NEAR_M
from annotator.rcv.axes import axes_angle_rad, camera_axes, find_axes
from annotator.rcv.config import AGNOSTIC_LABELS, MIN_POINTS, Orientation, RcvConfig, Strategy
from annotator.rcv.first_look import expected_outline, image_planes
from annotator.rcv.interval_fit import BoxFit, Intervals
from annotator.rcv.measure import (
    Measurement,
    cut_margin_m,
    measure_consensus,
    measure_objects,
    measure_pair,
    measure_tightest,
    of_class,
)
from annotator.rcv.pseudo_view import frustum_views, render_pairs
from annotator.rcv.rotations import near_axes, warm_axes, wide_axes
from annotator.rcv.typical_size import Candidates, Evidence
from annotator.types import (
    Box2D,
    BoxKind,
    BoxTrace,
    Camera,
    OrientedBox,
    PointCloud,
    PseudoView,
    Quality,
    StepTrace,
    StopReason,
    ViewTrace,
)

# The recursion has converged if the axes turn by less than this, or if 1 - IoU with the last box is below this.
AXES_TOLERANCE_RAD, BOX_TOLERANCE = 0.02, 0.03
# If the object was cut off, the next views show its box enlarged by this factor.
CUT_ROOM = 1.4
# Most steps after a warm start.
WARM_STEPS = 2


@dataclass(frozen=True, eq=False)
class FrustumFacts:
    """The frustum of an object that starts from a crop of it.

    Attributes:
        middle_m: (k, 3) a sample of the points in the middle of the image box.
        evidence, placed: of an object of a class with a typical size: what is known of it, and the boxes that are
            plausible before a detector is used.
    """

    cloud: PointCloud
    middle_m: Float32[np.ndarray, "k 3"]
    camera: Camera
    evidence: Evidence | None = None
    placed: Candidates | None = None


@dataclass(frozen=True, eq=False)
class ObjectState:
    """The state of one object in the recursion.

    Attributes:
        up: unit vector against gravity for an upright box, None for a free one.
        is_cut: whether a detection of the last step touched its view's border; the object may extend beyond it.
        expected_loss: the expected 1 - IoU of a box that was chosen among candidates (`finish`); None = by the fit.
        notes: how the object came to its present box or cloud, for the trace of the next step.
        is_warm: whether the object started from its previous box (`warm_start`).
        cold: the state without the warm start or the look of a trained detector (`starts`); None without them, or
            after the first step, which checks them.
        rivals: number of states of the object that share the axis hypotheses of a wide step.
        frustum: what a class-agnostic detector's object needs of its whole frustum; None with other detectors.
    """

    frame_index: int
    image_box: Box2D
    cloud: PointCloud
    up: Float64[np.ndarray, "3"] | None
    axes: Float64[np.ndarray, "3 3"]
    box: OrientedBox | None = None
    measured: Intervals | None = None
    is_cut: bool = False
    view_score: float = 0.0
    disagreement: float = 0.0
    last_change: float = 1.0
    kept_share: float = 1.0
    fit: BoxFit | None = None
    expected_loss: float | None = None
    steps: tuple[StepTrace, ...] = ()
    stop: StopReason = StopReason.CONTINUES
    notes: tuple[str, ...] = ()
    is_warm: bool = False
    cold: ObjectState | None = None
    rivals: int = 1
    frustum: FrustumFacts | None = None

    @property
    def is_first(self) -> bool:
        """True before the first step of an object without a start box: only its frustum is known."""
        return not self.steps and self.box is None

    @property
    def quality(self) -> Quality:
        loss = self.expected_loss
        if loss is None and self.fit is not None:
            loss = self.fit.expected_iou_loss()
        return Quality(self.disagreement, self.kept_share, self.last_change, expected_iou_loss=loss)


@dataclass(frozen=True, eq=False)
class StepPlan:
    """The pseudo-views of an object's next step: front and side view for each set of axes."""

    strategy: Strategy
    fallback: tuple[str, ...]
    views: tuple[PseudoView, ...]


def held_direction(up: np.ndarray | None, config: RcvConfig) -> np.ndarray | None:
    """The direction to which one box axis stays parallel: unit vector (3,), or None for free boxes."""
    if config.orientation is Orientation.FREE:
        return None
    # without a gravity direction, the camera is assumed to be level
    return np.array([0.0, -1.0, 0.0]) if up is None else up


def start(
    frame_index: int, image_box: Box2D, cloud: PointCloud, up: np.ndarray | None, config: RcvConfig
) -> ObjectState:
    """The state before the first step; already stopped if the frustum has too few points."""
    held = held_direction(up, config)
    state = ObjectState(frame_index, image_box, cloud, held, camera_axes(held))
    if len(cloud) < MIN_POINTS:
        step = StepTrace(Strategy.CAMERA, (), (), None, len(cloud), 0, StopReason.TOO_FEW_POINTS)
        return replace(state, steps=(step,), stop=StopReason.TOO_FEW_POINTS)
    return state


def plan_step(state: ObjectState, config: RcvConfig) -> StepPlan:
    """Chooses the projection axes of the next step and draws its views."""
    fallback: tuple[str, ...] = ()
    if state.is_first:
        strategy, axes = Strategy.CAMERA, [camera_axes(state.up)]
    elif config.strategy is Strategy.CONSENSUS:
        strategy = Strategy.CONSENSUS
        axes, fallback = _consensus_axes(state, config)
    else:
        chosen = find_axes(state.cloud, config.strategy, state.axes, state.up, config)
        strategy, fallback, axes = chosen.strategy, chosen.fallback, [chosen.axes]
    views: Sequence[PseudoView]
    if state.is_first:
        views = frustum_views(state.cloud, axes[0], config, enlarge_deep=state.frustum is None)
    else:
        show = None if state.box is None else box_corners(shown_box(state.box, state.is_cut))
        views = render_pairs(state.cloud, axes, config.view_px, show)
    return StepPlan(strategy, state.notes + fallback, tuple(views))


def shown_box(box: OrientedBox, is_cut: bool) -> OrientedBox:
    """The box that the next views must show: the last box, enlarged if it was cut off."""
    return OrientedBox(box.pose, box.size_m * (CUT_ROOM if is_cut else 1.0))


def cut_cloud(cloud: PointCloud, box: OrientedBox, views: Sequence[PseudoView]) -> PointCloud:
    """The points that a step keeps: those in its box and within `cut_margin_m` of it."""
    return cloud.select(contains(box, cloud.xyz_m, cut_margin_m(box, views)))


def _consensus_axes(state: ObjectState, config: RcvConfig) -> tuple[list[Float64[np.ndarray, "3 3"]], tuple[str, ...]]:
    """The axis hypotheses of a step, and why more complex strategies failed."""
    if state.box is None or (len(state.steps) == 1 and not state.is_warm):
        return wide_axes(state.up, state.rivals), ()
    if state.is_warm:
        axes = warm_axes(state.box.rotation, state.up, len(state.steps))
    else:
        axes = near_axes(state.box.rotation, state.up)
    if config.box_kind is not BoxKind.SILHOUETTE:
        return axes, ()
    reference = camera_axes(state.up)
    normals = find_axes(state.cloud, Strategy.NORMALS, reference, state.up, config)
    return [*axes, normals.axes], normals.fallback


def absorb_step(
    state: ObjectState, plan: StepPlan, detections: Sequence[Sequence[Box2D]], config: RcvConfig
) -> list[ObjectState]:
    """The object's state after a step; several states if the first step finds several objects.

    Args:
        detections: per view of the plan, best first; classes other than the frustum's are ignored.
    """
    label = state.image_box.label
    detected = AGNOSTIC_LABELS[config.box_kind] if config.class_agnostic else label
    boxes = [of_class(on_view, detected, label, config.min_view_score) for on_view in detections]
    if state.is_first:
        # The consensus does not use the first step's intervals: the object is small in these views, and their edges
        # have a bias and three times the error of later ones.
        objects: Sequence[Measurement | None] = measure_objects(plan.views, boxes, state.cloud) or [None]
        return [_advance(state, plan, boxes, each, config) for each in objects]
    if plan.strategy is not Strategy.CONSENSUS:
        measured = measure_pair(plan.views, boxes, state.box)
    elif config.box_kind is BoxKind.SILHOUETTE:
        measured = measure_tightest(plan.views, boxes, state.box, state.cloud)
    else:
        start_box = state.box if state.is_warm and not state.steps else None
        measured = measure_consensus(
            plan.views, boxes, state.box, state.measured, state.up, start_box, _planes(state, config)
        )
    return [_advance(state, plan, boxes, measured, config)]


def _planes(state: ObjectState, config: RcvConfig) -> Intervals | None:
    """The bounds that the image box gives the fit, with class-agnostic detectors; None without any."""
    if state.frustum is None or state.box is None:
        return None
    depth_m = max(float(state.box.center_m[2]), NEAR_M)
    return image_planes(state.frustum.camera, expected_outline(state.frustum.camera, state.image_box, config), depth_m)


def _advance(
    state: ObjectState,
    plan: StepPlan,
    boxes: list[tuple[Box2D, ...]],
    measured: Measurement | None,
    config: RcvConfig,
) -> ObjectState:
    """Cuts the cloud with the step's box, decides whether to continue, and writes the trace."""
    n = len(state.cloud)
    if measured is None:
        step = _step_trace(plan, boxes, (None,) * len(boxes), None, n, 0, StopReason.LOST)
        return replace(state, steps=(*state.steps, step), stop=StopReason.LOST)
    box = canonical_box(measured.box, state.up)
    cloud = cut_cloud(state.cloud, box, plan.views)
    if state.frustum is not None and measured.cut:
        # the object may extend beyond the points kept so far
        cloud = cut_cloud(state.frustum.cloud, shown_box(box, True), plan.views)
    inside = int(np.count_nonzero(contains(box, cloud.xyz_m)))
    change = 1.0 if state.box is None else 1.0 - iou_3d(state.box, box)
    turned = np.inf if state.box is None else axes_angle_rad(measured.axes, state.axes)
    stop = _stop(state, len(cloud), turned, change, measured.cut, config)
    plan = replace(plan, fallback=plan.fallback + measured.fallback)
    step = _step_trace(plan, boxes, measured.used, box, n, len(cloud), stop)
    return replace(
        state,
        cloud=cloud,
        axes=measured.axes,
        box=box,
        measured=measured.intervals,
        is_cut=measured.cut,
        view_score=measured.score,
        disagreement=measured.disagreement,
        last_change=change,
        kept_share=inside / n,
        fit=measured.fit,
        steps=(*state.steps, step),
        stop=stop,
        notes=(),
    )


def _stop(
    state: ObjectState, points: int, turned_rad: float, change: float, is_cut: bool, config: RcvConfig
) -> StopReason:
    if points < MIN_POINTS:
        return StopReason.TOO_FEW_POINTS
    steps = len(state.steps) + 1
    # In a consensus, agreement with the first step is not convergence, because the camera's axes do not depend on the
    # object. A cut-off object gets another step with larger views.
    first = 2 if config.strategy is Strategy.CONSENSUS and not state.is_warm else 1
    if steps > first and not is_cut and turned_rad < AXES_TOLERANCE_RAD:
        return StopReason.AXES_CONVERGED
    if steps > first and not is_cut and change < BOX_TOLERANCE:
        return StopReason.BOX_CONVERGED
    limit = WARM_STEPS if state.is_warm else config.max_steps
    if config.strategy is Strategy.CONSENSUS and not state.is_warm and not is_cut:
        limit = min(limit, 2 + config.refine_steps)
    return StopReason.STEP_LIMIT if steps >= limit else StopReason.CONTINUES


def _step_trace(
    plan: StepPlan,
    boxes: Sequence[tuple[Box2D, ...]],
    used: Sequence[int | None],
    box: OrientedBox | None,
    points_in: int,
    points_kept: int,
    stop: StopReason,
) -> StepTrace:
    views = tuple(
        ViewTrace(
            axes=_matrix(view.axes),
            metres_per_px=view.metres_per_px,
            origin_m=(float(view.origin_m[0]), float(view.origin_m[1])),
            width_px=view.rgb.shape[1],
            height_px=view.rgb.shape[0],
            boxes=on_view,
            used=index,
        )
        for view, on_view, index in zip(plan.views, boxes, used, strict=True)
    )
    return StepTrace(plan.strategy, plan.fallback, views, box_trace(box), points_in, points_kept, stop)


def box_trace(box: OrientedBox | None) -> BoxTrace | None:
    """The box as plain numbers; None without a box."""
    if box is None:
        return None
    center, size = box.center_m, box.size_m
    return BoxTrace(
        (float(center[0]), float(center[1]), float(center[2])),
        _matrix(box.rotation),
        (float(size[0]), float(size[1]), float(size[2])),
    )


def _matrix(m: np.ndarray) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
    (a, b, c), (d, e, f), (g, h, i) = m.tolist()
    return (a, b, c), (d, e, f), (g, h, i)
