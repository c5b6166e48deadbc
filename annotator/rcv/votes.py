"""One box of an object that stands still, from what many frames say of it: Recursive Cross-View with many cameras.

What a frame found is a *vote*: a box, and the edges of its image box, which bound the object whatever its depth. All
are moved into the world. Votes of a class that overlap there are about one object. Some saw a wrong depth, and all err
in ways that repeat from view to view, so no single fit is the best one everywhere. There are three kinds of candidates:

- each box itself,
- the least-squares box (`interval_fit`) through the planes of all image boxes, and through the three sides of all boxes
  with a weight that only holds what the planes leave open (`SIDE_DOUBTS`); once of the votes that agree with the one in
  the middle, once of all,
- the box through the median of how far the boxes reach along many directions.

The one is chosen that agrees best with the votes: mean IoU of its outline with the image boxes, plus `BOX_WEIGHT` times
the mean IoU with the boxes in space.

Mean exact IoU, and share of at least 0.5, of the base detector on generated tables, rooms and tours, seen in 6 or 11
frames along an arc of 70 degrees, or on the way; image boxes with an error of 3 % of their sides:

one frame                                   0.52  0.62    83 objects, on which this was chosen
the box in the middle (best mean IoU)       0.58  0.71
the median of the reach                     0.57  0.72
one fit through all intervals of all views  0.56  0.67    72 of them
the same of those that agree, with planes   0.60  0.71    0.67 and 0.78 if the views' errors count 16 times
these votes                                 0.65  0.81    each frame's box, with those that found no partner
one frame, these votes                      0.51, 0.67    94 others; share of at least 0.5: 0.56, 0.80
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.geometry.iou import iou_3d_matrix
from annotator.geometry.oriented_box import box_corners, canonical_box, reach_along
from annotator.geometry.outline import NEAR_M
from annotator.rcv.first_look import edge_planes
from annotator.rcv.interval_fit import Intervals, fit_box
from annotator.types import OrientedBox
from annotator.types.label import Edges

# A vote is about an object if it overlaps others of it by this IoU; or, wherever in depth its box is, if its image box
# overlaps the outline by that much.
SAME_IOU, SAME_OUTLINE = 0.2, 0.5
# A vote is compared with so many of a group, and so many, spread over all, are fitted.
COMPARED, MOST_FITTED = 4, 30
# Expected errors, shares of the mean side: of the image box's planes, and of the sides of the boxes. So large, these
# decide only where the planes say nothing.
PLANE_DOUBT, SIDE_DOUBTS = 0.025, (0.3, 1.2)
BOX_WEIGHT = 0.25
# Horizontal directions of the median; boxes are upright if their z axes are within this angle of each other.
DIRECTIONS, UPRIGHT_RAD = 36, 0.05
# Of two objects of a class whose boxes overlap more than this, that with more votes stays.
NMS_IOU = 0.3


@dataclass(frozen=True, eq=False)
class Vote:
    """What a frame found of an object.

    Attributes:
        frame: its number; a frame has one vote for an object.
        box: camera frame.
        edges: as in `Proposal`.
    """

    frame: int
    T_world_camera: RigidTransform
    label: str
    box: OrientedBox
    score: float
    edges: Edges | None = None

    @cached_property
    def in_world(self) -> OrientedBox:
        return self.box.transformed(self.T_world_camera)

    @cached_property
    def planes(self) -> Intervals | None:
        """The image box's planes in the world, intervals with one known end."""
        if self.edges is None or (planes := edge_planes(self.edges)) is None:
            return None
        directions = self.T_world_camera.rotation.apply(planes)
        ends = (directions @ self.T_world_camera.translation)[:, None] * [0.0, 1.0]
        sigma_m = np.full(ends.shape, PLANE_DOUBT * float(self.box.size_m.mean()))
        sigma_m[:, 0] = np.inf
        return Intervals(directions, ends, sigma_m)

    @property
    def has_outline(self) -> bool:
        """Whether an edge is known on each axis. What fills the image agrees with anything before the camera."""
        left, right, top, bottom = (edge is not None for edge in self.edges or (None,) * 4)
        return (left or right) and (top or bottom)

    def sides(self, doubt: float) -> Intervals:
        """The box's own three intervals in the world."""
        ends = reach_along(self.in_world, directions := self.in_world.rotation.T)
        return Intervals(directions, ends, np.full((3, 2), doubt * float(self.box.size_m.mean())))

    def agreements(self, corners_m: Float64[np.ndarray, "k 8 3"]) -> Float64[np.ndarray, "k"]:
        """IoU of the outlines of boxes (corners in the world) with the image box; 0 behind the camera. Edges that are
        not known agree."""
        T = self.T_world_camera.inv()
        xyz_m = T.rotation.apply(corners_m.reshape(-1, 3)) + T.translation
        xyz_m = xyz_m.reshape(corners_m.shape)
        on_plane = xyz_m[..., :2] / np.maximum(xyz_m[..., 2:], NEAR_M)
        low, high = on_plane.min(axis=1), on_plane.max(axis=1)
        left, right, top, bottom = np.array([np.nan if each is None else each for each in self.edges or (None,) * 4])
        other_low = np.where(np.isnan([left, top]), low, [left, top])
        other_high = np.where(np.isnan([right, bottom]), high, [right, bottom])
        shared = np.maximum(np.minimum(high, other_high) - np.maximum(low, other_low), 0.0).prod(axis=1)
        both = (high - low).prod(axis=1) + np.maximum(other_high - other_low, 0.0).prod(axis=1) - shared
        return np.where((xyz_m[..., 2] > NEAR_M).all(axis=1), shared / np.maximum(both, 1e-12), 0.0)


