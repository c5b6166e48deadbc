"""The 2D boxes of known 3D boxes on a frame's image and pseudo-views (RCV paper, section III.A and Fig. 5).

Each object goes through the two steps of manual labelling (`annotator.rcv.operator`), with its projected 3D box in
place of each drawn box. Unlike manually labelled views, these have boxes for all visible objects: a frustum
often contains neighbours, which would otherwise be unlabelled background in training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import NEAR_M, box_on_image
from annotator.geometry.projection import in_frustum
from annotator.rcv.config import RcvConfig
from annotator.rcv.normals import frame_with_normals
from annotator.rcv.operator import draw_object
from annotator.rcv.teach import is_shown, project_box
from annotator.types import Box2D, Frame, PseudoView, Truth

# An object without points counts as hidden if at least this share of the points in its frustum lie in front of it.
HIDING_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class KnownView:
    """A pseudo-view, the number of its step (from 0), and the boxes on it; the box of its own object is the first."""

    view: PseudoView
    step: int
    boxes: tuple[Box2D, ...]


@dataclass(frozen=True, eq=False)
class KnownObject:
    """An object's box on the image, and its views: front and side of each step."""

    image_box: Box2D
    views: tuple[KnownView, ...]


@dataclass(frozen=True, eq=False)
class KnownFrame:
    """The 2D boxes of a frame's 3D boxes.

    Attributes:
        on_image: boxes on the image of all visible objects, including those without views.
        objects: the objects that went through both steps.
        outside: classes of the objects outside the image.
        hidden: classes of the objects without points that are hidden behind something else.
        without_views: classes of the visible objects with too few points for both steps.
    """

    on_image: tuple[Box2D, ...]
    objects: tuple[KnownObject, ...]
    outside: tuple[str, ...]
    hidden: tuple[str, ...]
    without_views: tuple[str, ...]


def boxes_of_known(frame: Frame, truths: Sequence[Truth], config: RcvConfig) -> KnownFrame:
    """The 2D boxes of known objects on the image and on the views of the first two steps.

    The box of an object that is cut off by the image border covers its visible part. The box of a partly hidden object
    covers its whole extent, as for `BoxKind.BOX`.

    Args:
        frame: with cloud; missing normals are estimated.
        truths: all labelled objects of the classes to learn.
        config: how views are drawn.
    """
    known = _Known(frame, truths)
    outside, hidden, visible = [], [], []
    for index, truth in enumerate(truths):
        image_box = box_on_image(frame.camera, truth.box, truth.label)
        if image_box is None:
            outside.append(truth.label)
        elif known.points[index] == 0 and _is_hidden(frame, truth, image_box):
            hidden.append(truth.label)
        else:
            visible.append((index, image_box))
    frame = frame_with_normals(frame, [box for index, box in visible if known.points[index]], config)
    objects, without_views = [], []
    for index, image_box in visible:
        known_object = known.follow(frame, index, image_box, config) if known.points[index] else None
        if known_object is None:
            without_views.append(truths[index].label)
        else:
            objects.append(known_object)
    on_image = tuple(box for _, box in visible)
    return KnownFrame(on_image, tuple(objects), tuple(outside), tuple(hidden), tuple(without_views))


def _is_hidden(frame: Frame, truth: Truth, image_box: Box2D) -> bool:
    """True for an object without points if the measured points in its frustum lie in front of it.

    If nothing was measured there, or only points behind the object (far objects, glass), the image may show it.
    """
    depth_m = frame.cloud.xyz_m[in_frustum(frame.camera, frame.cloud.xyz_m, image_box), 2]
    nearest_m = max(float(box_corners(truth.box)[:, 2].min()), NEAR_M)
    return len(depth_m) > 0 and float((depth_m < nearest_m).mean()) >= HIDING_SHARE


@dataclass(frozen=True, eq=False)
class _Known:
    """The objects of a frame, the number of points in each, and their corners."""

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
        """Takes one object through both steps; None if too few points are left."""
        truth = self.truths[index]
        # cached, since both views of a step have the same points; the array is kept so that its id stays valid
        shown: dict[int, tuple[np.ndarray, tuple[int, ...]]] = {}

        def objects_on(view: PseudoView) -> tuple[int, ...]:
            if id(view.xyz_m) not in shown:
                shown[id(view.xyz_m)] = (view.xyz_m, self._shown(view.xyz_m))
            return shown[id(view.xyz_m)][1]

        def draw(view: PseudoView) -> Box2D | None:
            return project_box(view, truth.box, truth.label) if index in objects_on(view) else None

        drawn = draw_object(frame, image_box, draw, config)
        if drawn is None:
            return None
        return KnownObject(
            image_box,
            tuple(
                KnownView(d.view, d.step, (d.box, *self._others(d.view, index, objects_on(d.view))))
                for d in drawn.views
            ),
        )

    def _others(self, view: PseudoView, target: int, shown: Sequence[int]) -> list[Box2D]:
        others = [self.truths[index] for index in shown if index != target]
        boxes = [project_box(view, truth.box, truth.label) for truth in others]
        return [box for box in boxes if box is not None]

    def _shown(self, xyz_m: np.ndarray) -> tuple[int, ...]:
        """Indices of the objects of which these points show enough for a label."""
        low, high = xyz_m.min(axis=0), xyz_m.max(axis=0)
        near = ((self.corners_m.min(axis=1) <= high) & (self.corners_m.max(axis=1) >= low)).all(axis=1)
        return tuple(
            index
            for index in np.flatnonzero(near).tolist()
            if is_shown(int(contains(self.truths[index].box, xyz_m).sum()), self.points[index])
        )
