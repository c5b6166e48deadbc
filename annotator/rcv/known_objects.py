"""The 2D boxes that known 3D boxes have on a frame's pictures (RCV paper, section III.A and Fig. 5).

An object goes through the first two steps as under an operator's hands (`annotator.rcv.operator`), its projected 3D
box in place of each drag. Unlike an operator's views, these carry the boxes of all objects that they show: a frustum
often holds neighbours, and a detector that is not told of them would learn that they are background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from annotator.geometry.frustum import in_frustum
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import NEAR_M, box_on_image
from annotator.rcv.config import RcvConfig
from annotator.rcv.normals import frame_with_normals
from annotator.rcv.operator import draw_object
from annotator.rcv.teach import is_shown, project_box
from annotator.types import Box2D, Frame, PseudoView, Truth

# An object without a point of its own is hidden where at least this share of the points in its place on the image lie
# before it.
HIDING_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class KnownView:
    """A pseudo-view, its step (from 0), and the boxes of the objects that it shows, its own object's first."""

    view: PseudoView
    step: int
    boxes: tuple[Box2D, ...]


@dataclass(frozen=True, eq=False)
class KnownObject:
    """One object's box on the image, and its views: front and side of each step."""

    image_box: Box2D
    views: tuple[KnownView, ...]


@dataclass(frozen=True, eq=False)
class KnownFrame:
    """What a frame's 3D boxes are on its pictures.

    Attributes:
        on_image: of the objects that the camera sees, also of those without a view.
        objects: those that could be followed through both steps.
        outside: classes of the objects outside the picture.
        hidden: classes of the objects behind something else, without a point of their own.
        without_views: classes of the objects on the image that got lost on the way, for want of points.
    """

    on_image: tuple[Box2D, ...]
    objects: tuple[KnownObject, ...]
    outside: tuple[str, ...]
    hidden: tuple[str, ...]
    without_views: tuple[str, ...]


def boxes_of_known(frame: Frame, truths: Sequence[Truth], config: RcvConfig) -> KnownFrame:
    """The 2D boxes of known objects on the image and on the views of the first two steps.

    An object that reaches out of the picture has the box of its visible part; one that is hidden in part has the box
    of its whole extent, since that is what a box of the kind `BoxKind.BOX` measures.

    Args:
        frame: read whole; its normals are estimated where it has none.
        truths: all labelled objects of the classes that shall be learnt.
        config: how views are drawn; its orientation is the frame's.
    """
    known = _Known(frame, truths)
    outside, hidden, seen = [], [], []
    for index, truth in enumerate(truths):
        image_box = box_on_image(frame.camera, truth.box, truth.label)
        if image_box is None:
            outside.append(truth.label)
        elif known.points[index] == 0 and _is_hidden(frame, truth, image_box):
            hidden.append(truth.label)
        else:
            seen.append((index, image_box))
    frame = frame_with_normals(frame, [box for index, box in seen if known.points[index]], config)
    objects, without_views = [], []
    for index, image_box in seen:
        followed = known.follow(frame, index, image_box, config) if known.points[index] else None
        if followed is None:
            without_views.append(truths[index].label)
        else:
            objects.append(followed)
    on_image = tuple(box for _, box in seen)
    return KnownFrame(on_image, tuple(objects), tuple(outside), tuple(hidden), tuple(without_views))


def _is_hidden(frame: Frame, truth: Truth, image_box: Box2D) -> bool:
    """True for an object without points whose place on the image is taken by what lies before it.

    Where nothing was measured at all, or what was lies behind it (far objects, glass), the image may well show it.
    """
    depth_m = frame.cloud.xyz_m[in_frustum(frame.camera, frame.cloud.xyz_m, image_box), 2]
    nearest_m = max(float(box_corners(truth.box)[:, 2].min()), NEAR_M)
    return len(depth_m) > 0 and float((depth_m < nearest_m).mean()) >= HIDING_SHARE


@dataclass(frozen=True, eq=False)
class _Known:
    """The objects of a frame, and how many of the cloud's points are whose."""

    frame: Frame
    truths: Sequence[Truth]
    points: tuple[int, ...] = field(init=False)
    corners_m: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        points = tuple(int(contains(t.box, self.frame.cloud.xyz_m).sum()) for t in self.truths)
        object.__setattr__(self, "points", points)
        corners_m = np.array([box_corners(t.box) for t in self.truths]).reshape(-1, 8, 3)
        object.__setattr__(self, "corners_m", corners_m)

    def follow(self, frame: Frame, index: int, image_box: Box2D, config: RcvConfig) -> KnownObject | None:
        """One object through both steps; None where it gets lost."""
        truth = self.truths[index]
        # the two views of a step draw the same points; the key is good as long as `shown` keeps them
        shown: dict[int, tuple[np.ndarray, tuple[int, ...]]] = {}

        def of(view: PseudoView) -> tuple[int, ...]:
            if id(view.xyz_m) not in shown:
                shown[id(view.xyz_m)] = (view.xyz_m, self._shown(view.xyz_m))
            return shown[id(view.xyz_m)][1]

        def draw(view: PseudoView) -> Box2D | None:
            return project_box(view, truth.box, truth.label) if index in of(view) else None

        drawn = draw_object(frame, image_box, draw, config)
        if drawn is None:
            return None
        return KnownObject(
            image_box,
            tuple(KnownView(d.view, d.step, (d.box, *self._others(d.view, index, of(d.view)))) for d in drawn.views),
        )

    def _others(self, view: PseudoView, own: int, shown: Sequence[int]) -> list[Box2D]:
        others = [self.truths[index] for index in shown if index != own]
        boxes = [project_box(view, truth.box, truth.label) for truth in others]
        return [box for box in boxes if box is not None]

    def _shown(self, xyz_m: np.ndarray) -> tuple[int, ...]:
        """The objects of which a picture of these points shows enough."""
        low, high = xyz_m.min(axis=0), xyz_m.max(axis=0)
        near = ((self.corners_m.min(axis=1) <= high) & (self.corners_m.max(axis=1) >= low)).all(axis=1)
        return tuple(
            index
            for index in np.flatnonzero(near).tolist()
            if is_shown(int(contains(self.truths[index].box, xyz_m).sum()), self.points[index])
        )
