"""Runs Recursive Cross-View on frames in memory, each with the orientation it allows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from annotator.project.config import BoxRotation
from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.propose import propose_from_boxes
from annotator.types import Box2D, Detector, Frame
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import orientation_for


def propose_frames(
    frames: Sequence[Frame], detectors: Detectors, config: RcvConfig, rotation: BoxRotation
) -> list[FrameProposals]:
    """Returns the proposals of each frame, in the given order.

    Args:
        config: its orientation and box kind are set here.
        rotation: the rotations that boxes may have; AUTO depends on the frame's up direction.
    """
    image_boxes = detectors.image.detect(frames) if frames else []
    config = detectors.settings(config)
    return propose_image_boxes(frames, image_boxes, detectors.view, config, rotation)


def propose_image_boxes(
    frames: Sequence[Frame],
    image_boxes: Sequence[Sequence[Box2D]],
    view_detector: Detector,
    config: RcvConfig,
    rotation: BoxRotation,
) -> list[FrameProposals]:
    """As `propose_frames`, but with given image boxes, one list per frame; sets only the orientation of `config`."""
    groups: dict[Orientation, list[int]] = defaultdict(list)
    for index, frame in enumerate(frames):
        groups[orientation_for(rotation, frame)].append(index)
    results: dict[int, FrameProposals] = {}
    for orientation, indices in groups.items():
        settings = config.model_copy(update={"orientation": orientation})
        chosen, boxes = [frames[i] for i in indices], [image_boxes[i] for i in indices]
        done = propose_from_boxes(chosen, boxes, view_detector, settings)
        results.update(zip(indices, done, strict=True))
    return [results[index] for index in range(len(frames))]
