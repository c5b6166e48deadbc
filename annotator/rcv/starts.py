"""What an object starts from: its box in an earlier frame, or what a class-agnostic view detector needs.

**Warm starts.** The first steps of a recursion find an object's position and rotation. An earlier box gives both
approximately, so the object starts with views close to that box's axes, on the points around it. After the first step,
the result is checked: it must lie within the points that were used, be similar to the start box in size and rotation,
and agree with the image box. Otherwise the start box is dropped, and the object is processed without it.

**Class-agnostic detectors.** A detector that was not trained on the project's objects often fails in the view of a
whole frustum. So an object starts from rivals: boxes of its class's typical size, placed anywhere in the frustum, or
else crops along the depth. Both take several times as long as one start. A trained detector looks at the whole frustum
first, if the class has a typical size. If what it sees agrees with the image box, boxes are placed around that only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from annotator.geometry.iou import box_iou, iou_3d
from annotator.geometry.oriented_box import box_corners, canonical_box, contains, nearest_upright
from annotator.geometry.outline import box_on_image, edges_at_border
from annotator.geometry.projection import undistort_px
from annotator.rcv.config import MIN_POINTS, RcvConfig
from annotator.rcv.finish import image_agreement
from annotator.rcv.first_look import BORDER_PX, depth_crops, expected_outline, in_middle
from annotator.rcv.measure import UNDETERMINED
from annotator.rcv.pseudo_view import is_deep
from annotator.rcv.recursion import FrustumFacts, ObjectState
from annotator.rcv.typical_size import Evidence, distinct, place, place_near
from annotator.types import Box2D, Camera, OrientedBox, Proposal, StopReason

# Points of the middle of an image box that are kept to compare rivals.
MIDDLE_POINTS = 500
# Of a class with a typical size: the number of boxes to start from, their maximum IoU, the margin around each within
# which its points lie (share of its mean side), and the note in the trace.
STARTS, STARTS_IOU, START_ROOM = 3, 0.5, 0.1
TYPICAL_SIZE = "started from a box of the class's typical size"
# The same number after a trained detector's look at the frustum; these boxes share the hypotheses of the wide step.
STARTS_AFTER_LOOK = 2
# IoU on the image from which the box that such a look has found is used, and the note in the trace if it is not.
LOOK_AGREEMENT = 0.5
NOT_SEEN = "the view of the whole frustum shows no box that agrees with the image box"


def begin(camera: Camera, state: ObjectState, config: RcvConfig) -> list[ObjectState]:
    """The states of an object before its first step."""
    if not config.class_agnostic or state.stop is not StopReason.CONTINUES:
        return [state]
    # the views of a deep frustum show too little of an object
    if config.trained and not is_deep(state.cloud):
        evidence = _evidence(camera, state, config)
        if evidence is not None:
            return [replace(state, frustum=replace(_facts(camera, state), evidence=evidence), cold=state)]
    return start_rivals(camera, state, config)


def after_look(camera: Camera, cold: ObjectState, seen: Sequence[ObjectState], config: RcvConfig) -> list[ObjectState]:
    """The states with which an object continues after a trained detector's look at its frustum.

    Args:
        cold: the state before the look.
        seen: the states after it, one for each box.
    """
    agreements = [_agreement(camera, state, config) for state in seen]
    best = seen[int(np.argmax(agreements))]
    facts = best.frustum
    if max(agreements) < LOOK_AGREEMENT or best.box is None or facts is None or facts.evidence is None:
        return start_rivals(camera, replace(cold, notes=(*cold.notes, NOT_SEEN)), config)
    facts = replace(facts, placed=place_near(facts.evidence, best.box))
    started = _placed(replace(best, cold=None), facts, STARTS_AFTER_LOOK, config)
    return [replace(state, rivals=len(started)) for state in started]


def _agreement(camera: Camera, state: ObjectState, config: RcvConfig) -> float:
    """The IoU of the state's box with the image box; 0 without a box, or with too few points to go on."""
    if state.box is None or state.stop is StopReason.TOO_FEW_POINTS:
        return 0.0
    return image_agreement(camera, state, state.box, config)


