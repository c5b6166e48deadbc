"""Training images for the view detector: pseudo-views from random directions, labelled by known 3D boxes.

The crops imitate the stages of the recursion: a frustum along the camera axes; the points in a first cross-view box,
from any direction; and the points in a nearly correct box, nearly along its own axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial.transform import Rotation

from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import in_frustum
from annotator.rcv.axes import camera_axes
from annotator.rcv.config import AGNOSTIC_LABELS, RcvConfig
from annotator.rcv.first_look import depth_crop, in_middle, width_at
from annotator.rcv.measure import span_box
from annotator.rcv.pseudo_view import frustum_views, is_deep, render_pairs
from annotator.rcv.rotations import face_camera
from annotator.types import Box2D, BoxKind, Frame, OrientedBox, PseudoView

# Parameters of the random crops. They are not settings like those of `RcvConfig`, because every change requires
# retraining and a new evaluation.
MIN_POINTS = 5
# An object is labelled on a view if the view shows at least this share of its points.
MIN_SHARE = 0.3
SPAN_JITTER, NEAR_JITTER = 0.06, 0.06
NEAR_TURN_RAD = 0.35
IMAGE_JITTER = 0.04


@dataclass(frozen=True)
class Stages:
    """How often each stage of the recursion is imitated, and how inaccurate its crops are.

    Attributes:
        frustum: share of the crops that are whole frustums.
        depth: share of the crops along the depth of a frustum (`first_look`), for class-agnostic detectors.
        wide: share of first cross-view boxes; the rest are nearly correct boxes.
        span_jitter, near_jitter: errors of the ends of a first cross-view box, and of a nearly correct one, shares of
            their sides; one of these values, by chance.
    """

    frustum: float = 0.2
    depth: float = 0.0
    wide: float = 0.45
    span_jitter: tuple[float, ...] = (SPAN_JITTER,)
    near_jitter: tuple[float, ...] = (NEAR_JITTER,)


WITH_CLASSES = Stages()
# The crops of a class-agnostic detector are often much too small or too large. If they never were in training, it would
# learn that an object always fills its crop.
CLASS_AGNOSTIC = Stages(frustum=0.1, depth=0.3, wide=0.3, span_jitter=(0.06, 0.1, 0.3), near_jitter=(0.06, 0.06, 0.25))
# Crops along the depth: share of those at the depth of the object itself, and the range of their lengths in multiples
# of the image box's longer side.
AT_OBJECT_SHARE, CROP_LENGTHS = 0.75, (0.7, 4.0)


@dataclass(frozen=True, eq=False)
class TaughtObject:
    """An object whose 3D extent is known.

    Attributes:
        box: camera frame; for silhouettes, it cuts the object's points out of the cloud.
        points: (n,) mask of the object's points in the frame's cloud; None means those inside the box.
    """

    label: str
    box: OrientedBox
    points: Bool[np.ndarray, "n"] | None = None


@dataclass(frozen=True, eq=False)
class TaughtView:
    """A pseudo-view, the boxes on it, and for each box the index of its object."""

    view: PseudoView
    boxes: tuple[Box2D, ...]
    objects: tuple[int, ...]


def project_box(view: PseudoView, box: OrientedBox, label: str) -> Box2D | None:
    """The 2D box of a 3D box on a view, clipped to the view; None if it lies outside."""
    return span_on_view(view, box_corners(box), label)


def span_on_view(view: PseudoView, xyz_m: Float[np.ndarray, "n 3"], label: str) -> Box2D | None:
    """The 2D box around points (camera frame, metres) on a view, clipped to the view; None if outside or below 1 px."""
    on_view = xyz_m @ view.axes[:2].T
    low, high = on_view.min(axis=0), on_view.max(axis=0)
    if (high - low <= 0).any():
        return None
    raw = view.box_px(np.stack([low, high], axis=1), label)
    height_px, width_px = view.rgb.shape[:2]
    x_min, x_max = np.clip([raw.x_min, raw.x_max], -0.5, width_px - 0.5)
    y_min, y_max = np.clip([raw.y_min, raw.y_max], -0.5, height_px - 0.5)
    if x_max - x_min < 1 or y_max - y_min < 1:
        return None
    return Box2D(label, float(x_min), float(y_min), float(x_max), float(y_max))


def teach_views(
    frame: Frame,
    objects: Sequence[TaughtObject],
    kind: BoxKind | None,
    draws: int,
    config: RcvConfig,
    up: Float64[np.ndarray, "3"] | None,
    rng: np.random.Generator,
    doubtful: Sequence[OrientedBox] = (),
    targets: Sequence[int] | None = None,
) -> list[TaughtView]:
    """Front and side views of each object along `draws` random axes and crops, with all objects labelled.

    For a class-agnostic detector, only the object that a crop is about is labelled. It gets two boxes, one of each
    class of `AGNOSTIC_LABELS`: around its 3D box, and around its points on the view. A crop that misses it has none.

    Args:
        kind: what the 2D boxes measure; None: for a class-agnostic detector.
        draws: number of random crops per object; each gives two views.
        up: unit vector against gravity for upright objects, whose views are level; None for free ones.
        doubtful: boxes of possible further objects. Views that show enough of such an object for a label are left out,
            because they would train the detector to treat it as background.
        targets: indices of the objects to take crops of; None = all.
    """
    masks = [o.points if o.points is not None else contains(o.box, frame.cloud.xyz_m) for o in objects]
    totals = [int(mask.sum()) for mask in masks]
    known = np.logical_or.reduce(masks) if masks else np.zeros(len(frame.cloud), bool)
    doubts = [contains(box, frame.cloud.xyz_m) & ~known for box in doubtful]
    scene, stages = _Scene(frame, objects, masks, doubts), CLASS_AGNOSTIC if kind is None else WITH_CLASSES
    taught: list[TaughtView] = []
    for index in range(len(objects)) if targets is None else targets:
        if kind is not None and totals[index] < MIN_POINTS:
            continue
        # all crops except the frustum are close to the object, so most points of a large cloud can be skipped
        near = scene.near(objects[index].box)
        for _ in range(draws):
            drawn = _draw(scene, near, index, stages, config, up, rng)
            if drawn is not None:
                views, shown = drawn
                labelled = [index] if kind is None else range(len(objects))
                labelled = [n for n in labelled if is_shown(len(shown[n]), totals[n])]
                taught += [_label(view, [(n, objects[n], shown[n]) for n in labelled], kind) for view in views]
    return taught


@dataclass(frozen=True, eq=False)
class _Scene:
    """A frame, its objects, and the point masks of the objects and of the doubtful boxes."""

    frame: Frame
    objects: Sequence[TaughtObject]
    masks: Sequence[np.ndarray]
    doubts: Sequence[np.ndarray]

    def near(self, box: OrientedBox) -> _Scene:
        """The part of the scene within reach of any crop around a box."""
        distance = np.linalg.norm(self.frame.cloud.xyz_m - box.center_m.astype(np.float32), axis=1)
        keep = distance < 1.5 * np.linalg.norm(box.size_m)
        frame = replace(self.frame, cloud=self.frame.cloud.select(keep))
        return _Scene(frame, self.objects, [mask[keep] for mask in self.masks], [mask[keep] for mask in self.doubts])

    def shows_doubtful(self, keep: np.ndarray, whole: _Scene) -> bool:
        """True if the points of `keep` show enough of a doubtful object for a label."""
        pairs = zip(self.doubts, whole.doubts, strict=True)
        return any(is_shown(int((mask & keep).sum()), int(whole_mask.sum())) for mask, whole_mask in pairs)


def _draw(
    whole: _Scene,
    near: _Scene,
    index: int,
    stages: Stages,
    config: RcvConfig,
    up: np.ndarray | None,
    rng: np.random.Generator,
) -> tuple[Sequence[PseudoView], list[np.ndarray]] | None:
    """The views of a random crop, and each object's points in it; None if they cannot be labelled."""
    scene, target, choice = near, whole.objects[index], rng.random()
    xyz = scene.frame.cloud.xyz_m
    if choice < stages.frustum + stages.depth:
        box = _image_box(whole.frame, target, rng)
        if box is None:
            return None
        scene, xyz = whole, whole.frame.cloud.xyz_m
        keep, axes, show = in_frustum(scene.frame.camera, xyz, box), camera_axes(up), None
        target_mask = whole.masks[index]
        if not is_shown(int((target_mask & keep).sum()), int(target_mask.sum())):
            return None  # mostly behind the camera or outside the image; the visible rest would be background
        if choice >= stages.frustum:
            keep = _along_depth(scene.frame, keep, target_mask, box, rng)
        elif stages.depth and is_deep(scene.frame.cloud.select(keep)):
            return None  # class-agnostic detectors see deep frustums only as crops
    elif choice < stages.frustum + stages.depth + stages.wide:
        crop = _camera_crop(target.box, up, _one_of(stages.span_jitter, rng), rng)
        keep, axes, show = contains(crop, xyz), face_camera(_random_turn(up, rng), up), box_corners(crop)
    else:
        crop = _near_crop(target.box, up, _one_of(stages.near_jitter, rng), rng)
        turned = _small_turn(NEAR_TURN_RAD, up, rng) @ crop.rotation
        keep, axes, show = contains(crop, xyz), face_camera(turned.T, up), box_corners(crop)
    if keep.sum() < MIN_POINTS or scene.shows_doubtful(keep, whole):
        return None
    cloud = scene.frame.cloud.select(keep)
    views: Sequence[PseudoView]
    if show is None:
        views = frustum_views(cloud, axes, config, enlarge_deep=not stages.depth)
    else:
        views = render_pairs(cloud, [axes], config.view_px, show)
    return views, [xyz[mask & keep] for mask in scene.masks]


