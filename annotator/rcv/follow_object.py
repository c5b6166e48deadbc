"""Follows one object from frame to frame: its last box is the start of the next recursion; no image detector is needed.

The image box of a frame is the outline of the predicted box. The recursion starts warm from that box with the size of
the reviewed box. It stops rather than drifts: every result is compared with the prediction, with the reviewed size, and
with the number of points seen before. A class-agnostic detector measures sizes less well than the operator did, so with
it the boxes keep the reviewed size (`known_size_fit`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field

from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import box_on_image
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_size_fit import fit_known_size, traced_intervals
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.recursion import held_direction
from annotator.rcv.warm_start import WarmStart, is_warm
from annotator.types import Box2D, Camera, Detector, Frame, OrientedBox, Proposal


class FollowConfig(BaseModel):
    """When an object counts as lost, and how much its reviewed size is trusted."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    grow: float = Field(0.06, ge=0, le=1, description="margin around the predicted outline, share of its size")
    size_doubt: float = Field(
        0.01, gt=0, description="with keep_size: expected error of the start box's faces, share of its mean side"
    )
    loose_size_ratio: float = Field(
        3.0, ge=1, description="with keep_size: maximum ratio between a measured side and the reviewed one"
    )
    loose_iou: float = Field(
        0.15,
        ge=0,
        le=1,
        description="with keep_size: minimum IoU of the measured and the reviewed box, centres aligned",
    )
    keep_size: bool | None = Field(
        None,
        description="boxes keep the reviewed size; None: only with a class-agnostic detector",
    )
    max_size_ratio: float = Field(1.6, ge=1, description="maximum ratio between a side and the reviewed one")
    min_points_share: float = Field(
        0.3, ge=0, le=1, description="minimum share of the expected points, from the last frame and the distances"
    )
    min_points: int = Field(8, ge=1, description="minimum number of points in a box")
    max_jump: float = Field(
        0.7, gt=0, description="maximum distance from the predicted centre, share of the box's mean side"
    )


class FollowStop(StrEnum):
    """Why an object is not followed further."""

    LOST = "lost"
    SIZE = "the size differs from the reviewed box"
    JUMP = "the box is too far from its predicted position"
    POINTS = "too few points are left"
    LEFT = "left the image"
    END = "end of the recording"


@dataclass(frozen=True, eq=False)
class Followed:
    """The result of one frame: a proposal, or why there is none, with the trace's last note."""

    proposal: Proposal | None
    stop: FollowStop | None = None
    detail: str = ""


def follow_object(
    frame: Frame,
    predicted: OrientedBox,
    reviewed_size_m: Float[np.ndarray, "3"],
    expected_points: float,
    label: str,
    view: Detector,
    config: RcvConfig,
    limits: FollowConfig,
) -> Followed:
    """Measures an object near its predicted box.

    Args:
        frame: with cloud.
        predicted: the box at the frame's time, camera frame.
        reviewed_size_m: sides of the reviewed box.
        expected_points: number of points that the object should have.
        view: view detector.
        config: the recursion's settings for this detector and the frame's orientation.
        limits: when the object counts as lost.
    """
    start = OrientedBox(predicted.T_camera_box, np.asarray(reviewed_size_m, np.float64))
    image_box = _grown(frame.camera, start, label, limits.grow)
    if image_box is None:
        return Followed(None, FollowStop.LEFT)
    keep_size = config.class_agnostic if limits.keep_size is None else limits.keep_size
    if keep_size:
        # the size is known, so the views need not measure it well; what they give is checked below
        known = {
            "seed_doubt": limits.size_doubt,
            "max_size_ratio": limits.loose_size_ratio,
            "min_iou": limits.loose_iou,
        }
        config = config.model_copy(update={"warm": config.warm.model_copy(update=known)})
    (result,) = propose_from_boxes([frame], [[image_box]], view, config, [[WarmStart(label, start)]])
    warm_ones = [proposal for proposal in result.proposals if is_warm(proposal)]
    if not warm_ones:
        traces = [p.trace for p in result.proposals] + [lost.trace for lost in result.lost]
        notes = [note for trace in traces for note in trace[0].fallback]
        return Followed(None, FollowStop.LOST, notes[0] if notes else "")
    proposal = warm_ones[0]
    if keep_size:
        proposal = _with_known_size(frame, proposal, start, config)
    stop = _why_stop(frame, proposal.box, start, expected_points, limits)
    return Followed(None, stop) if stop is not None else Followed(proposal)


def _with_known_size(frame: Frame, proposal: Proposal, start: OrientedBox, config: RcvConfig) -> Proposal:
    """The proposal with the size of the start box, placed by the same measurements."""
    intervals = traced_intervals(proposal.trace, config)
    if intervals is None:
        return proposal
    near = OrientedBox.from_parts(proposal.box.center_m, start.rotation, start.size_m)
    return replace(proposal, box=fit_known_size(intervals, near, held_direction(frame.up, config), config.fit))


def _why_stop(
    frame: Frame, box: OrientedBox, start: OrientedBox, expected_points: float, limits: FollowConfig
) -> FollowStop | None:
    ratio = np.sort(box.size_m) / np.sort(start.size_m)
    if max(ratio.max(), 1 / ratio.min()) > limits.max_size_ratio:
        return FollowStop.SIZE
    if np.linalg.norm(box.center_m - start.center_m) > limits.max_jump * start.size_m.mean():
        return FollowStop.JUMP
    points = points_in(frame, box)
    if points < max(limits.min_points, limits.min_points_share * expected_points):
        return FollowStop.POINTS
    return None


def points_in(frame: Frame, box: OrientedBox) -> int:
    """Number of the frame's points in a box."""
    return int(contains(box, frame.cloud.xyz_m).sum())


def expected_points(last_points: int, last: OrientedBox, now: OrientedBox) -> float:
    """The number of points at the new distance, if the object is seen as before."""
    before, after = (max(float(np.linalg.norm(box.center_m)), 0.1) for box in (last, now))
    return last_points * (before / after) ** 2


def _grown(camera: Camera, box: OrientedBox, label: str, margin: float) -> Box2D | None:
    outline = box_on_image(camera, box, label)
    if outline is None:
        return None
    dx, dy = margin * outline.width_px / 2, margin * outline.height_px / 2
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    return replace(
        outline,
        x_min=max(outline.x_min - dx, -0.5),
        y_min=max(outline.y_min - dy, -0.5),
        x_max=min(outline.x_max + dx, right),
        y_max=min(outline.y_max + dy, bottom),
    )
