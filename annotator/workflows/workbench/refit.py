"""Fits a 3D box, either to the boxes drawn of an object or starting from an existing 3D box.

An existing box is refitted by Recursive Cross-View on the points in and around it, starting from its axes. Without a
detector for its class, the sides move to the points inside and the rotation stays.

The rotation stays because the tightest rotation is worse: a sensor sees one side of an object only. Measured on
generated recordings with boxes perturbed by about 10 degrees and 5 % of their size, mean IoU to the true box:

    before -> tightest box around the points | sides moved along the box's axes
    people 0.68 -> 0.66 | 0.70
    hands  0.68 -> 0.50 | 0.66
    with a detector that is 1 % off: people 0.71 -> 0.97, hands 0.69 -> 0.92

Axes keep their names (x, y, z), so the heading stays as the operator set it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

from annotator.geometry.ground import ground_axes
from annotator.geometry.oriented_box import aligned_box, box_corners, canonical_box, contains, tightest_box
from annotator.geometry.outline import NEAR_M, box_on_image, visible_edges
from annotator.geometry.projection import in_frustum, project, thin, undistort_px
from annotator.geometry.transforms import unit
from annotator.rcv.axes import with_axes_like
from annotator.rcv.config import MIN_POINTS, RcvConfig, typical_size
from annotator.rcv.first_look import expected_outline, image_planes
from annotator.rcv.interval_fit import Intervals, fit_box
from annotator.rcv.known_objects import Span, cut_out
from annotator.rcv.measure import traced_intervals
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.recursion import ObjectState, absorb_step, box_trace, held_direction, plan_step
from annotator.rcv.rotations import yaw_grid
from annotator.rcv.starts import TYPICAL_SIZE
from annotator.types import (
    Box2D,
    BoxKind,
    Detector,
    Frame,
    OrientedBox,
    PointCloud,
    Proposal,
    Quality,
    StepTrace,
    StopReason,
)
from annotator.workflows.workbench.frame_cache import OpenFrame

# The points inside the box enlarged by this factor are the cloud of the recursion.
SEARCH_FACTOR = 1.3
# The recursion starts as if this many steps had led to the given box.
STEPS_BEFORE = 2
NOT_DETECTED = "the detector found no object in this box"
# Points in the frustum of a drawn box, at most: a view shows no more of them, and the operator waits.
MOST_POINTS = 16_384
# Margin around a drawn box within which points belong to the object, share of the box's mean side.
KNOWN_MARGIN = 0.03
# Expected error of a drawn edge, share of that of the best detected one.
KNOWN_DOUBT = 0.2
# A box is placed by its size alone in so many steps: each corrects its distance and its direction by what it covers.
PLACING_STEPS = 12
# Farther away, metres, or farther aside than so many times the distance, nothing is placed.
FURTHEST_M, MOST_ASIDE = 1e4, 50.0
# Expected error of the faces of a box that was placed by the typical size of its class, share of its mean side.
PLACED_DOUBT = 0.1


@dataclass(frozen=True, eq=False)
class FoundBox:
    """A fitted box: of an object that was drawn on the image, or in place of a box that there was.

    Attributes:
        box: None if the object was not found.
        outline: (k, 2, 2) its visible edges on the image, pixels.
        score, quality: of the recursion; None if it found nothing or was not used. A refitted box has no score.
        note: why the object was not found, or the recursion not used; or None.
        too_few_points: no box can be measured, nor views be drawn on: too few points lie in the box on the image. `box`
            is then one that was placed by its size alone, if the class has one.
    """

    box: OrientedBox | None
    outline: Float64[np.ndarray, "k 2 2"]
    points: int
    score: float | None
    quality: Quality | None
    note: str | None
    too_few_points: bool = False


def refit(
    opened: OpenFrame,
    box: OrientedBox,
    label: str,
    config: RcvConfig,
    detector: Detector | None,
    problem: str | None = None,
) -> FoundBox:
    """Refits an existing box; returns the given one if that is not possible.

    Args:
        config: with the orientation for the frame and the box kind of the detector.
        problem: why the detector could not be loaded, if it could not.
    """
    reason = _why_no_detector(detector, label, config, problem)
    if reason is not None or detector is None:
        return _from_points(opened, box, config, reason or "")
    state = _recurse(opened, box, label, config, detector)
    if state is None or state.box is None:
        return _from_points(opened, box, config, NOT_DETECTED)
    return _result(opened, with_axes_like(state.box, box), state.quality, None)


def find_box(
    opened: OpenFrame,
    image_box: Box2D,
    config: RcvConfig,
    detector: Detector | None,
    problem: str | None = None,
    known: Sequence[Span] = (),
) -> FoundBox:
    """Finds the 3D box of an object from the boxes drawn of it, by Recursive Cross-View; done once for the same boxes.

    Args:
        image_box: has the object's class.
        config: with the orientation for the frame and the box kind of the detector.
        problem: why the detector could not be loaded, if it could not.
        known: the axes of views, and what the boxes drawn on them span.
    """
    if _has_too_few(opened.frame, image_box, config):
        return not_found(f"fewer than {MIN_POINTS} points lie in this box", too_few_points=True)
    reason = _why_no_detector(detector, image_box.label, config, problem)
    if reason is not None or detector is None:
        return not_found(reason or "")
    spans = tuple((axes.tobytes(), span_m.tobytes()) for axes, span_m in known)
    key = ("found", image_box.label, image_box.xyxy, spans, config, detector.fingerprint)
    return opened.once(key, lambda: _found(opened, image_box, config, detector, known))


def place_box(opened: OpenFrame, image_box: Box2D, config: RcvConfig) -> FoundBox:
    """Places a box of the class's typical size where it appears as high as a box drawn around hardly any points.

    It stands upright, and looks along the line of sight, or across it if the drawn box is that wide.
    """
    frame, known = opened.frame, (*config.typical_sizes, *config.reviewed_sizes)
    typical, why = typical_size(image_box.label, known), f"fewer than {MIN_POINTS} points lie in this box"
    if typical is None:
        nothing = f"{why}, and no reviewed box tells how large a {image_box.label} is"
        return not_found(nothing, too_few_points=True)
    camera, size_m = frame.camera, np.array(typical.size_m)
    up = np.array([0.0, -1.0, 0.0]) if frame.up is None else frame.up
    drawn_px = np.reshape(image_box.xyxy, (2, 2))
    (ray,) = np.column_stack([undistort_px(camera, drawn_px.mean(axis=0)[None]), np.ones(1)])
    away = unit(ray - (ray @ up) * up)
    left = np.cross(up, away)
    width_px, height_px = drawn_px[1] - drawn_px[0]
    sides_m = size_m[1::-1]  # across the line of sight if the box looks along it, and if it looks to the left
    is_along = np.abs(np.log(sides_m / size_m[2]) - np.log(width_px / height_px)).argmin() == 0
    rotation = np.column_stack([away, left, up] if is_along else [left, -away, up])
    middle_px, depth_m = drawn_px.mean(axis=0), camera.fy * size_m[2] / height_px
    for _ in range(PLACING_STEPS):
        (xy,) = undistort_px(camera, middle_px[None])
        if not (np.isfinite(xy).all() and NEAR_M < depth_m < FURTHEST_M and np.abs(xy).max() < MOST_ASIDE):
            return not_found(why, too_few_points=True)
        box = OrientedBox.from_parts(np.array([*xy, 1.0]) * depth_m, rotation, size_m)
        seen_px = project(camera, box_corners(box))
        low, high = seen_px.min(axis=0), seen_px.max(axis=0)
        if not np.isfinite(seen_px).all():
            return not_found(why, too_few_points=True)
        middle_px = middle_px + drawn_px.mean(axis=0) - (low + high) / 2
        depth_m *= float((high - low)[1] / height_px)
    return replace(_result(opened, box, None, f"{why}: placed by its size alone"), too_few_points=True)


# Of an object that is placed on the ground: what is higher above it belongs to an object, metres; the ground is the
# lowest of the points around, but for stray ones; so many points turn the box, and are measured by the detector.
ABOVE_GROUND_M, GROUND_PERCENT, AROUND_M, LEAST_STANDING = 0.2, 5.0, 3.0, 30


def place_on_ground(
    opened: OpenFrame, point_m: Float64[np.ndarray, "3"], label: str, config: RcvConfig, detector: Detector | None
) -> FoundBox:
    """Places a box of the class's typical size on the ground below or above a point, turned like what stands there.

    With enough points in it, it is fitted to them by the detector. Without points around, the ground is as far below
    the camera as the box is high.
    """
    frame, known = opened.frame, (*config.typical_sizes, *config.reviewed_sizes)
    typical = typical_size(label, known)
    if typical is None:
        why = f"no reviewed box tells how large a {label} is: draw one on the image first"
        return not_found(why, too_few_points=True)
    size_m = np.array(typical.size_m)
    up = np.array([0.0, -1.0, 0.0]) if frame.up is None else frame.up
    level = (frame.cloud.xyz_m - point_m) @ (np.eye(3) - np.outer(up, up))
    height_m = frame.cloud.xyz_m @ up
    distance_m = np.linalg.norm(level, axis=1)
    near = distance_m < max(AROUND_M, float(size_m[0]))
    ground_m = float(np.percentile(height_m[near], GROUND_PERCENT)) if near.any() else -float(size_m[2])
    stands = near & (height_m > ground_m + ABOVE_GROUND_M) & (height_m < ground_m + size_m[2] + ABOVE_GROUND_M)
    stands &= distance_m < size_m[0] / 2 + ABOVE_GROUND_M
    ahead = point_m - (point_m @ up) * up
    if stands.sum() >= LEAST_STANDING:
        ahead = np.linalg.svd(level[stands] - level[stands].mean(axis=0), full_matrices=False)[2][0]
        ahead = ahead - (ahead @ up) * up
    heading = unit(ahead) if np.linalg.norm(ahead) > 1e-6 else ground_axes(up)[0]
    rotation = np.column_stack([heading, np.cross(up, heading), up])
    center_m = point_m - (point_m @ up) * up + (ground_m + size_m[2] / 2) * up
    box = OrientedBox.from_parts(center_m, rotation, size_m)
    placed = replace(_result(opened, box, None, None), too_few_points=True)
    if placed.points < LEAST_STANDING or _why_no_detector(detector, label, config, None) is not None:
        return placed
    return refit(opened, box, label, config, detector)


# What stands on the ground and is in no box: points this far outside a box belong to it, metres; what fills cells side
# by side, so many times as wide as the ground is thick, is one thing if it has so many points. What is so many times
# longer or higher than the largest class is a building, and no object; of unknown classes, this long, metres.
RIM_M, STANDING_CELLS, LEAST_OF_THING, BUILDING, LONGEST_M = 0.1, 2.0, 20, 1.5, 12.0


def next_unlabelled(
    opened: OpenFrame, boxes: Iterable[OrientedBox], beyond_m: float, classes: Iterable[str], config: RcvConfig
) -> tuple[FoundBox, str | None, float]:
    """The nearest thing in the camera's sight that stands on the ground in no box, its class, and its distance, metres.

    Args:
        boxes: what is labelled, camera frame.
        beyond_m: only what is farther away.
        classes: those of the project: it gets the one whose typical size is the most like what is seen, if any has one.
    """
    frame, ground, known = opened.frame, opened.ground, (*config.typical_sizes, *config.reviewed_sizes)
    typical = {name: typical_size(name, known) for name in classes}
    # length, width, height
    sizes_m = {name: _ordered(np.array(size.size_m)) for name, size in typical.items() if size is not None}
    every_m = np.array([sizes_m.get(name, np.full(3, LONGEST_M)) for name in typical])
    most_m, _, highest_m = BUILDING * every_m.max(axis=0, initial=0.0)
    xyz_m, above_m = frame.cloud.xyz_m, ground.above_m(frame.cloud.xyz_m)
    stands = (above_m > ground.thickness_m) & (above_m < highest_m)
    for each in boxes:
        stands &= ~contains(each, xyz_m, RIM_M)
    level = xyz_m @ ground.axes[:2].T
    stands &= ((level >= ground.low_m) & (level < ground.high_m)).all(axis=1)
    cells = ((level[stands] - ground.low_m) / (STANDING_CELLS * ground.thickness_m)).astype(np.int64)
    filled = np.zeros(cells.max(axis=0, initial=0) + 1, bool)
    filled[tuple(cells.T)] = True
    thing = ndimage.label(filled, np.ones((3, 3)))[0][tuple(cells.T)]
    order = np.flatnonzero(stands)[np.argsort(thing, kind="stable")]
    for points in sorted(
        np.split(order, np.cumsum(np.bincount(thing))[:-1]) if len(order) else (),
        key=lambda points: float(np.linalg.norm(xyz_m[points].mean(axis=0))) if len(points) else 0.0,
    ):
        if len(points) < LEAST_OF_THING or np.ptp(level[points], axis=0).max() > most_m:
            continue
        distance_m = float(np.linalg.norm(xyz_m[points].mean(axis=0)))
        # down to the ground
        feet_m = xyz_m[points] - above_m[points, None] * ground.axes[2]
        both_m = np.concatenate([xyz_m[points], feet_m]).astype(np.float64)
        box = canonical_box(tightest_box(both_m, yaw_grid(ground.axes[2]), ground.axes[2]), ground.axes[2])
        (u, v) = project(frame.camera, box.center_m[None])[0]
        if distance_m <= beyond_m or not (0 <= u < frame.camera.width_px and 0 <= v < frame.camera.height_px):
            continue
        unlike = {name: _unlike(box, size_m) for name, size_m in sizes_m.items()}
        label = min(unlike, key=lambda name: float(unlike[name].min()), default=None)
        if label is not None:
            box = canonical_box(_grown(box, sizes_m[label], int(unlike[label].argmin())), ground.axes[2])
        return _result(opened, box, None, None), label, distance_m
    return not_found("nothing else stands here that nobody has labelled"), None, beyond_m


def _ordered(size_m: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    return np.array([size_m[:2].max(), size_m[:2].min(), size_m[2]])


def _unlike(box: OrientedBox, size_m: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "2"]:
    """How much the longer side that is seen differs from a length, and from a width; each with the height."""
    return np.abs(np.log(box.size_m[0] / size_m[:2])) + abs(np.log(box.size_m[2] / size_m[2]))


def _grown(box: OrientedBox, size_m: Float64[np.ndarray, "3"], seen: int) -> OrientedBox:
    """A box around what is seen, as long and wide as its class: the hidden sides are those away from the camera.

    Args:
        seen: 0 if its longer side is the object's length, 1 if it is the width.
    """
    more_m = np.maximum(np.array([size_m[seen], size_m[1 - seen], 0.0]) - box.size_m, 0.0)
    away = np.sign(box.center_m @ box.rotation)
    return OrientedBox.from_parts(box.center_m + box.rotation @ (away * more_m / 2), box.rotation, box.size_m + more_m)


def _found(
    opened: OpenFrame, image_box: Box2D, config: RcvConfig, detector: Detector, known: Sequence[Span]
) -> FoundBox:
    frame = opened.with_normals
    if known:
        # the object lies within the drawn boxes
        margins_m = [KNOWN_MARGIN * float(np.diff(span_m).mean()) for _, span_m in known]
        inside = cut_out(frame, image_box, list(zip(known, margins_m, strict=True)))
        frame = replace(frame, cloud=frame.cloud.select(inside))
    frame = _thinned(frame, image_box)
    # an object lost during the recursion has no box
    strict = config.model_copy(update={"coarse_box": False})
    # a drawn box is certain
    drawn = replace(image_box, score=1.0)
    (result,) = propose_from_boxes([frame], [[drawn]], detector, strict)
    if not result.proposals:
        too_few = _has_too_few(frame, image_box, config)
        return not_found(f"fewer than {MIN_POINTS} points lie in these boxes" if too_few else NOT_DETECTED)
    best = max(result.proposals, key=lambda each: each.score * (each.quality.image_agreement or 0.0))
    box = best.box
    if known and config.box_kind is BoxKind.BOX:
        box = _through_known(frame, best, known, config)
    return _result(opened, box, best.quality, None, best.score)


def _thinned(frame: Frame, image_box: Box2D) -> Frame:
    """Returns the frame with `MOST_POINTS` points of a frustum that has more of them, and with no others."""
    inside = np.flatnonzero(in_frustum(frame.camera, frame.cloud.xyz_m, image_box))
    kept = thin(len(inside), MOST_POINTS)
    return frame if kept is None else replace(frame, cloud=frame.cloud.select(inside[kept]))


def _through_known(frame: Frame, found: Proposal, known: Sequence[Span], config: RcvConfig) -> OrientedBox:
    """Fits a proposal again, with the spans of drawn boxes beside what was detected."""
    is_placed = any(TYPICAL_SIZE in step.fallback for step in found.trace)
    detected = _spans_of(found.box) if is_placed else traced_intervals(found.trace[1:])
    if detected is None:
        return found.box
    directions = np.concatenate([axes[:2] for axes, _ in known])
    ends_m = np.concatenate([span_m for _, span_m in known])
    sigma_m = np.full(ends_m.shape, KNOWN_DOUBT * float(detected.sigma_m.min()))
    parts = [detected, Intervals(directions, ends_m, sigma_m)]
    depth_m = max(float(found.box.center_m[2]), NEAR_M)
    if config.class_agnostic:
        outline = expected_outline(frame.camera, found.image_box, config)
        planes = image_planes(frame.camera, outline, depth_m)
        parts += [] if planes is None else [planes]
    up = held_direction(frame.up, config)
    fit = fit_box(Intervals.concatenate(parts), up, found.box.rotation)
    if fit is None:
        return found.box
    return canonical_box(OrientedBox.from_parts(fit.center_m, fit.rotation, fit.size_m), up)


def _spans_of(box: OrientedBox) -> Intervals:
    """A box as the intervals along its axes, with the errors of a box of typical size."""
    axes, half = box.rotation.T, box.size_m / 2
    ends = (axes @ box.center_m)[:, None] + np.stack([-half, half], axis=1)
    return Intervals(axes, ends, np.full((3, 2), PLACED_DOUBT * float(box.size_m.mean())))


def _has_too_few(frame: Frame, image_box: Box2D, config: RcvConfig) -> bool:
    return int(in_frustum(frame.camera, frame.cloud.xyz_m, image_box).sum()) < MIN_POINTS


def not_found(reason: str, *, too_few_points: bool = False) -> FoundBox:
    """Returns no box, with the reason."""
    return FoundBox(None, np.zeros((0, 2, 2)), 0, None, None, reason, too_few_points)


def _why_no_detector(detector: Detector | None, label: str, config: RcvConfig, problem: str | None) -> str | None:
    """Returns why no detector can be used for this class, or None."""
    if detector is None:
        return "there is no pseudo-view detector yet" if problem is None else f"no pseudo-view detector: {problem}"
    return (
        None
        if config.class_agnostic or label in detector.labels
        else f"the pseudo-view detector was not trained on {label}"
    )


def _recurse(
    opened: OpenFrame, box: OrientedBox, label: str, config: RcvConfig, detector: Detector
) -> ObjectState | None:
    inside = opened.inside(OrientedBox(box.pose, box.size_m * SEARCH_FACTOR))
    cloud = opened.with_normals.cloud.select(np.sort(inside))
    if len(cloud) < MIN_POINTS:
        return None
    state = _state_of(opened, box, label, cloud, config)
    steps = max(config.max_steps, STEPS_BEFORE + 1)
    limited = config.model_copy(update={"max_steps": steps, "refine_steps": steps - STEPS_BEFORE})
    while state.stop is StopReason.CONTINUES:
        plan = plan_step(state, limited)
        state = absorb_step(state, plan, detector.detect(plan.views), limited)[0]
    return None if state.stop in (StopReason.LOST, StopReason.TOO_FEW_POINTS) else state


def _state_of(opened: OpenFrame, box: OrientedBox, label: str, cloud: PointCloud, config: RcvConfig) -> ObjectState:
    """Returns the state of a recursion that has led to the given box."""
    camera = opened.frame.camera
    image_box = box_on_image(camera, box, label) or Box2D(
        label, -0.5, -0.5, camera.width_px - 0.5, camera.height_px - 0.5
    )
    step = StepTrace("given", (), (), box_trace(box), len(cloud), len(cloud), StopReason.CONTINUES)
    up = held_direction(opened.frame.up, config)
    return ObjectState(0, image_box, cloud, up, box.rotation.T, box, steps=(step,) * STEPS_BEFORE)


def _from_points(opened: OpenFrame, box: OrientedBox, config: RcvConfig, reason: str) -> FoundBox:
    xyz_m = opened.frame.cloud.xyz_m[opened.inside(box)]
    if len(xyz_m) < MIN_POINTS:
        note = f"{reason}, and the box is unchanged: it contains too few points ({len(xyz_m)})"
        return _result(opened, box, None, note)
    note = f"{reason}: the sides were moved to the {len(xyz_m)} points inside, the rotation is unchanged"
    return _result(opened, aligned_box(xyz_m, box.rotation), None, note)


def _result(
    opened: OpenFrame, box: OrientedBox, quality: Quality | None, note: str | None, score: float | None = None
) -> FoundBox:
    return FoundBox(box, visible_edges(opened.frame.camera, [box])[0], opened.points_in(box), score, quality, note)