def start_rivals(camera: Camera, state: ObjectState, config: RcvConfig) -> list[ObjectState]:
    """The rivals of an object: plausible boxes of the typical size of its class, or its frustum and crops of it."""
    facts, evidence = _facts(camera, state), _evidence(camera, state, config)
    if evidence is not None:
        return _placed(state, replace(facts, evidence=evidence, placed=place(evidence)), STARTS, config)
    crops = depth_crops(camera, state.cloud.xyz_m, state.image_box)
    whole = [] if crops and is_deep(state.cloud) else [replace(state, frustum=facts)]
    return whole + [replace(state, cloud=state.cloud.select(crop), frustum=facts) for crop in crops]


def _facts(camera: Camera, state: ObjectState) -> FrustumFacts:
    xyz_m = state.cloud.xyz_m
    middle = xyz_m[in_middle(camera, xyz_m, state.image_box)]
    return FrustumFacts(state.cloud, middle[:: max(len(middle) // MIDDLE_POINTS, 1)], camera)


def _evidence(camera: Camera, state: ObjectState, config: RcvConfig) -> Evidence | None:
    """What is known of an object of a class with a typical size; None for other classes."""
    typical = config.typical_size(state.image_box.label)
    if typical is None:
        return None
    outline = expected_outline(camera, state.image_box, config)
    return Evidence.of(camera, state.cloud.xyz_m, state.image_box, outline, typical, state.up)


def _placed(state: ObjectState, facts: FrustumFacts, count: int, config: RcvConfig) -> list[ObjectState]:
    """The states that start from the best placed boxes; without their points, the state that has only the frustum."""
    assert facts.placed is not None
    state = replace(state, frustum=facts, notes=(*state.notes, TYPICAL_SIZE))
    started = []
    for placed in distinct(facts.placed, count, STARTS_IOU):
        box = canonical_box(placed, state.up)
        cloud = facts.cloud.select(contains(box, facts.cloud.xyz_m, START_ROOM * float(box.size_m.mean())))
        if len(cloud) >= MIN_POINTS:
            started.append(replace(state, cloud=cloud, box=box, axes=box.rotation.T))
    return started or [state]


WARM_START = "warm start"
# Least IoU on the image of an image box with the start box, and with the result.
MIN_IMAGE_IOU = 0.3
# Margin around the start box within which points are used, share of its longest side.
ROOM = 0.2
# The result: least share of the first step's views that show the object; largest ratio between a side and that of the
# start box; least IoU with the start box with aligned centres, and the IoU above which one step is enough.
MIN_SEEN, MAX_SIZE_RATIO, MIN_IOU, SETTLED_IOU = 0.6, 1.5, 0.4, 0.8


@dataclass(frozen=True, eq=False)
class WarmStart:
    """The box of an object in an earlier frame, from which it starts in the current frame.

    Attributes:
        box: in the camera frame of the current frame.
    """

    label: str
    box: OrientedBox


def is_warm(proposal: Proposal) -> bool:
    """True if a proposal started from an earlier box that was not dropped."""
    return proposal.trace[0].fallback[:1] == (WARM_START,)


def match_warm_starts(
    camera: Camera, image_boxes: Sequence[Box2D], warm_starts: Sequence[WarmStart]
) -> list[OrientedBox | None]:
    """The start box of each image box, or None; each warm start is used at most once.

    The assignment maximises the total IoU of image boxes with the outlines (projected boxes) of warm starts of their
    class. Since objects move between frames, a start box is shifted so that its outline is centred on the image box.
    """
    outlines = [box_on_image(camera, start.box, start.label) for start in warm_starts]
    overlap = np.zeros((len(image_boxes), len(warm_starts)))
    for i, box in enumerate(image_boxes):
        for j, outline in enumerate(outlines):
            if outline is not None and outline.label == box.label:
                overlap[i, j] = box_iou(box, outline)
    overlap[overlap < MIN_IMAGE_IOU] = 0.0
    matched: list[OrientedBox | None] = [None] * len(image_boxes)
    for i, j in zip(*linear_sum_assignment(-overlap), strict=True):
        outline = outlines[j]
        if overlap[i, j] > 0 and outline is not None:
            matched[i] = _centred(camera, warm_starts[j].box, outline, image_boxes[i])
    return matched


def _centred(camera: Camera, box: OrientedBox, outline: Box2D, image_box: Box2D) -> OrientedBox:
    """The box shifted at constant depth so that its outline is centred on the image box."""
    if any(edges_at_border(camera, outline, BORDER_PX)) or any(edges_at_border(camera, image_box, BORDER_PX)):
        return box  # the centre of its visible part is not the centre of the object
    middles = [(b.x_min + b.x_max, b.y_min + b.y_max) for b in (outline, image_box)]
    rays = undistort_px(camera, np.array(middles) / 2)
    shift = (rays[1] - rays[0]) * box.center_m[2]
    if not np.isfinite(shift).all():
        return box
    return OrientedBox.from_parts(box.center_m + np.array([*shift, 0.0]), box.rotation, box.size_m)


def start_warm(cold: ObjectState, start_box: OrientedBox, config: RcvConfig) -> ObjectState:
    """The state before the first step of a warm start; `cold` with a note if few points are around the start box."""
    box = start_box if cold.up is None else nearest_upright(start_box, cold.up)[0]
    box = canonical_box(box, cold.up)
    cloud = cold.cloud.select(contains(box, cold.cloud.xyz_m, _margin_m(box)))
    if len(cloud) < MIN_POINTS:
        return _dropped(cold, f"too few points around the start box ({len(cloud)})")
    axes = box.rotation.T
    return replace(cold, cloud=cloud, axes=axes, box=box, notes=(WARM_START,), is_warm=True, cold=cold)


def _margin_m(box: OrientedBox) -> float:
    return ROOM * float(box.size_m.max())


def check_first_step(camera: Camera, before: ObjectState, after: ObjectState, config: RcvConfig) -> ObjectState:
    """The state with which an object continues after the first step of a warm start.

    This is `after`, stopped if the step hardly changed the box; or the state without a warm start if the result does
    not agree with the start box.
    """
    cold, start_box = before.cold, before.box
    assert cold is not None and start_box is not None
    reason, similarity = _disagreement(camera, start_box, after, config)
    if reason is not None:
        return _dropped(cold, reason)
    if after.stop is StopReason.CONTINUES and not after.is_cut and similarity >= SETTLED_IOU:
        last = replace(after.steps[-1], stop=StopReason.BOX_CONVERGED)
        after = replace(after, steps=(*after.steps[:-1], last), stop=last.stop)
    return replace(after, cold=None)


def _dropped(cold: ObjectState, reason: str) -> ObjectState:
    return replace(cold, notes=(f"{WARM_START}: {reason}",))


def _disagreement(
    camera: Camera, start_box: OrientedBox, after: ObjectState, config: RcvConfig
) -> tuple[str | None, float]:
    """Why the result does not match the start box, or None; and their IoU with aligned centres, 0 if not
    computed."""
    box = after.box
    if box is None or after.stop is StopReason.LOST:
        return "the views do not show the object", 0.0
    if (reason := _implausible(start_box, box, after)) is not None:
        return reason, 0.0
    similarity = iou_3d(start_box, OrientedBox.from_parts(start_box.center_m, box.rotation, box.size_m))
    if similarity < MIN_IOU:
        return f"with aligned centres, the IoU with the start box is {similarity:.2f}", similarity
    if (agreement := image_agreement(camera, after, box, config)) < MIN_IMAGE_IOU:
        return f"the IoU with the image box is {agreement:.2f}", similarity
    return None, similarity


def _implausible(start_box: OrientedBox, box: OrientedBox, after: ObjectState) -> str | None:
    """Why the first step of a warm start is rejected before its boxes are compared by IoU; None if it is not."""
    step = after.steps[-1]
    if after.stop is StopReason.TOO_FEW_POINTS:
        return f"too few points in the box ({len(after.cloud)})"
    seen_share = sum(view.used is not None for view in step.views) / len(step.views)
    if seen_share < MIN_SEEN:
        return f"only {seen_share:.0%} of the views show the object"
    if UNDETERMINED in step.fallback:
        return UNDETERMINED
    if not contains(start_box, box_corners(box), _margin_m(start_box)).all():
        return "the box extends beyond the points used around the start box"
    ratio = np.sort(box.size_m) / np.sort(start_box.size_m)
    if max(ratio.max(), 1 / ratio.min()) > MAX_SIZE_RATIO:
        return f"a side is {ratio[np.argmax(np.abs(np.log(ratio)))]:.2f} times that of the start box"
    return None
