"""Recursive Cross-View on frames: all objects of all frames advance together, one detector batch per step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from annotator.geometry.projection import in_frustums
from annotator.rcv.axes import needs_normals, with_normals
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals, finish
from annotator.rcv.recursion import ObjectState, StepPlan, absorb_step, plan_step, start
from annotator.rcv.starts import WarmStart, after_look, begin, check_first_step, match_warm_starts, start_warm
from annotator.types import Box2D, Detector, Frame, StopReason


def propose(
    frames: Sequence[Frame],
    image_detector: Detector,
    view_detector: Detector,
    config: RcvConfig,
    warm_starts: Sequence[Sequence[WarmStart]] | None = None,
) -> list[FrameProposals]:
    """Recursive Cross-View on several frames at once.

    The image detector runs once on all images. Then the view detector runs once per step, on the pseudo-views of all
    objects that are still in recursion.

    Args:
        warm_starts: for each frame, the boxes of its objects in an earlier frame. An object starts from the box that
            matches its image box (`annotator.rcv.starts`).
    """
    image_boxes = image_detector.detect(frames)
    return propose_from_boxes(frames, image_boxes, view_detector, config, warm_starts)


def propose_from_boxes(
    frames: Sequence[Frame],
    image_boxes: Sequence[Sequence[Box2D]],
    view_detector: Detector,
    config: RcvConfig,
    warm_starts: Sequence[Sequence[WarmStart]] | None = None,
) -> list[FrameProposals]:
    """As `propose`, from given 2D boxes on the images, one list per frame."""
    active: list[ObjectState] = []
    starts_of_frames = warm_starts if warm_starts is not None else [()] * len(frames)
    for index, (frame, boxes, starts) in enumerate(zip(frames, image_boxes, starts_of_frames, strict=True)):
        active.extend(_initial_states(index, frame, boxes, starts, config))
    done = [state for state in active if state.stop is not StopReason.CONTINUES]
    active = [state for state in active if state.stop is StopReason.CONTINUES]
    while active:
        plans = [plan_step(state, config) for state in active]
        on_views = iter(view_detector.detect([view for plan in plans for view in plan.views]))
        advanced: list[ObjectState] = []
        for state, plan in zip(active, plans, strict=True):
            detections = [next(on_views) for _ in plan.views]
            advanced.extend(_advanced(frames[state.frame_index], state, plan, detections, config))
        done.extend(state for state in advanced if state.stop is not StopReason.CONTINUES)
        active = [state for state in advanced if state.stop is StopReason.CONTINUES]
    return [finish(frame, [s for s in done if s.frame_index == i], config) for i, frame in enumerate(frames)]


def _advanced(
    frame: Frame, state: ObjectState, plan: StepPlan, detections: Sequence[Sequence[Box2D]], config: RcvConfig
) -> list[ObjectState]:
    advanced = absorb_step(state, plan, detections, config)
    if state.cold is None:
        return advanced
    if not state.is_warm:
        return after_look(frame.camera, state.cold, advanced, config)
    checked = [check_first_step(frame.camera, state, after, config) for after in advanced]
    return [
        begun
        for after in checked
        # a dropped start box leaves the state before any step
        for begun in (begin(frame.camera, after, config) if after.is_first else [after])
    ]


def _initial_states(
    index: int,
    frame: Frame,
    boxes: Sequence[Box2D],
    warm_starts: Sequence[WarmStart],
    config: RcvConfig,
) -> list[ObjectState]:
    """The state of each image box before its first step."""
    boxes = [box for box in boxes if box.score >= config.min_image_score]
    masks = in_frustums(frame.camera, frame.cloud.xyz_m, boxes)
    cloud = frame.cloud
    if boxes and needs_normals(config):
        cloud = with_normals(frame, np.logical_or.reduce(masks))
    states = [start(index, box, cloud.select(mask), frame.up, config) for box, mask in zip(boxes, masks, strict=True)]
    start_boxes = match_warm_starts(frame.camera, boxes, warm_starts) if warm_starts else [None] * len(states)
    begun: list[ObjectState] = []
    for state, box in zip(states, start_boxes, strict=True):
        if box is not None and state.stop is StopReason.CONTINUES:
            begun.append(start_warm(state, box, config))
        else:
            begun.extend(begin(frame.camera, state, config))
    return begun
