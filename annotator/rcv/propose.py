"""Frames in, proposals out: all objects of all frames advance together, one detector batch a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from annotator.geometry.fit import aligned_box
from annotator.geometry.frustum import in_frustum
from annotator.geometry.nms import nms_3d
from annotator.rcv.axes import camera_frame
from annotator.rcv.canonical import canonical_box
from annotator.rcv.config import RcvConfig
from annotator.rcv.normals import needs_normals, with_normals
from annotator.rcv.recursion import ObjectState, absorb_step, plan_step, start
from annotator.types import Box2D, Detector, Frame, LostObject, OrientedBox, Proposal, StopReason


@dataclass(frozen=True, eq=False)
class FrameProposals:
    """What one frame gave: boxes, best first, and the frustums that led to none."""

    key: str
    proposals: tuple[Proposal, ...]
    lost: tuple[LostObject, ...]


def propose(
    frames: Sequence[Frame], image_detector: Detector, view_detector: Detector, config: RcvConfig
) -> list[FrameProposals]:
    """Recursive Cross-View on several frames at once.

    The image detector runs once on all images; then every step runs the view detector once, on the pseudo-views of
    all objects that are still in recursion.

    Returns:
        one result a frame, in the order given.
    """
    image_boxes = image_detector.detect(frames)
    return propose_from_boxes(frames, image_boxes, view_detector, config)


def propose_from_boxes(
    frames: Sequence[Frame],
    image_boxes: Sequence[Sequence[Box2D]],
    view_detector: Detector,
    config: RcvConfig,
) -> list[FrameProposals]:
    """The same from given 2D boxes on the images, one list a frame."""
    active: list[ObjectState] = []
    for index, (frame, boxes) in enumerate(zip(frames, image_boxes, strict=True)):
        active.extend(_frustums(index, frame, boxes, config))
    done = [state for state in active if state.stop is not StopReason.CONTINUES]
    active = [state for state in active if state.stop is StopReason.CONTINUES]
    while active:
        plans = [plan_step(state, config) for state in active]
        found = iter(view_detector.detect([view for plan in plans for view in plan.views]))
        advanced: list[ObjectState] = []
        for state, plan in zip(active, plans, strict=True):
            advanced.extend(absorb_step(state, plan, [next(found) for _ in plan.views], config))
        done.extend(state for state in advanced if state.stop is not StopReason.CONTINUES)
        active = [state for state in advanced if state.stop is StopReason.CONTINUES]
    return [_finish(i, frame, [s for s in done if s.frame_index == i], config) for i, frame in enumerate(frames)]


def _frustums(index: int, frame: Frame, boxes: Sequence[Box2D], config: RcvConfig) -> list[ObjectState]:
    boxes = [box for box in boxes if box.score >= config.min_image_score]
    masks = [in_frustum(frame.camera, frame.cloud.xyz_m, box) for box in boxes]
    cloud = frame.cloud
    if boxes and needs_normals(config):
        cloud = with_normals(frame, np.logical_or.reduce(masks), config)
    return [start(index, box, cloud.select(mask), frame.up, config) for box, mask in zip(boxes, masks, strict=True)]


def _coarse_box(state: ObjectState, config: RcvConfig) -> OrientedBox | None:
    """The last box of an object that got lost, or the one around its frustum's points (RCV paper, section II.B)."""
    if state.box is not None:
        return state.box
    if len(state.cloud) < config.min_points:
        return None
    return canonical_box(aligned_box(state.cloud.xyz_m, camera_frame(state.up).T), state.up)


def _finish(index: int, frame: Frame, states: list[ObjectState], config: RcvConfig) -> FrameProposals:
    proposals: list[Proposal] = []
    lost: list[LostObject] = []
    for state in states:
        box = state.box if state.stop not in (StopReason.LOST, StopReason.TOO_FEW_POINTS) else None
        if box is None and config.coarse_box:
            box = _coarse_box(state, config)
        if box is not None:
            # No view has confirmed the box around a frustum: it ranks below all that one has.
            score = float(np.sqrt(state.image_box.score * (state.view_score or config.min_view_score)))
            proposals.append(Proposal(state.image_box.label, score, box, state.image_box, state.steps, state.quality))
        else:
            lost.append(LostObject(state.image_box.label, state.image_box, state.steps))
    keep = nms_3d(
        [p.box for p in proposals], np.array([p.score for p in proposals]), [p.label for p in proposals], config.nms_iou
    )
    return FrameProposals(frame.key, tuple(proposals[int(i)] for i in keep), tuple(lost))
