"""Frames in, proposals out: all objects of all frames advance together, one detector batch a step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from annotator.geometry.frustum import in_frustum
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals, finish
from annotator.rcv.normals import needs_normals, with_normals
from annotator.rcv.recursion import ObjectState, absorb_step, plan_step, start
from annotator.types import Box2D, Detector, Frame, StopReason


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
    return [finish(frame, [s for s in done if s.frame_index == i], config) for i, frame in enumerate(frames)]


def _frustums(index: int, frame: Frame, boxes: Sequence[Box2D], config: RcvConfig) -> list[ObjectState]:
    boxes = [box for box in boxes if box.score >= config.min_image_score]
    masks = [in_frustum(frame.camera, frame.cloud.xyz_m, box) for box in boxes]
    cloud = frame.cloud
    if boxes and needs_normals(config):
        cloud = with_normals(frame, np.logical_or.reduce(masks), config)
    return [start(index, box, cloud.select(mask), frame.up, config) for box, mask in zip(boxes, masks, strict=True)]
