"""The whole box of an object that was drawn as it is seen.

A drawn silhouette bounds the object from inside. Across the view its ends are known. What is unknown lies behind what
is seen, and two things tell about it:

- **The same object in other frames**, from other sides. What was seen of it there is registered with this frame
  (`geometry.registration`). Points that this frame shows to be empty are left out: an object that moves its limbs is
  not there any more. If the points show the object from all around, the tightest box around them is its whole box.
- **The detector**, if it was taught whole boxes: the drawn box is extended, away from the camera only, to where such an
  object ends.

A box is never smaller than the drawn one. docs/base_detector.md has the measurements.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree

from annotator.geometry.iou import iou_3d
from annotator.geometry.normals import normals_knn
from annotator.geometry.oriented_box import tightest_box
from annotator.geometry.projection import every_nth, project
from annotator.geometry.registration import Pose, register_surface, share_found
from annotator.rcv.config import AGNOSTIC_LABELS, RcvConfig
from annotator.rcv.measure import make_pair
from annotator.rcv.pseudo_view import render_pairs
from annotator.rcv.rotations import face_camera, free_grid, yaw_grid
from annotator.types import Box2D, BoxKind, Camera, Detector, Frame, OrientedBox, PointCloud

# Points of an object that are kept, that are registered, and that an object in another frame adds.
MOST_POINTS, REGISTERED_POINTS, ADDED_POINTS = 3000, 800, 600
# Neighbours and multiple of the median distance to them beyond which a point is noise at an edge.
NOISE_NEIGHBOURS, NOISE_DISTANCE = 8, 2.5
# Distance at which registration looks for counterparts, and at which a point is found again, shares of the mean side.
REACH, TOLERANCE = 0.2, 0.03
# Two frames show the same object if at least this share of the points of one is found in the other one, and if its
# middle has moved by less than this share of its mean side.
SAME_SHARE, MOST_MOVED = 0.6, 1.0
# An object is looked for in at most this many frames before, and after; each takes some 0.1 s once.
MOST_FRAMES = 60
# The surface is closed if its mean normal is shorter than this (a plane: 1, a closed surface: 0). A person who turns
# around once has 0.03, objects seen from one side have 0.5 to 0.8.
CLOSED = 0.4
# Of upright objects, the horizontal part of the normals counts where it is at least so long. At least this share of the
# surface must have it: the top of a table says nothing about its sides.
STEEP, STEEP_SHARE = 0.5, 0.2
# Share of the surface whose normals must be known.
KNOWN_SHARE = 0.5
# Nothing is offered for fewer points, or if they spread across a line by less than this share of their spread along it.
MIN_POINTS, LINE = 10, 1e-3
# Side of the cells in which normals are averaged, share of the mean side.
CELL = 0.05
# Offered boxes with a larger IoU are the same.
SAME_BOX_IOU = 0.9


@dataclass(frozen=True, eq=False)
class SeenObject:
    """What a frame shows of a drawn object.

    Attributes:
        image_box: drawn on the camera image; has the object's class.
        rotation: columns = axes of the drawn box.
        xyz_m: (n, 3) a sample of the points inside all drawn boxes, without noise at edges, camera frame.
        normals: (n, 3) unit vectors towards the camera.
        up: unit vector against gravity for upright boxes, None for free ones.
        nearest_m: (rows, columns) depth of the nearest point of the frame in each cell of the image box; infinite
            without a point.
        links: to the same object in other frames, as far as they were looked for.
    """

    image_box: Box2D
    rotation: Float64[np.ndarray, "3 3"]
    xyz_m: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]
    up: Float64[np.ndarray, "3"] | None
    camera: Camera
    nearest_m: Float64[np.ndarray, "rows columns"]
    links: WeakKeyDictionary[SeenObject, Link | None] = field(default_factory=WeakKeyDictionary, repr=False)

    @classmethod
    def of(
        cls,
        frame: Frame,
        mask: Bool[np.ndarray, "n"],
        image_box: Box2D,
        rotation: Float64[np.ndarray, "3 3"],
        up: Float64[np.ndarray, "3"] | None,
    ) -> SeenObject:
        """From the mask of an object's points in the frame's cloud; it needs at least one."""
        xyz_m = _without_noise(every_nth(frame.cloud.xyz_m[mask].astype(np.float64), MOST_POINTS))
        normals = normals_knn(xyz_m.astype(np.float32)).astype(np.float64)
        nearest = _nearest_m(frame, image_box, int(mask.sum()))
        return cls(image_box, rotation, xyz_m, normals, up, frame.camera, nearest)

    @cached_property
    def tree(self) -> KDTree:
        """Of the points."""
        return KDTree(self.xyz_m)

    @cached_property
    def middle_m(self) -> Float64[np.ndarray, "3"]:
        """Mean of the points."""
        return np.asarray(self.xyz_m.mean(axis=0))

    @cached_property
    def side_m(self) -> float:
        """Mean extent of the points along the camera's axes."""
        return float(np.ptp(self.xyz_m, axis=0).mean())

    def may_be_at(self, xyz_m: Float64[np.ndarray, "k 3"]) -> Bool[np.ndarray, "k"]:
        """Which points the object may have: inside the image box, and not in front of what the frame shows there."""
        box = self.image_box
        uv = project(self.camera, xyz_m)
        low, size = np.array([box.x_min, box.y_min]), np.array([box.width_px, box.height_px])
        cells = np.array(self.nearest_m.shape[::-1])
        place = (uv - low) / size * cells
        inside = ((place > -1) & (place < cells + 1)).all(axis=1)
        column, row = np.clip(np.where(inside[:, None], place, 0).astype(np.intp), 0, cells - 1).T
        return np.asarray(inside & (xyz_m[:, 2] >= self.nearest_m[row, column] - TOLERANCE * self.side_m))