def _along_depth(
    frame: Frame,
    in_box: np.ndarray,
    target_mask: np.ndarray,
    image_box: Box2D,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "n"]:
    """A random crop along the depth of a frustum, mostly at the object's own depth."""
    inside = np.flatnonzero(in_box)
    xyz = frame.cloud.xyz_m[inside]
    if rng.random() < AT_OBJECT_SHARE:
        depths = frame.cloud.xyz_m[target_mask & in_box, 2]
    else:
        depths = xyz[in_middle(frame.camera, xyz, image_box), 2]
    depth = float(np.percentile(depths, rng.uniform(0, 100)))
    length = width_at(frame.camera, image_box, depth) * np.exp(rng.uniform(*np.log(CROP_LENGTHS)))
    keep = np.zeros(len(in_box), np.bool_)
    keep[inside[depth_crop(xyz, depth, length)]] = True
    return keep


def _one_of(values: Sequence[float], rng: np.random.Generator) -> float:
    return values[0] if len(values) == 1 else float(rng.choice(values))


def _label(view: PseudoView, shown: Sequence[tuple[int, TaughtObject, np.ndarray]], kind: BoxKind | None) -> TaughtView:
    """Labels objects, given with their indices and points, with a box of the kind, or without one of each kind."""
    found: list[tuple[Box2D, int]] = []
    for index, item, xyz_m in shown:
        for each, label in AGNOSTIC_LABELS.items() if kind is None else [(kind, item.label)]:
            box = span_on_view(view, box_corners(item.box) if each is BoxKind.BOX else xyz_m, label)
            found += [] if box is None else [(box, index)]
    return TaughtView(view, tuple(box for box, _ in found), tuple(index for _, index in found))


