"""Frames in, proposals out: all objects of all frames advance together, one detector batch a step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from annotator.geometry.frustum import in_frustums
from annotator.rcv.compute import NUMPY, Compute
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals, finish
from annotator.rcv.normals import needs_normals, with_normals
from annotator.rcv.recursion import ObjectState, StepPlan, absorb_step, plan_step, start
from annotator.rcv.seeds import Seed, checked, matched_seeds, warm_start
from annotator.types import Box2D, Detector, Frame, StopReason


def propose(
    frames: Sequence[Frame],
    image_detector: Detector,
    view_detector: Detector,
    config: RcvConfig,
    seeds: Sequence[Sequence[Seed]] | None = None,
    compute: Compute = NUMPY,
) -> list[FrameProposals]:
    """Recursive Cross-View on several frames at once.

    The image detector runs once on all images; then every step runs the view detector once, on the pseudo-views of
    all objects that are still in recursion.

    Args:
        seeds: for each frame the boxes that its objects had a moment ago. An object whose image box matches one starts
            from it, and without it where the two turn out to disagree (`seeds`).
        compute: where pictures are drawn, normals estimated and clustered.

    Returns:
        one result a frame, in the order given.
    """
    image_boxes = image_detector.detect(frames)
    return propose_from_boxes(frames, image_boxes, view_detector, config, seeds, compute)


def propose_from_boxes(
    frames: Sequence[Frame],
    image_boxes: Sequence[Sequence[Box2D]],
    view_detector: Detector,
    config: RcvConfig,
    seeds: Sequence[Sequence[Seed]] | None = None,
    compute: Compute = NUMPY,
) -> list[FrameProposals]:
    """The same from given 2D boxes on the images, one list a frame."""
    active: list[ObjectState] = []
    each_seeds = seeds if seeds is not None else [()] * len(frames)
    for index, (frame, boxes, known) in enumerate(zip(frames, image_boxes, each_seeds, strict=True)):
        active.extend(_frustums(index, frame, boxes, known, config, compute))
    done = [state for state in active if state.stop is not StopReason.CONTINUES]
    active = [state for state in active if state.stop is StopReason.CONTINUES]
    while active:
        plans = [plan_step(state, config, compute) for state in active]
        found = iter(view_detector.detect([view for plan in plans for view in plan.views]))
        advanced: list[ObjectState] = []
        for state, plan in zip(active, plans, strict=True):
            detections = [next(found) for _ in plan.views]
            advanced.extend(_advanced(frames[state.frame_index], state, plan, detections, config))
        done.extend(state for state in advanced if state.stop is not StopReason.CONTINUES)
        active = [state for state in advanced if state.stop is StopReason.CONTINUES]
    return [finish(frame, [s for s in done if s.frame_index == i], config) for i, frame in enumerate(frames)]


def _advanced(
    frame: Frame, state: ObjectState, plan: StepPlan, detections: Sequence[Sequence[Box2D]], config: RcvConfig
) -> list[ObjectState]:
    advanced = absorb_step(state, plan, detections, config)
    if state.without_seed is None:
        return advanced
    return [checked(frame.camera, state, after, config) for after in advanced]


def _frustums(
    index: int, frame: Frame, boxes: Sequence[Box2D], seeds: Sequence[Seed], config: RcvConfig, compute: Compute
) -> list[ObjectState]:
    boxes = [box for box in boxes if box.score >= config.min_image_score]
    if boxes:
        frame = compute.hold(frame)
    masks = in_frustums(frame.camera, frame.cloud.xyz_m, boxes)
    cloud = frame.cloud
    if boxes and needs_normals(config):
        cloud = with_normals(frame, np.logical_or.reduce(masks), config, compute)
    states = [start(index, box, cloud.select(mask), frame.up, config) for box, mask in zip(boxes, masks, strict=True)]
    if not seeds:
        return states
    matched = matched_seeds(frame.camera, boxes, seeds, config)
    return [
        state if seed is None or state.stop is not StopReason.CONTINUES else warm_start(state, seed, config)
        for state, seed in zip(states, matched, strict=True)
    ]