@dataclass(frozen=True)
class Offered:
    """A whole box, and whether the object was seen from all around."""

    box: OrientedBox
    is_closed: bool


def whole_boxes(
    seen: SeenObject,
    cloud: PointCloud,
    before: Iterable[Sequence[SeenObject]],
    after: Iterable[Sequence[SeenObject]],
    view: Detector | None,
    config: RcvConfig,
) -> list[Offered]:
    """The boxes that the whole object may have, best first; none for too few points or points on a line.

    Args:
        cloud: its points in this frame, for the detector.
        before, after: the drawn objects of the same class in the other frames of the recording, the nearest frame
            first; read only as far as the object can be followed.
        view: detector for pseudo-views, or None.
    """
    if len(seen.xyz_m) < MIN_POINTS or _is_line(seen.xyz_m):
        return []
    xyz_m, normals = _from_all_frames(seen, before, after)
    grid = free_grid() if seen.up is None else yaw_grid(seen.up)
    if _mean_normal(xyz_m, normals, seen) < CLOSED:
        return [Offered(tightest_box(_without_noise(xyz_m), grid, seen.up), True)]
    boxes = [_extended(seen, cloud, view, config), tightest_box(seen.xyz_m, grid, seen.up)]
    return [Offered(box, False) for box in _different(boxes)]


def _different(boxes: Sequence[OrientedBox]) -> list[OrientedBox]:
    kept: list[OrientedBox] = []
    for box in boxes:
        if all(iou_3d(box, other) < SAME_BOX_IOU for other in kept):
            kept.append(box)
    return kept