def is_shown(points: int, total: int) -> bool:
    """True if `points` of an object's `total` points are enough for a label."""
    return points >= max(MIN_POINTS, MIN_SHARE * total)


def _image_box(frame: Frame, target: TaughtObject, rng: np.random.Generator) -> Box2D | None:
    exact = box_on_image(frame.camera, target.box, target.label)
    if exact is None:
        return None
    low, high = np.array(exact.xyxy).reshape(2, 2)
    shift = rng.normal(0, IMAGE_JITTER, 4) * np.tile(high - low, 2)
    low, high = low + shift[:2], high + shift[2:]
    if (high - low < 2).any():
        return None
    return Box2D(target.label, float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _camera_crop(box: OrientedBox, up: np.ndarray | None, jitter: float, rng: np.random.Generator) -> OrientedBox:
    """A random first cross-view box along the camera axes, slightly inaccurate and usually too large."""
    axes = camera_axes(up)
    along = box_corners(box) @ axes.T
    spans = np.stack([along.min(axis=0), along.max(axis=0)], axis=1)
    reach = spans[:, 1] - spans[:, 0]
    shift = rng.normal(jitter / 2, jitter, (3, 2)) * reach[:, None]
    spans = spans + shift * np.array([-1.0, 1.0])
    return span_box(axes, spans)


def _near_crop(box: OrientedBox, up: np.ndarray | None, jitter: float, rng: np.random.Generator) -> OrientedBox:
    """A random, nearly correct box."""
    turn = _small_turn(NEAR_TURN_RAD / 2, up, rng)
    center = box.center_m + box.rotation @ (rng.normal(0, jitter / 2, 3) * box.size_m)
    size = box.size_m * (1 + jitter + rng.normal(0, jitter, 3)).clip(min(0.8, 1 - 2 * jitter), 1.5 + jitter)
    return OrientedBox.from_parts(center, turn @ box.rotation, size)


def _small_turn(sigma_rad: float, up: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(0, sigma_rad) * up if up is not None else rng.normal(0, sigma_rad, 3)
    return Rotation.from_rotvec(vector).as_matrix()


def _random_turn(up: np.ndarray | None, rng: np.random.Generator) -> np.ndarray:
    if up is not None:
        return camera_axes(up) @ Rotation.from_rotvec(rng.uniform(0, 2 * np.pi) * up).as_matrix().T
    return Rotation.random(rng=rng).as_matrix()
