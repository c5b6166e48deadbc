"""The recursion of one object: plan a step's pseudo-views, take in what was detected on them, keep or stop.

A step is split in two, `plan_step` and `absorb_step`, so that the caller can draw the views of all objects of all
frames and send them through the detector in one batch between the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners, contains
from annotator.rcv import cross_view
from annotator.rcv.axes import camera_frame, find_axes, frame_angle
from annotator.rcv.canonical import canonical_box
from annotator.rcv.compute import NUMPY, Compute
from annotator.rcv.config import Orientation, RcvConfig, Strategy
from annotator.rcv.frustum_views import frustum_views
from annotator.rcv.hypotheses import beside_frames, near_frames, wide_frames
from annotator.rcv.interval_fit import Intervals
from annotator.rcv.measure import Measurement, any_cut, measure_consensus, measure_pair, measure_tightest
from annotator.types import (
    Box2D,
    BoxKind,
    BoxTrace,
    OrientedBox,
    PointCloud,
    PseudoView,
    Quality,
    StepTrace,
    StopReason,
    ViewTrace,
)


@dataclass(frozen=True, eq=False)
class ObjectState:
    """One object on its way through the recursion.

    Attributes:
        frame_index: position of its frame in the batch.
        image_box: the detection on the camera image.
        cloud: the points kept so far.
        up: unit vector against gravity for an upright box, None for a free one.
        axes: rows, the frame of the last step.
        box: the last step's box.
        measured: intervals of all steps of a consensus so far.
        is_cut: a detection of the last step touched its picture's border, so the object may go on beyond.
        view_score: mean score of the detections that made the last box.
        disagreement, last_change, kept_share: the quality signals of the last step.
        steps: the trace.
        stop: CONTINUES while the recursion runs.
        notes: what the first step's trace tells of how the object started.
        is_warm: it started from a seed, a box that it had a moment ago (`seeds`).
        without_seed: for an object that starts from a seed and has not been checked yet, its state without the seed.
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
    steps: tuple[StepTrace, ...] = ()
    stop: StopReason = StopReason.CONTINUES
    notes: tuple[str, ...] = ()
    is_warm: bool = False
    without_seed: ObjectState | None = None

    @property
    def is_first(self) -> bool:
        """True where nothing is known of the object but its frustum."""
        return not self.steps and self.box is None

    @property
    def quality(self) -> Quality:
        return Quality(self.disagreement, self.kept_share, self.last_change)


@dataclass(frozen=True, eq=False)
class StepPlan:
    """The pseudo-views that an object's next step needs: front and side of each frame in turn."""

    strategy: Strategy
    fallback: tuple[str, ...]
    frames: tuple[Float64[np.ndarray, "3 3"], ...]
    views: tuple[PseudoView, ...]


def held_direction(up: np.ndarray | None, config: RcvConfig) -> np.ndarray | None:
    """The direction that boxes are held at: unit (3,), or None where they turn freely."""
    if config.orientation is Orientation.FREE:
        return None
    # Where a recording does not know gravity, a camera held level is the best guess.
    return np.array([0.0, -1.0, 0.0]) if up is None else up


def start(
    frame_index: int, image_box: Box2D, cloud: PointCloud, up: np.ndarray | None, config: RcvConfig
) -> ObjectState:
    """The state before the first step; stopped at once where the frustum holds too few points."""
    held = held_direction(up, config)
    state = ObjectState(frame_index, image_box, cloud, held, camera_frame(held))
    if len(cloud) < config.min_points:
        step = StepTrace(Strategy.CAMERA, (), (), None, len(cloud), 0, StopReason.TOO_FEW_POINTS)
        return replace(state, steps=(step,), stop=StopReason.TOO_FEW_POINTS)
    return state


def plan_step(state: ObjectState, config: RcvConfig, compute: Compute = NUMPY) -> StepPlan:
    """Chooses the projection axes of the next step and draws its views, on the device of `compute`."""
    fallback: tuple[str, ...] = ()
    if state.is_first:
        strategy, frames = Strategy.CAMERA, [camera_frame(state.up)]
    elif config.strategy is Strategy.CONSENSUS:
        strategy = Strategy.CONSENSUS
        frames, fallback = _consensus_frames(state, config, compute)
    else:
        axes = find_axes(state.cloud, config.strategy, state.axes, state.up, config, compute.axial_kmeans)
        strategy, fallback, frames = axes.strategy, axes.fallback, [axes.frame]
    if not state.steps:
        fallback = state.notes + fallback
    views: Sequence[PseudoView]
    if state.is_first:
        views = frustum_views(state.cloud, frames[0], config, compute)
    else:
        show = None if state.box is None else box_corners(shown_box(state.box, state.is_cut, config))
        views = compute.render_pairs(state.cloud, frames, config.view, show)
    return StepPlan(strategy, fallback, tuple(frames), tuple(views))


def shown_box(box: OrientedBox, is_cut: bool, config: RcvConfig) -> OrientedBox:
    """What the next pictures must show: the box, or, where it was cut off, room around it."""
    return OrientedBox(box.T_camera_box, box.size_m * (config.cut_room if is_cut else 1.0))


def cut_cloud(cloud: PointCloud, box: OrientedBox, views: Sequence[PseudoView], config: RcvConfig) -> PointCloud:
    """What a step keeps: the points in its box, and those as near to it as its views may have blurred."""
    return cloud.select(contains(box, cloud.xyz_m, cross_view.cut_margin_m(box, views, config)))


