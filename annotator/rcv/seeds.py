"""Warm starts: an object begins at the box that it had a moment ago, and is checked against it.

The first steps of a recursion find out where an object is and how it is turned. A box of the moment before knows both
nearly, so its object starts with views around that box's axes, on the points around it. What comes out must be the same
object: within the part of the cloud that was looked at, of the seed's size, turned about the same, and where the image
detector sees it. Otherwise the seed is dropped, and the object is done as if there had been none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

from annotator.geometry.iou import iou_3d
from annotator.geometry.nearest_upright import nearest_upright
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import undistort_px
from annotator.rcv.canonical import canonical_box
from annotator.rcv.config import RcvConfig
from annotator.rcv.cross_view import box_iou
from annotator.rcv.finish import image_agreement
from annotator.rcv.measure import UNFIXED
from annotator.rcv.recursion import ObjectState
from annotator.types import Box2D, Camera, OrientedBox, Proposal, StopReason

WARM_START = "warm start"
# An outline that ends this near to the picture's border may go on beyond it, pixels.
BORDER_PX = 2.0


@dataclass(frozen=True, eq=False)
class Seed:
    """A box that an object had a moment ago.

    Attributes:
        label: class name.
        box: in the camera frame of the frame that it is a seed for.
    """

    label: str
    box: OrientedBox


def is_warm(proposal: Proposal) -> bool:
    """True where a proposal came from a seed that agreed with it."""
    return proposal.trace[0].fallback[:1] == (WARM_START,)


def matched_seeds(
    camera: Camera, image_boxes: Sequence[Box2D], seeds: Sequence[Seed], config: RcvConfig
) -> list[OrientedBox | None]:
    """For each image box the seed of its class that it belongs to, each seed once; None where there is none.

    Those pairs are taken whose outlines overlap their image boxes most, in all. The seed is moved across the image to
    where its outline's middle is the image box's: objects move between two frames.
    """
    outlines = [box_on_image(camera, seed.box, seed.label) for seed in seeds]
    overlap = np.zeros((len(image_boxes), len(seeds)))
    for i, box in enumerate(image_boxes):
        for j, outline in enumerate(outlines):
            if outline is not None and outline.label == box.label:
                overlap[i, j] = box_iou(box, outline)
    overlap[overlap < config.warm.min_image_iou] = 0.0
    found: list[OrientedBox | None] = [None] * len(image_boxes)
    for i, j in zip(*linear_sum_assignment(-overlap), strict=True):
        outline = outlines[j]
        if overlap[i, j] > 0 and outline is not None:
            found[i] = _moved(camera, seeds[j].box, outline, image_boxes[i])
    return found


def _moved(camera: Camera, box: OrientedBox, outline: Box2D, image_box: Box2D) -> OrientedBox:
    """The box, at its depth, where its outline is in the middle of the image box."""
    if _touches_border(camera, outline) or _touches_border(camera, image_box):
        return box  # the middle of what is seen of it is not its own
    rays = undistort_px(camera, np.array([_middle(outline), _middle(image_box)]))
    shift = (rays[1] - rays[0]) * box.center_m[2]
    if not np.isfinite(shift).all():
        return box
    return OrientedBox.from_parts(box.center_m + np.array([*shift, 0.0]), box.rotation, box.size_m)


def _touches_border(camera: Camera, box: Box2D) -> bool:
    right, bottom = camera.width_px - 0.5 - BORDER_PX, camera.height_px - 0.5 - BORDER_PX
    return min(box.x_min, box.y_min) <= BORDER_PX - 0.5 or box.x_max >= right or box.y_max >= bottom


def _middle(box: Box2D) -> Float64[np.ndarray, "2"]:
    return np.array([box.x_min + box.x_max, box.y_min + box.y_max]) / 2


def warm_start(plain: ObjectState, seed: OrientedBox, config: RcvConfig) -> ObjectState:
    """The state before the first step of an object that starts from a seed; `plain`, with the reason, where it cannot.

    Args:
        plain: the state before the first step without a seed.
        seed: as `matched_seeds` gives it.
    """
    box = seed if plain.up is None else nearest_upright(seed, plain.up)[0]
    box = canonical_box(box, plain.up)
    cloud = plain.cloud.select(contains(box, plain.cloud.xyz_m, _room_m(box, config)))
    if len(cloud) < config.min_points:
        return _dropped(plain, f"{len(cloud)} points around the seed are too few")
    axes = box.rotation.T
    return replace(plain, cloud=cloud, axes=axes, box=box, notes=(WARM_START,), is_warm=True, without_seed=plain)


def _room_m(box: OrientedBox, config: RcvConfig) -> float:
    return config.warm.room * float(box.size_m.max())


def checked(camera: Camera, before: ObjectState, after: ObjectState, config: RcvConfig) -> ObjectState:
    """What a warm started object goes on as after its first step: itself, ended where the step changed little, or the
    object without a seed.

    Args:
        before: the state that `warm_start` gave.
        after: the same after its first step.
    """
    plain, seed = before.without_seed, before.box
    assert plain is not None and seed is not None
    reason, alike = _disagreement(camera, seed, after, config)
    if reason is not None:
        return _dropped(plain, reason)
    if after.stop is StopReason.CONTINUES and not after.is_cut and alike >= config.warm.settled_iou:
        last = replace(after.steps[-1], stop=StopReason.BOX_CONVERGED)
        after = replace(after, steps=(*after.steps[:-1], last), stop=last.stop)
    return replace(after, without_seed=None)


def _dropped(plain: ObjectState, reason: str) -> ObjectState:
    return replace(plain, notes=(f"{WARM_START}: {reason}",))


def _disagreement(camera: Camera, seed: OrientedBox, after: ObjectState, config: RcvConfig) -> tuple[str | None, float]:
    """Why a seed and what was found from it are not the same object, or None; and how alike their shapes are."""
    box = after.box
    if box is None or after.stop is StopReason.LOST:
        return "the views do not show the object", 0.0
    if (reason := _implausible(seed, box, after, config)) is not None:
        return reason, 0.0
    if (alike := shape_iou(seed, box)) < config.warm.min_iou:
        return f"the box, put where the seed is, overlaps it by {alike:.2f}", alike
    if (agreement := image_agreement(camera, after, box, config)) < config.warm.min_image_iou:
        return f"the box overlaps the image box by {agreement:.2f}", alike
    return None, alike


def _implausible(seed: OrientedBox, box: OrientedBox, after: ObjectState, config: RcvConfig) -> str | None:
    """What is wrong with a step from a seed, before a look at how the boxes overlap, or None."""
    warm, step = config.warm, after.steps[-1]
    if after.stop is StopReason.TOO_FEW_POINTS:
        return f"{len(after.cloud)} points in the box are too few"
    seen = sum(view.used is not None for view in step.views) / len(step.views)
    if seen < warm.min_seen:
        return f"only {seen:.0%} of the views show the object"
    if UNFIXED in step.fallback:
        return UNFIXED
    if not contains(seed, box_corners(box), _room_m(seed, config)).all():
        return "the box reaches out of what was looked at around the seed"
    ratio = np.sort(box.size_m) / np.sort(seed.size_m)
    if max(ratio.max(), 1 / ratio.min()) > warm.max_size_ratio:
        return f"a side is {ratio[np.argmax(np.abs(np.log(ratio)))]:.2f} times the seed's"
    return None


def shape_iou(a: OrientedBox, b: OrientedBox) -> float:
    """IoU of two boxes whose centres are put onto each other: how alike they are in size and rotation."""
    return iou_3d(a, OrientedBox.from_parts(a.center_m, b.rotation, b.size_m))
