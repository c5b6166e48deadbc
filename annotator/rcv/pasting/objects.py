"""Reviewed objects, cut out of their frames and put into others at another place.

An object is carried about the camera, so that the side that was seen still faces it, turned a little, and moved away,
never nearer, since nothing is known between its points. Points that the sensor would not measure at the new place are
left out: those between its lines of sight at the new distance, and those behind something nearer. What the object hides
is removed from the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy import ndimage
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.occlusion import Sight
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.projection import inside_image, project, undistort_px
from annotator.geometry.sight_grid import SightGrid, kept_by_coarser
from annotator.rcv.teach import TaughtObject
from annotator.types import Frame, OrientedBox, PointCloud

# Objects with fewer points are not cut out, and pasted ones keep at least as many.
MIN_POINTS = 20
# Objects are cut out whole: the share of the box that lies in the image, and that something nearer hides.
MIN_IN_IMAGE, MOST_HIDDEN = 0.8, 0.2
# Points spread evenly over a box, in shares of its sides.
LATTICE = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 7)] * 3), axis=-1).reshape(-1, 3)
LATTICE.flags.writeable = False
# What an object is connected to (the arm of a hand) comes along: up to this distance, share of its longest side.
# Without it, the object would seem to end where it was cut off. Connected are points in voxels that touch.
ATTACHED, VOXELS_A_SIDE = 0.5, 32
# Share of the points that must remain: of a pasted object, and of the objects that it partly hides.
MIN_VISIBLE = 0.5
# How far the box is grown, share of its longest side: labels end a little inside their objects.
GROWN = 0.02
# The largest turn, which shows little of what was not seen, and how much farther an object is moved at most.
MOST_TURN_RAD, MOST_FARTHER = np.radians(30), 2.5
# Places are drawn in the middle of the image, of this share of its sides.
MIDDLE = 0.9
# Ground: heights that differ by this share of the object's height are the same; points needed to know it; and how much
# higher or lower it may be at the new place, share of the object's height.
SAME_HEIGHT, MIN_GROUND, MOST_HIGHER = 0.15, 5, 0.5
# Share of the points on a place that must be level, and the distances to search for ground, in radii of the object.
LEVEL_SHARE, GROUND_RADII = 0.5, (1.0, 2.0, 4.0)
# A place is taken if more points of the frame than these lie in the middle of the box.
MOST_INSIDE, INSIDE = 3, 0.9


@dataclass(frozen=True, eq=False)
class Cutout:
    """An object's points, cut out of its frame.

    Attributes:
        label: class name.
        box: around the object, camera frame.
        cloud: its points and those of what it is connected to, camera frame, without those of the ground.
        own: (n,) mask of its points in this cloud.
        grid: the sensor.
        up: unit vector against gravity in the camera frame; None for freely rotated objects.
        ground_m: distance of the box's centre above the ground; None if there is no ground around the object.
    """

    label: str
    box: OrientedBox
    cloud: PointCloud
    own: Bool[np.ndarray, "n"]
    grid: SightGrid
    up: Float64[np.ndarray, "3"] | None
    ground_m: float | None


@dataclass(frozen=True, eq=False)
class PastedFrame:
    """A frame with a pasted object.

    Attributes:
        frame: without depth image and pixel indices, which would not fit.
        objects: all objects of the frame with their points; the pasted one is the last.
        source_m: (n, 3) where the pasted object's visible points were in the frame of the cut-out, metres.
        visible: share of the pasted object's points that are visible.
    """

    frame: Frame
    objects: tuple[TaughtObject, ...]
    source_m: Float[np.ndarray, "n 3"]
    visible: float


@dataclass(frozen=True, eq=False)
class Target:
    """A frame to paste into.

    Attributes:
        objects: its known objects.
        doubtful: boxes of possible further objects.
        up: as in `Cutout`.
    """

    frame: Frame
    objects: tuple[TaughtObject, ...]
    doubtful: tuple[OrientedBox, ...]
    up: Float64[np.ndarray, "3"] | None
    grid: SightGrid


def cut_objects(
    frame: Frame, objects: Sequence[TaughtObject], up: Float64[np.ndarray, "3"] | None
) -> list[Cutout | None]:
    """The points of each object; None for one that has too few, or that the image's border or something nearer cuts.

    Such an object would end in the open where it was cut.

    Args:
        objects: known by their boxes, which are slightly grown.
        up: None for freely rotated objects, whose support is not known.
    """
    grid, sight = SightGrid.of(frame), Sight(frame.cloud.xyz_m)
    return [_cut(frame, item, up, grid, sight) for item in objects]


def _cut(
    frame: Frame, item: TaughtObject, up: Float64[np.ndarray, "3"] | None, grid: SightGrid, sight: Sight
) -> Cutout | None:
    xyz, box, margin_m = frame.cloud.xyz_m, item.box, GROWN * float(item.box.size_m.max())
    whole_m = (LATTICE * box.size_m) @ box.rotation.T + box.center_m
    if inside_image(frame.camera, project(frame.camera, whole_m)).mean() < MIN_IN_IMAGE:
        return None
    if sight.hidden(box, margin_m).share > MOST_HIDDEN:
        return None
    mask, ground_m = contains(box, xyz, margin_m), None
    around = contains(box, xyz, ATTACHED * float(box.size_m.max())) & ~mask
    if up is not None:
        height_m, tall = xyz @ up, _height(box, up)
        ground = _ground_around(xyz, mask, box, up)
        if ground is None:
            level_m = _bottom(box, up)
            mask = mask & (height_m >= level_m)
        else:
            level_m, noise_m = ground
            ground_m = float(box.center_m @ up) - level_m
            mask = mask & (height_m > level_m + min(3 * noise_m, SAME_HEIGHT * tall))
        around &= height_m > level_m + SAME_HEIGHT * tall
    if mask.sum() < MIN_POINTS:
        return None
    whole = mask | _attached(xyz, mask, around, VOXELS_A_SIDE / float(box.size_m.max()))
    cloud = replace(frame.cloud.select(whole), pixel_index=None, normals=None)
    return Cutout(item.label, box, cloud, mask[whole], grid, up, ground_m)


def _attached(
    xyz_m: Float[np.ndarray, "n 3"], own: Bool[np.ndarray, "n"], around: Bool[np.ndarray, "n"], voxels_per_m: float
) -> Bool[np.ndarray, "n"]:
    """Which points of `around` are connected to those of `own`, through voxels that touch."""
    near = np.flatnonzero(own | around)
    voxels = np.floor(xyz_m[near].astype(np.float64) * voxels_per_m).astype(np.int64)
    voxels -= voxels.min(axis=0)
    filled = np.zeros(voxels.max(axis=0) + 1, np.bool_)
    filled[tuple(voxels.T)] = True
    parts = ndimage.label(filled, np.ones((3, 3, 3)))[0][tuple(voxels.T)]
    connected = np.zeros(len(xyz_m), np.bool_)
    connected[near] = np.isin(parts, parts[own[near]])
    return connected & around


def can_paste(cutout: Cutout, target: Target) -> bool:
    """Whether both frames are of the same kind of sensor, and gravity is known in both or in none."""
    ours, theirs = cutout.cloud, target.frame.cloud
    same_sensor = (cutout.grid.camera is None) == (target.grid.camera is None)
    same_colours = (ours.rgb is None) == (theirs.rgb is None)
    same_reflectance = (ours.reflectance is None) == (theirs.reflectance is None)
    return same_sensor and same_colours and same_reflectance and (cutout.up is None) == (target.up is None)


def paste(cutout: Cutout, target: Target, rng: np.random.Generator) -> PastedFrame | None:
    """The frame with the object at a random place; None if the place is taken, or too little of it would be seen.

    Args:
        target: another frame, for which `can_paste` is true.
    """
    placed = _place(cutout, target, rng)
    if placed is None or _is_taken(placed, target):
        return None
    rotation = placed.rotation @ cutout.box.rotation.T
    old, new = cutout.box.center_m, placed.center_m
    farther = float(np.linalg.norm(new) / np.linalg.norm(old))
    if farther < 1:
        return None
    steps = zip(target.grid.step_rad, cutout.grid.step_rad, strict=True)
    across, down = (farther * ours / theirs for ours, theirs in steps)
    phase_x, phase_y = rng.random(2).tolist()
    kept = kept_by_coarser(cutout.grid.cells(cutout.cloud.xyz_m), (across, down), (phase_x, phase_y))
    sampled = cutout.cloud.select(kept)
    moved_m = ((sampled.xyz_m.astype(np.float64) - old) @ rotation.T + new).astype(np.float32)
    scene_m, camera = target.frame.cloud.xyz_m, target.frame.camera
    # one after the other: together, the object's points would be seen through the gaps of a nearer surface
    hidden = target.grid.hides(scene_m, moved_m) | target.grid.hides(moved_m, moved_m)
    seen, own = inside_image(camera, project(camera, moved_m)) & ~hidden, cutout.own[kept]
    visible = float((seen & own).sum() / max(own.sum(), 1))
    if (seen & own).sum() < MIN_POINTS or visible < MIN_VISIBLE:
        return None
    stays = ~target.grid.hides(moved_m[seen], scene_m)
    masks = [o.points if o.points is not None else contains(o.box, scene_m) for o in target.objects]
    if any((mask & stays).sum() < MIN_VISIBLE * mask.sum() for mask in masks):
        return None
    new_points = replace(sampled.select(seen), xyz_m=moved_m[seen])
    frame = replace(target.frame, cloud=_joined(target.frame.cloud.select(stays), new_points), depth_m=None)
    objects = [
        replace(item, points=np.append(mask[stays], np.zeros(len(new_points), np.bool_)))
        for item, mask in zip(target.objects, masks, strict=True)
    ]
    points = np.append(np.zeros(int(stays.sum()), np.bool_), own[seen])
    objects.append(TaughtObject(cutout.label, placed, points))
    return PastedFrame(frame, tuple(objects), sampled.xyz_m[seen & own], visible)


def _joined(scene: PointCloud, more: PointCloud) -> PointCloud:
    def both(a: np.ndarray | None, b: np.ndarray | None) -> np.ndarray | None:
        return None if a is None or b is None else np.concatenate([a, b])

    return PointCloud(
        np.concatenate([scene.xyz_m, more.xyz_m]), both(scene.rgb, more.rgb), both(scene.reflectance, more.reflectance)
    )


def _place(cutout: Cutout, target: Target, rng: np.random.Generator) -> OrientedBox | None:
    """The box at a random place; None without ground there, if it stood on some."""
    camera, old = target.frame.camera, cutout.box.center_m
    middle = 0.5 + MIDDLE * (rng.random(2) - 0.5)
    px = middle * (camera.width_px, camera.height_px) - 0.5
    ray = np.append(undistort_px(camera, px[None])[0], 1.0)
    # of a finer sensor's points, the same number must be given: farther away, they are as dense as measured
    steps = zip(cutout.grid.step_rad, target.grid.step_rad, strict=True)
    farther = max(1.0, *(theirs / ours for theirs, ours in steps)) * MOST_FARTHER ** rng.random()
    if not np.isfinite(ray).all():
        return None
    turn_rad = rng.uniform(-MOST_TURN_RAD, MOST_TURN_RAD)
    if cutout.up is None or target.up is None:
        carried = _shortest_turn(old, ray)
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(turn_rad * axis / np.linalg.norm(axis)) * carried
        center = carried.apply(old) * farther
    else:
        up = target.up
        level = _shortest_turn(cutout.up, up)
        before, after = _level(level.apply(old), up), _level(ray, up)
        if min(np.linalg.norm(before), np.linalg.norm(after)) < 1e-6:
            return None
        angle = np.arctan2(np.cross(before, after) @ up, before @ after)
        carried = Rotation.from_rotvec(angle * up) * level
        turn = Rotation.from_rotvec(turn_rad * up) * carried
        center = _level(carried.apply(old), up) * farther + (carried.apply(old) @ up) * up
        if cutout.ground_m is not None:
            ground = _ground_at(target.frame.cloud.xyz_m, center, cutout.box, turn, up)
            if ground is None:
                return None
            higher = ground + cutout.ground_m - float(center @ up)
            if abs(higher) > MOST_HIGHER * _height(cutout.box, cutout.up):
                return None
            center = center + higher * up
    return OrientedBox.from_parts(center, turn.as_matrix() @ cutout.box.rotation, cutout.box.size_m)


def _is_taken(box: OrientedBox, target: Target) -> bool:
    others = [*(item.box for item in target.objects), *target.doubtful]
    if any(iou_3d(box, other) > 0 for other in others):
        return True
    shift, size = np.zeros(3), INSIDE * box.size_m
    if target.up is not None:  # the ground may reach into the box
        cut = SAME_HEIGHT * _height(box, target.up)
        vertical = int(np.argmax(np.abs(target.up @ box.rotation)))
        size[vertical] = max(size[vertical] - cut, 1e-3)
        shift = target.up * cut / 2
    middle = OrientedBox.from_parts(box.center_m + shift, box.rotation, size)
    return int(contains(middle, target.frame.cloud.xyz_m).sum()) > MOST_INSIDE


def _shortest_turn(source: np.ndarray, goal: np.ndarray) -> Rotation:
    """The rotation about the origin that turns one direction into another one, by the smallest angle."""
    a, b = source / np.linalg.norm(source), goal / np.linalg.norm(goal)
    axis = np.cross(a, b)
    length = float(np.linalg.norm(axis))
    if length < 1e-9:  # the same direction; opposite ones do not occur in front of a camera
        return Rotation.identity()
    return Rotation.from_rotvec(axis / length * np.arctan2(length, a @ b))


def _level(vector: np.ndarray, up: np.ndarray) -> np.ndarray:
    return np.asarray(vector - (vector @ up) * up)


def _height(box: OrientedBox, up: np.ndarray) -> float:
    return float(np.abs(up @ box.rotation) @ box.size_m)


def _bottom(box: OrientedBox, up: np.ndarray) -> float:
    return float(box.center_m @ up) - _height(box, up) / 2


def _radius(box: OrientedBox, up: np.ndarray) -> float:
    """Of the circle around the box, as seen from above."""
    return max(float(np.linalg.norm(_level(corner - box.center_m, up))) for corner in box_corners(box))


def _distances(xyz_m: np.ndarray, center_m: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Horizontal distances of points from a centre."""
    offset = xyz_m - center_m.astype(np.float32)
    above = offset @ up.astype(np.float32)
    return np.sqrt(np.maximum((offset * offset).sum(axis=1) - above * above, 0))