def _consensus_frames(
    state: ObjectState, config: RcvConfig, compute: Compute
) -> tuple[list[Float64[np.ndarray, "3 3"]], tuple[str, ...]]:
    """The step's hypotheses, and what was tried for them in vain."""
    if state.box is None or (len(state.steps) == 1 and not state.is_warm):
        return wide_frames(state.up, config), ()
    if state.is_warm:
        frames = beside_frames(state.box.rotation, state.up, len(state.steps), config)
    else:
        frames = near_frames(state.box.rotation, state.up, config)
    if config.box_kind is not BoxKind.SILHOUETTE:
        return frames, ()
    reference = camera_frame(state.up)
    normals = find_axes(state.cloud, Strategy.NORMALS, reference, state.up, config, compute.axial_kmeans)
    return [*frames, normals.frame], normals.fallback


def absorb_step(
    state: ObjectState, plan: StepPlan, detections: Sequence[Sequence[Box2D]], config: RcvConfig
) -> list[ObjectState]:
    """The object's state after a step; several states where the first step found several objects.

    Args:
        detections: per view of the plan, best first, any class; others than the frustum's are ignored.
    """
    boxes = [
        tuple(b for b in found if b.label == state.image_box.label and b.score >= config.min_view_score)
        for found in detections
    ]
    if state.is_first:
        return _absorb_first(state, plan, boxes, config)
    if plan.strategy is not Strategy.CONSENSUS:
        measured = measure_pair(plan.frames[0], plan.views, boxes, state.box, config)
    elif config.box_kind is BoxKind.SILHOUETTE:
        measured = measure_tightest(plan.frames, plan.views, boxes, state.box, state.cloud, config)
    else:
        seed = state.box if state.is_warm and not state.steps else None
        measured = measure_consensus(plan.frames, plan.views, boxes, state.box, state.measured, state.up, config, seed)
    return [_advance(state, plan, boxes, measured, config)]


def _absorb_first(
    state: ObjectState, plan: StepPlan, boxes: list[tuple[Box2D, ...]], config: RcvConfig
) -> list[ObjectState]:
    frame, views = plan.frames[0], (plan.views[0], plan.views[1])
    pairs = cross_view.pair_all(frame, views, boxes[0], boxes[1], state.cloud, config)
    if not pairs:
        return [_advance(state, plan, boxes, None, config)]
    results = []
    for pair in pairs:
        used = (pair.front, pair.side)
        # It finds the object among all that the frustum holds. Its pictures show the object small, and their edges are
        # off by three times as much as later ones', always to one side: a consensus is better without them.
        measured = Measurement(
            pair.box, frame, pair.disagreement, pair.score, used, cut=any_cut(views, boxes, used, config)
        )
        results.append(_advance(state, plan, boxes, measured, config))
    return results


def _advance(
    state: ObjectState,
    plan: StepPlan,
    boxes: list[tuple[Box2D, ...]],
    measured: Measurement | None,
    config: RcvConfig,
) -> ObjectState:
    """Cuts the cloud with the step's box, decides whether to go on, and writes the trace."""
    n = len(state.cloud)
    if measured is None:
        step = _step_trace(plan, boxes, (None,) * len(boxes), None, n, 0, StopReason.LOST)
        return replace(state, steps=(*state.steps, step), stop=StopReason.LOST)
    box = canonical_box(measured.box, state.up)
    cloud = cut_cloud(state.cloud, box, plan.views, config)
    inside = int(np.count_nonzero(contains(box, cloud.xyz_m)))
    change = 1.0 if state.box is None else 1.0 - iou_3d(state.box, box)
    turned = np.inf if state.box is None else frame_angle(measured.frame, state.axes)
    stop = _stop(state, len(cloud), turned, change, measured.cut, config)
    told = replace(plan, fallback=plan.fallback + measured.fallback)
    step = _step_trace(told, boxes, measured.used, box, n, len(cloud), stop)
    return replace(
        state,
        cloud=cloud,
        axes=measured.frame,
        box=box,
        measured=measured.intervals,
        is_cut=measured.cut,
        view_score=measured.score,
        disagreement=measured.disagreement,
        last_change=change,
        kept_share=inside / n,
        steps=(*state.steps, step),
        stop=stop,
    )


def _stop(
    state: ObjectState, points: int, turned_rad: float, change: float, is_cut: bool, config: RcvConfig
) -> StopReason:
    if points < config.min_points:
        return StopReason.TOO_FEW_POINTS
    steps = len(state.steps) + 1
    # The first step's axes are the camera's, whatever the object: a fit that happens to agree with them has not
    # converged yet. What a picture cut off is looked at once more in a larger one.
    first = 2 if config.strategy is Strategy.CONSENSUS and not state.is_warm else 1
    if steps > first and not is_cut and turned_rad < config.axes_tolerance_rad:
        return StopReason.AXES_CONVERGED
    if steps > first and not is_cut and change < config.box_tolerance:
        return StopReason.BOX_CONVERGED
    limit = config.warm.max_steps if state.is_warm else config.max_steps
    if config.strategy is Strategy.CONSENSUS and not state.is_warm and not is_cut:
        limit = min(limit, 2 + config.consensus.refine_steps)
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
            boxes=found,
            used=index,
        )
        for view, found, index in zip(plan.views, boxes, used, strict=True)
    )
    return StepTrace(plan.strategy, plan.fallback, views, box_trace(box), points_in, points_kept, stop)


def box_trace(box: OrientedBox | None) -> BoxTrace | None:
    """A box as plain numbers."""
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