def _from_all_frames(
    seen: SeenObject, before: Iterable[Sequence[SeenObject]], after: Iterable[Sequence[SeenObject]]
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """The object's points in this frame, and those of other frames that it may have here; with their normals."""
    points, normals = [seen.xyz_m], [seen.normals]
    for others in (before, after):
        for other, (rotation, translation) in _followed(seen, others):
            moved = every_nth(other.xyz_m, ADDED_POINTS) @ rotation.T + translation
            possible = seen.may_be_at(moved)
            points.append(moved[possible])
            normals.append((every_nth(other.normals, ADDED_POINTS) @ rotation.T)[possible])
    return np.concatenate(points), np.concatenate(normals)


def _followed(seen: SeenObject, frames: Iterable[Sequence[SeenObject]]) -> Iterator[tuple[SeenObject, Pose]]:
    """The same object in frame after frame, each with the pose that brings its points here, until it is not found."""
    here, last = (np.eye(3), np.zeros(3)), seen
    for candidates in islice(frames, MOST_FRAMES):
        links = [(link(last, other), other) for other in candidates if _is_near(last, other)]
        found = max(
            ((one, other) for one, other in links if one is not None), key=lambda pair: pair[0].share, default=None
        )
        if found is None or found[0].share < SAME_SHARE:
            return
        (rotation, translation), last = found[0].pose, found[1]
        turned = here[0] @ rotation
        here = (turned, here[0] @ translation + here[1])
        yield last, here


def _is_near(a: SeenObject, b: SeenObject) -> bool:
    return float(np.linalg.norm(a.middle_m - b.middle_m)) < MOST_MOVED * a.side_m


@dataclass(frozen=True, eq=False)
class Link:
    """The pose that brings an object's points into another frame, and the share of the points found again."""

    pose: Pose
    share: float


def link(to: SeenObject, other: SeenObject) -> Link | None:
    """Registers an object's points with those of another frame, once; None if too few are near."""
    if other not in to.links:
        to.links[other] = _registered(to, other)
    return to.links[other]


def _registered(to: SeenObject, other: SeenObject) -> Link | None:
    points = every_nth(other.xyz_m, REGISTERED_POINTS)
    start = (np.eye(3), to.middle_m - other.middle_m)
    pose = register_surface(points, to.tree, to.normals, start, REACH * to.side_m, to.up)
    if pose is None:
        return None
    rotation, translation = pose
    back = (rotation.T, -rotation.T @ translation)
    tolerance = TOLERANCE * to.side_m
    there = share_found(every_nth(to.xyz_m, ADDED_POINTS), other.tree, back, tolerance)
    return Link(pose, max(share_found(points, to.tree, pose, tolerance), there))


def _is_line(xyz_m: Float64[np.ndarray, "n 3"]) -> bool:
    """True for points on a line, or at one place."""
    along, across, _ = np.linalg.svd(xyz_m - xyz_m.mean(axis=0), compute_uv=False)
    return bool(across <= LINE * along)


def _mean_normal(xyz_m: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"], seen: SeenObject) -> float:
    """Length of a surface's mean normal over cells of equal size, of upright objects without the vertical part.

    Each cell counts by the length of the part that counts; 1 if too little of the surface tells.
    """
    cells = np.unique(np.floor(xyz_m / (CELL * seen.side_m)).astype(int), axis=0, return_inverse=True)[1].ravel()
    sums = np.stack([np.bincount(cells, normals[:, axis]) for axis in range(3)], axis=1)
    known = sums[np.linalg.norm(sums, axis=1) > 1e-9]
    if len(known) < KNOWN_SHARE * len(sums):
        return 1.0
    unit = known / np.linalg.norm(known, axis=1, keepdims=True)
    if seen.up is not None:
        level = unit - np.outer(unit @ seen.up, seen.up)
        unit = level[np.linalg.norm(level, axis=1) > STEEP]
        if len(unit) < STEEP_SHARE * len(known):
            return 1.0
    return float(np.linalg.norm(unit.sum(axis=0)) / np.linalg.norm(unit, axis=1).sum())


def _extended(seen: SeenObject, cloud: PointCloud, view: Detector | None, config: RcvConfig) -> OrientedBox:
    """The box around the points along the drawn axes, extended away from the camera to where the detector ends it."""
    axes = face_camera(seen.rotation.T, seen.up)
    along = seen.xyz_m @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    ends = None if view is None else _detected_ends(seen.image_box.label, cloud, axes, view, config)
    if ends is not None:
        middle = axes.T @ ((low + high) / 2)
        is_away = axes @ middle >= 0
        low, high = (
            np.where(is_away, low, np.minimum(low, ends[:, 0])),
            np.where(is_away, np.maximum(high, ends[:, 1]), high),
        )
    return OrientedBox.from_parts(axes.T @ ((low + high) / 2), axes.T, np.maximum(high - low, 1e-4))


def _detected_ends(
    name: str, cloud: PointCloud, axes: Float64[np.ndarray, "3 3"], view: Detector, config: RcvConfig
) -> Float64[np.ndarray, "3 2"] | None:
    """Where the detector ends the whole object along the axes; None if it does not find it on both views."""
    label = AGNOSTIC_LABELS[BoxKind.BOX] if config.class_agnostic else name
    front, side = render_pairs(cloud, [axes], config.view_px, None)
    found = [
        [box for box in boxes if box.label == label and box.score >= config.min_view_score]
        for boxes in view.detect([front, side])
    ]
    if not all(found):
        return None
    return make_pair((front, side), found[0][0], found[1][0]).spans_m


def _nearest_m(frame: Frame, image_box: Box2D, points: int) -> Float64[np.ndarray, "rows columns"]:
    """Cells with about four of the object's points each."""
    size = np.array([image_box.width_px, image_box.height_px])
    cells = np.maximum((size / np.sqrt(size.prod() * 4 / max(points, 1))).astype(int), 1)
    xyz_m = frame.cloud.xyz_m
    ahead = xyz_m[xyz_m[:, 2] > 0].astype(np.float64)
    place = (project(frame.camera, ahead) - [image_box.x_min, image_box.y_min]) / size * cells
    inside = ((place >= 0) & (place < cells)).all(axis=1)
    column, row = place[inside].astype(np.intp).T
    nearest = np.full(tuple(cells[::-1]), np.inf)
    np.minimum.at(nearest, (row, column), ahead[inside, 2])
    return nearest


def _without_noise(xyz_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "k 3"]:
    """Without points far from their neighbours, such as those between an edge and the background."""
    if len(xyz_m) <= 4 * NOISE_NEIGHBOURS:
        return xyz_m
    distances = KDTree(xyz_m).query(xyz_m, k=NOISE_NEIGHBOURS + 1)[0][:, 1:].mean(axis=1)
    return xyz_m[distances <= NOISE_DISTANCE * np.median(distances)]
