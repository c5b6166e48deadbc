"""Follows one object from frame to frame by the points in its box; no detector is needed.

The points that the reviewed box and the last box enclose are registered with the next frame's cloud
(`geometry/registration.py`), which places and turns a box of the reviewed size. A view detector that was trained on the
class then measures the box anew, starting from there, since articulated objects change their size; its box is taken if
it agrees. A class-agnostic detector measures less well than the points are registered, so it is of no use here.

It stops rather than drifts. `kept` is how much of the reviewed object is still there. It is the larger of two numbers:
the share of its points that are found again, and the product, over all frames, of the share of the previous frame's
points that are found (for objects that turn). The product also falls with each frame in which the box touches something
new. So a box that slides onto something else is marked and then lost; an object that turns freely is not. An object of
which most points are hidden is lost, too (docs/base_detector.md).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import KDTree

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import box_on_image, clip_to_image
from annotator.geometry.projection import every_nth
from annotator.geometry.registration import register, share_found
from annotator.rcv.axes import with_axes_like
from annotator.rcv.config import RcvConfig
from annotator.rcv.propose import propose_from_boxes
from annotator.rcv.recursion import held_direction
from annotator.rcv.starts import WarmStart, is_warm
from annotator.types import Box2D, Camera, Detector, Frame, OrientedBox, Proposal, Quality

# Points of an object that are registered, and of the cloud around it.
OBJECT_POINTS, CLOUD_POINTS = 250, 5000
# Directions in which an object is looked for: along the axes and the diagonals of the camera frame.
SHIFTS = np.array([p for p in itertools.product((-1, 0, 1), repeat=3) if np.abs(p).sum() in (1, 3)], np.float64)
SHIFTS /= np.linalg.norm(SHIFTS, axis=1)[:, None]
# Margin of a box around its points, share of its mean side: a tight box has points on its faces.
MARGIN = 0.03
# Thickness of the slabs at a box's faces, share of its side or its mean side, whichever is less.
SLAB = 0.15
MIN_CONTACT_POINTS, MOST_CONTACT = 10, 2.0
# Lengths below are shares of the box's mean side. Margin around the predicted box within which an object is looked for;
# distance at which registration looks for counterparts at first; distance around the predicted position at which it is
# looked for, too; and within which a point is found again with another one.
ROOM, REACH, SHIFT, TOLERANCE = 0.6, 0.35, 0.4, 0.06
# Weight of the distance from the predicted position against the found shares, if it is looked for elsewhere. If this
# share of the points is found, it is not looked for elsewhere.
JUMP_WEIGHT, WELL_FOUND = 1.0, 0.8
# Share of the last frame's points that is found if nothing has changed, and share of the expected number of points from
# which nothing counts as missing.
FULL_SHARE, FULL_POINTS_SHARE = 0.97, 0.4
# New contact of the box's faces with other points: that is no sign of drift, and from which the loss is greatest; the
# share of the object that is lost then with each frame.
FREE_CONTACT, FULL_CONTACT, CONTACT_LOSS = 1.0, 2.5, 0.2
# Share of the reviewed object: that must be kept, up to which a box is doubtful, and from which it is sure.
MIN_KEPT, DOUBTFUL_KEPT, SURE_KEPT = 0.4, 0.6, 0.9
# Limits of a box: ratio between a side and the reviewed one (with a detector of the class), share of the expected
# number of points and their number, and distance from the predicted centre.
MAX_SIZE_RATIO, MIN_POINTS_SHARE, MIN_POINTS, MAX_JUMP = 1.6, 0.3, 8, 0.7
# Least IoU of a measured box with the registered one that it replaces, and the margin around the outline on the image
# for the detector, share of its size.
SAME_IOU, GROW = 0.5, 0.06


class FollowStop(StrEnum):
    """Why an object is not followed further."""

    SIZE = "the size differs from the reviewed box"
    JUMP = "the box is too far from its predicted position"
    POINTS = "too few points are left"
    CHANGED = "too little of the object is left in the box"
    LEFT = "left the image"


@dataclass(frozen=True, eq=False)
class Followed:
    """The result of one frame: a proposal and the share of the object that is kept, or why there is none."""

    proposal: Proposal | None
    stop: FollowStop | None = None
    detail: str = ""
    kept: float = 0.0


@dataclass(frozen=True, eq=False)
class Look:
    """How an object looked in a frame.

    Attributes:
        box: around it, camera frame.
        xyz_m: at most `OBJECT_POINTS` of the points inside, in the box's coordinates; inside = with the margin.
        points: number of all points inside.
        contact: how much each face touches other points: points just outside per point just inside.
        kept: share of the reviewed object that is still there.
    """

    box: OrientedBox
    xyz_m: Float64[np.ndarray, "n 3"]
    points: int
    contact: Float64[np.ndarray, "6"]
    kept: float = 1.0

    @cached_property
    def spacing_m(self) -> float:
        """Median distance of the points inside to their nearest neighbours."""
        if len(self.xyz_m) < 2:
            return 0.0
        # the points lie on surfaces, so the distance falls with the root of their number
        density = len(self.xyz_m) / self.points
        return float(np.median(KDTree(self.xyz_m).query(self.xyz_m, k=2)[0][:, 1]) * np.sqrt(density))

    @classmethod
    def of(cls, xyz_m: Float[np.ndarray, "m 3"], box: OrientedBox, kept: float = 1.0) -> Look:
        """The look of an object in a cloud, which may be cropped to the surroundings of the box."""
        margin_m = MARGIN * float(box.size_m.mean())
        near = xyz_m[contains(box, xyz_m, margin_m + SLAB * float(box.size_m.mean()))]
        local = (near.astype(np.float64) - box.center_m) @ box.rotation
        outer_m = box.size_m + 2 * margin_m
        inside = (np.abs(local) <= outer_m / 2).all(axis=1)
        own = local[inside]
        return cls(box, every_nth(own, OBJECT_POINTS), len(own), _contact(local, outer_m), kept)


def follow_object(
    frame: Frame,
    predicted: OrientedBox,
    reviewed: Look,
    last: Look,
    label: str,
    view: Detector | None,
    config: RcvConfig,
) -> Followed:
    """Looks for an object near its predicted box.

    Args:
        reviewed, last: the object in the frame of the reviewed box, and in the last frame.
        view: view detector that was trained on the class, or None.
    """
    start = OrientedBox(predicted.pose, reviewed.box.size_m)
    outline = _grown(frame.camera, start, label)
    if outline is None:
        return Followed(None, FollowStop.LEFT)
    scale = float(start.size_m.mean())
    around = frame.cloud.xyz_m[contains(start, frame.cloud.xyz_m, ROOM * scale)]
    if len(around) < MIN_POINTS:
        return Followed(None, FollowStop.POINTS)
    cloud = KDTree(every_nth(around.astype(np.float64), CLOUD_POINTS))
    found = _registration(around, cloud, start, reviewed, last, held_direction(frame.up, config))
    if found is None:
        return Followed(None, FollowStop.POINTS)
    box = found.box
    present = found.points / max(FULL_POINTS_SHARE * expected_points(reviewed, box), 1.0)
    kept = min(found.kept(last), present)
    if kept < MIN_KEPT:
        return Followed(None, FollowStop.CHANGED, f"{kept:.0%}")
    proposal = _registered(box, outline, label, kept)
    if view is not None:
        proposal = _measured(frame, proposal, view, config)
    stop = _why_stop(around, proposal.box, start, last)
    return Followed(None, stop) if stop is not None else Followed(proposal, kept=kept)


@dataclass(frozen=True, eq=False)
class _Registered:
    """A registered box: the shares of the points of the reviewed and the last look that are found, the number of points
    inside, its contact with other points beyond that in the reviewed frame, and the cost of its distance from the
    predicted position.
    """

    box: OrientedBox
    reviewed: float
    last: float
    points: int
    new_contact: float
    cost: float

    @property
    def agreement(self) -> float:
        """How well it agrees with both looks."""
        return self.reviewed + self.last - self.cost

    def kept(self, last: Look) -> float:
        """The share of the reviewed object that is still there."""
        touching = (self.new_contact - FREE_CONTACT) / (FULL_CONTACT - FREE_CONTACT)
        stays = 1 - CONTACT_LOSS * float(np.clip(touching, 0.0, 1.0))
        return max(self.reviewed, last.kept * min(1.0, self.last / FULL_SHARE) * stays)


def _registration(
    around: Float[np.ndarray, "m 3"],
    cloud: KDTree,
    start: OrientedBox,
    reviewed: Look,
    last: Look,
    up: Float64[np.ndarray, "3"] | None,
) -> _Registered | None:
    """The box that agrees best with both looks; None if too few points lie nearby.

    The reviewed look alone does not drift, but no longer fits an object that turns or moves its limbs; with the last
    look, small errors add up. So both are tried. Where neither is found well, the object may have moved further than
    registration reaches, so it is looked for around the predicted position, too.
    """
    scale = float(start.size_m.mean())
    # within it, a point is found again: not less than the distance of a sparse cloud's points
    tolerance_m = max(TOLERANCE * float(reviewed.box.size_m.mean()), reviewed.spacing_m)
    looks = (reviewed.xyz_m, np.concatenate([last.xyz_m, reviewed.xyz_m]))
    tried: list[_Registered] = []
    for shift in (np.zeros(3), *SHIFT * scale * SHIFTS):
        if any(max(one.reviewed, one.last) >= WELL_FOUND for one in tried):
            break
        for points in looks:
            pose = register(points, cloud, (start.rotation, start.center_m + shift), REACH * scale, up)
            if pose is not None:
                box = OrientedBox.from_parts(pose[1], pose[0], start.size_m)
                shares = [share_found(look.xyz_m, cloud, pose, tolerance_m) for look in (reviewed, last)]
                now = Look.of(around, box)
                new_contact = float(np.maximum(now.contact - reviewed.contact, 0.0).sum())
                # what looks alike elsewhere may be another object
                cost = JUMP_WEIGHT * float(np.linalg.norm(pose[1] - start.center_m)) / scale if shift.any() else 0.0
                tried.append(_Registered(box, shares[0], shares[1], now.points, new_contact, cost))
    return max(tried, key=lambda one: one.agreement) if tried else None


def _contact(local: Float64[np.ndarray, "n 3"], size_m: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "6"]:
    """Points outside per point inside in thin slabs at each face, at most 2; 0 with few points."""
    half, thick = size_m / 2, SLAB * np.minimum(size_m, size_m.mean())
    ratios = []
    for axis in range(3):
        across = [other for other in range(3) if other != axis]
        before = local[(np.abs(local[:, across]) <= half[across]).all(axis=1), axis]
        for side in (-before, before):
            inside = int(((side <= half[axis]) & (side > half[axis] - thick[axis])).sum())
            outside = int(((side > half[axis]) & (side <= half[axis] + thick[axis])).sum())
            is_known = inside + outside >= MIN_CONTACT_POINTS
            ratios.append(min(outside / max(inside, 1), MOST_CONTACT) if is_known else 0.0)
    return np.array(ratios)


def _registered(box: OrientedBox, outline: Box2D, label: str, kept: float) -> Proposal:
    """The proposal of a registered box; its signals are the share that is kept, and a score from it."""
    sure = (kept - DOUBTFUL_KEPT) / (SURE_KEPT - DOUBTFUL_KEPT)
    quality = Quality(view_disagreement=math.nan, kept_share=kept, last_change=math.nan)
    return Proposal(label, float(np.clip(sure, 0.0, 1.0)), box, outline, (), quality)


def _measured(frame: Frame, registered: Proposal, view: Detector, config: RcvConfig) -> Proposal:
    """The box that a detector measures from the registered one on, if they agree; else the registered one."""
    box, label = registered.box, registered.label
    outline = _grown(frame.camera, box, label)
    if outline is None:
        return registered
    (result,) = propose_from_boxes([frame], [[outline]], view, config, [[WarmStart(label, box)]])
    for proposal in result.proposals:
        if is_warm(proposal) and iou_3d(proposal.box, box) >= SAME_IOU:
            score = min(proposal.score, registered.score)
            return replace(proposal, box=with_axes_like(proposal.box, box), score=score)
    return registered


def _why_stop(around: Float[np.ndarray, "m 3"], box: OrientedBox, start: OrientedBox, last: Look) -> FollowStop | None:
    ratio = np.sort(box.size_m) / np.sort(start.size_m)
    if max(ratio.max(), 1 / ratio.min()) > MAX_SIZE_RATIO:
        return FollowStop.SIZE
    if np.linalg.norm(box.center_m - start.center_m) > MAX_JUMP * start.size_m.mean():
        return FollowStop.JUMP
    points = Look.of(around, box).points
    if points < max(MIN_POINTS, MIN_POINTS_SHARE * expected_points(last, box)):
        return FollowStop.POINTS
    return None


def expected_points(look: Look, now: OrientedBox) -> float:
    """The number of points at the new distance, if the object is seen as before."""
    before, after = (max(float(np.linalg.norm(box.center_m)), 0.1) for box in (look.box, now))
    return look.points * (before / after) ** 2


def _grown(camera: Camera, box: OrientedBox, label: str) -> Box2D | None:
    outline = box_on_image(camera, box, label)
    if outline is None:
        return None
    dx, dy = GROW * outline.width_px / 2, GROW * outline.height_px / 2
    x_min, y_min, x_max, y_max = outline.xyxy
    grown = Box2D(label, x_min - dx, y_min - dy, x_max + dx, y_max + dy)
    return clip_to_image(grown, camera.width_px, camera.height_px)