@dataclass(frozen=True, eq=False)
class Agreed:
    """The box of an object.

    Attributes:
        box: in the world.
        votes: that are about it, those that see it at a wrong depth, too.
        score: mean of the votes' scores.
        expected_iou_loss: 1 - the mean IoU with the votes' boxes.
    """

    label: str
    box: OrientedBox
    votes: tuple[Vote, ...]
    score: float
    expected_iou_loss: float


def grouped(votes: Iterable[Vote]) -> list[list[Vote]]:
    """Votes of a class that overlap in the world, in the order of their frames; each vote is in one group."""
    of_classes = defaultdict[str, list[Vote]](list)
    for vote in sorted(votes, key=lambda each: (each.frame, -each.score)):
        of_classes[vote.label].append(vote)
    return [group for of_class in of_classes.values() for group in _grouped(of_class)]


def _grouped(votes: Sequence[Vote]) -> list[list[Vote]]:
    """The groups of one class. What moves makes a group in each frame, so only those nearby are compared."""
    groups: list[list[Vote]] = []
    # spheres around all boxes of each group
    centers_m, reaches_m = np.zeros((len(votes), 3)), np.zeros(len(votes))
    for vote in votes:
        center_m, reach_m = vote.in_world.center_m, float(np.linalg.norm(vote.in_world.size_m)) / 2
        apart_m = np.linalg.norm(centers_m[: len(groups)] - center_m, axis=1)
        near = np.flatnonzero(apart_m <= reaches_m[: len(groups)] + reach_m).tolist()
        known = [number for number in near if groups[number][-1].frame != vote.frame]
        some = [groups[number][:: max(len(groups[number]) // COMPARED, 1)][-COMPARED:] for number in known]
        boxes = [each.in_world for group in some for each in group]
        ious = iou_3d_matrix([vote.in_world], boxes)[0] if boxes else np.zeros(0)
        starts = np.cumsum([0, *map(len, some)])
        means = [float(ious[a:b].mean()) for a, b in pairwise(starts)]
        best = int(np.argmax(means)) if means else -1
        if best >= 0 and means[best] >= SAME_IOU:
            groups[known[best]].append(vote)
            reaches_m[known[best]] = max(reaches_m[known[best]], apart_m[known[best]] + reach_m)
        else:
            centers_m[len(groups)], reaches_m[len(groups)] = center_m, reach_m
            groups.append([vote])
    return groups


def agreed(groups: Sequence[Sequence[Vote]]) -> list[Agreed]:
    """The objects of groups of votes (`grouped`): each vote is of one object at most, those of other groups too."""
    found = [(group, *_best(group)) for group in groups if len(group) > 1]
    found.sort(key=lambda each: -len(each[0]))
    kept: list[tuple[Sequence[Vote], OrientedBox, float]] = []
    for group, box, iou in found:
        same = [other for of, other, _ in kept if of[0].label == group[0].label]
        if not same or iou_3d_matrix([box], same).max() <= NMS_IOU:
            kept.append((group, box, iou))
    taken = {id(vote) for group, *_ in kept for vote in group}
    frames, more = [{vote.frame for vote in group} for group, *_ in kept], [list[Vote]() for _ in kept]
    of_classes = defaultdict[str, list[int]](list)
    for number, (group, *_) in enumerate(kept):
        of_classes[group[0].label].append(number)
    for vote in (vote for group in groups for vote in group if id(vote) not in taken):
        others = [number for number in of_classes[vote.label] if vote.frame not in frames[number]]
        if not others:
            continue
        boxes = [kept[number][1] for number in others]
        fits = iou_3d_matrix([vote.in_world], boxes)[0] >= SAME_IOU
        if vote.has_outline:
            fits |= vote.agreements(np.stack([box_corners(box) for box in boxes])) >= SAME_OUTLINE
        if fits.any():
            more[others[int(np.argmax(fits))]].append(vote)
    objects = []
    for (group, box, iou), further in zip(kept, more, strict=True):
        votes = (*group, *further)
        score = float(np.mean([vote.score for vote in votes]))
        objects.append(Agreed(group[0].label, box, votes, score, 1 - iou))
    return objects


def _best(group: Sequence[Vote]) -> tuple[OrientedBox, float]:
    """The candidate that agrees best with a group, and its mean IoU with the boxes."""
    votes = [group[i] for i in np.unique(np.linspace(0, len(group) - 1, MOST_FITTED).astype(int))]
    boxes = [vote.in_world for vote in votes]
    ious = iou_3d_matrix(boxes, boxes)
    middle = int(np.argmax(ious.sum(axis=0)))
    up = _up(boxes)
    near = boxes[middle].rotation
    core = [vote for vote, iou in zip(votes, ious[middle], strict=True) if iou >= SAME_IOU]
    parts = [
        [vote.sides(doubt) for vote in some] + [vote.planes for vote in some if vote.planes is not None]
        for some in (core, votes)
        for doubt in SIDE_DOUBTS
    ]
    parts += [[_median([vote.in_world for vote in some], up)] for some in (core, votes)]
    fits = [fit for part in parts if (fit := fit_box(Intervals.concatenate(part), up, near)) is not None]
    fitted = [canonical_box(OrientedBox.from_parts(fit.center_m, fit.rotation, fit.size_m), up) for fit in fits]
    candidates = [*boxes, *fitted]
    in_space = iou_3d_matrix(candidates, boxes).mean(axis=1)
    corners = np.stack([box_corners(box) for box in candidates])
    on_images = [vote.agreements(corners) for vote in votes if vote.edges]
    rank = BOX_WEIGHT * in_space + (np.mean(on_images, axis=0) if on_images else 0.0)
    chosen = int(np.argmax(rank))
    return candidates[chosen], float(in_space[chosen])


def _up(boxes: Sequence[OrientedBox]) -> Float64[np.ndarray, "3"] | None:
    """The direction of the z axes of upright boxes; None if they differ."""
    axes = np.stack([box.rotation[:, 2] for box in boxes])
    axes *= np.sign(axes @ axes[0])[:, None]
    mean = axes.mean(axis=0) / np.linalg.norm(axes.mean(axis=0))
    return mean if (axes @ mean).min() >= np.cos(UPRIGHT_RAD) else None


def _median(boxes: Sequence[OrientedBox], up: Float64[np.ndarray, "3"] | None) -> Intervals:
    """The median of how far boxes reach, along directions across their upright axis and along it."""
    z = boxes[0].rotation[:, 2] if up is None else up
    x = boxes[0].rotation[:, 0]
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    around = np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * np.cross(z, x)
    directions = np.concatenate([around, [z] * 4])
    if up is None:
        directions = np.concatenate([boxes[0].rotation.T, *(box.rotation.T for box in boxes)])
    ends = np.median([reach_along(box, directions) for box in boxes], axis=0)
    return Intervals(directions, ends, np.full(ends.shape, PLANE_DOUBT))