def _ground_around(
    xyz_m: np.ndarray, own: Bool[np.ndarray, "n"], box: OrientedBox, up: np.ndarray
) -> tuple[float, float] | None:
    """Height of what an object stands on, and its roughness (standard deviation); None if nothing is there."""
    near = ~own & (_distances(xyz_m, box.center_m, up) <= GROUND_RADII[1] * _radius(box, up))
    heights = xyz_m[near] @ up
    heights = heights[np.abs(heights - _bottom(box, up)) <= SAME_HEIGHT * _height(box, up)]
    if len(heights) < MIN_GROUND:
        return None
    level = float(np.median(heights))
    return level, 1.48 * float(np.median(np.abs(heights - level)))


def _ground_at(
    xyz_m: np.ndarray, center_m: np.ndarray, box: OrientedBox, turn: Rotation, up: np.ndarray
) -> float | None:
    """Height of level ground at a place for a turned box; None if there is none."""
    placed = OrientedBox.from_parts(center_m, turn.as_matrix() @ box.rotation, box.size_m)
    radius, tall = _radius(placed, up), _height(placed, up)
    distances = _distances(xyz_m, center_m, up)
    for radii in GROUND_RADII:
        heights = xyz_m[distances <= radii * radius] @ up
        if len(heights) >= MIN_GROUND:
            low = float(np.percentile(heights, 20))
            is_level = (np.abs(heights - low) <= SAME_HEIGHT * tall).mean() >= LEVEL_SHARE
            return low if is_level else None
    return None
