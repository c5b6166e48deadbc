"""2D boxes and outlines on a camera image: of an oriented box, a set of points, and the edges of a wire frame.

Each face of the box is a convex polygon. In 3D, it is clipped to the half-spaces in front of the camera and within its
field of view (Sutherland and Hodgman, 1974). The rest is projected and clipped to the image. So a box that extends
behind the camera or beyond the image border gets the 2D box of its visible part. The hole that clipping leaves in the
near plane does not matter: a ray that enters the box through this hole leaves it through a face.

A box is hidden as far as the lines of sight towards it end in front of it.

An edge of a wire frame is clipped likewise (Liang and Barsky, 1984). On a distorted image it is divided into several
pieces, because straight edges are curved there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import intersection_volume_pairs
from annotator.geometry.oriented_box import EDGES, box_corners, corners
from annotator.geometry.projection import (
    CameraKey,
    camera_key,
    inside_image,
    project,
    radius_limit_squared,
    undistort_px,
)
from annotator.types import Box2D, Camera, OrientedBox

# Minimum distance in front of the camera, metres; closer parts are ignored.
NEAR_M = 0.1
# Minimum width and height of a 2D box, pixels.
MIN_SIDE_PX = 2.0
# Straight edges are curved on a distorted image; each is sampled in this many steps.
STEPS_DISTORTED = 16
# The disc within which a distortion model is valid is approximated by a polygon with this many sides.
DISC_SIDES = 48
# Margin around the field of view of a distorted image, as a share of its size; the image itself is clipped later.
FIELD_MARGIN = 0.05

# The six faces by the indices of their corners, in order around each face.
FACES = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])

# Half-spaces: rows (normal, offset); points with normal . p >= offset are kept.
HalfSpaces = Float64[np.ndarray, "k d1"]
Polygon = Float64[np.ndarray, "_ d"]


def box_on_image(camera: Camera, box: OrientedBox, label: str, min_side_px: float = MIN_SIDE_PX) -> Box2D | None:
    """The 2D box, pixels, of the visible part of a 3D box (camera frame).

    Visible is what is at least `NEAR_M` in front of the camera and within the image; distortion is taken into account.
    None if nothing is visible, or if a side is shorter than `min_side_px`.
    """
    polygons = _visible_faces(camera, box_corners(box))
    xy, last_px = np.concatenate(polygons), _last_px(camera)
    px = project(camera, np.column_stack([xy, np.ones(len(xy))]))
    if not ((px >= -0.5) & (px <= last_px)).all():
        ends = np.cumsum([len(polygon) for polygon in polygons])[:-1]
        px = np.concatenate([_in_image(polygon, last_px) for polygon in np.split(px, ends)])
    # clipping may miss the image border by a rounding error
    return _around(px.clip(-0.5, last_px), label, min_side_px)


def edges_at_border(camera: Camera, box: Box2D, margin_px: float) -> tuple[bool, bool, bool, bool]:
    """Which edges of a 2D box lie within a margin (pixels) of the image border, or beyond: left, right, top, bottom."""
    right, bottom = _last_px(camera) - margin_px
    first = margin_px - 0.5
    return bool(box.x_min <= first), bool(box.x_max >= right), bool(box.y_min <= first), bool(box.y_max >= bottom)


def points_on_image(
    camera: Camera, xyz_m: Float[np.ndarray, "n 3"], label: str, min_side_px: float = MIN_SIDE_PX
) -> Box2D | None:
    """The 2D box, as of `box_on_image`, around the points (camera frame, metres) that are in front of the camera."""
    px = project(camera, xyz_m[xyz_m[:, 2] >= NEAR_M])
    # comparisons with NaN are false, so points that cannot be projected are outside
    inside = ((px >= -0.5) & (px <= _last_px(camera))).all(axis=1)
    return _around(px[inside], label, min_side_px)


def _around(px: Float64[np.ndarray, "n 2"], label: str, min_side_px: float) -> Box2D | None:
    if len(px) == 0:
        return None
    low, high = px.min(axis=0), px.max(axis=0)
    if (high - low < min_side_px).any():
        return None
    return Box2D(label, float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _visible_faces(camera: Camera, corners_m: Float64[np.ndarray, "8 3"]) -> list[Float64[np.ndarray, "_ 2"]]:
    """The part of each face within the field of view, as a polygon of (x/z, y/z); empty if there is none."""
    faces, planes = corners_m[FACES], field_of_view(camera_key(camera))
    if (corners_m @ planes[:, :3].T >= planes[:, 3]).all():
        return list(_normalised(camera, faces))
    return [_normalised(camera, cut_polygon(face, planes)) for face in faces]


def _normalised(camera: Camera, polygons_m: Float64[np.ndarray, "*k n 3"]) -> Float64[np.ndarray, "*k m 2"]:
    """Polygons in front of the camera as (x/z, y/z); for a distorted camera, with subdivided edges."""
    xy = polygons_m[..., :2] / polygons_m[..., 2:]
    return xy if camera.is_ideal else _subdivided(xy)


def _in_image(polygon_px: Float64[np.ndarray, "n 2"], last_px: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "m 2"]:
    """The part of a polygon within the image; empty if there is none."""
    width_px, height_px = last_px
    edges = np.array([[1, 0, -0.5], [-1, 0, -width_px], [0, 1, -0.5], [0, -1, -height_px]], np.float64)
    return cut_polygon(polygon_px, edges)


def cut_polygon(polygon: Polygon, half_spaces: HalfSpaces) -> Polygon:
    """The part of a convex polygon, (n, d) corners in order, within half-spaces; empty if there is none."""
    for plane in half_spaces:
        height = polygon @ plane[:-1] - plane[-1]
        inside = height >= 0
        if inside.all():
            continue
        after, height_after = np.roll(polygon, -1, axis=0), np.roll(height, -1)
        crosses = inside != np.roll(inside, -1)
        share = np.zeros(len(polygon))
        share[crosses] = height[crosses] / (height - height_after)[crosses]
        crossing = polygon + share[:, None] * (after - polygon)
        # each corner that is kept, followed by the crossing of the edge that starts at it
        candidates = np.stack([polygon, crossing], axis=1).reshape(-1, polygon.shape[1])
        polygon = candidates[np.stack([inside, crosses], axis=1).reshape(-1)]
    return polygon


def _subdivided(polygons: Float64[np.ndarray, "*k n 2"]) -> Float64[np.ndarray, "*k m 2"]:
    share = np.linspace(0.0, 1.0, STEPS_DISTORTED, endpoint=False)[:, None]
    along = np.roll(polygons, -1, axis=-2) - polygons
    steps = polygons[..., None, :] + share * along[..., None, :]
    return steps.reshape(*polygons.shape[:-2], -1, 2)


def _last_px(camera: Camera) -> Float64[np.ndarray, "2"]:
    return np.array([camera.width_px, camera.height_px]) - 0.5


@lru_cache(maxsize=8)
def field_of_view(key: CameraKey) -> Float64[np.ndarray, "k 4"]:
    """Half-spaces of the camera frame that contain all points that can be visible on the image."""
    camera = Camera(*key)
    planes = [[0.0, 0.0, 1.0, NEAR_M]]
    rays = undistort_px(camera, _border_px(camera))
    # if the distortion model is invalid at the image border, only its maximum radius bounds the view
    if np.isfinite(rays).all():
        low, high = rays.min(axis=0), rays.max(axis=0)
        margin = 0.0 if camera.is_ideal else FIELD_MARGIN * (high - low)
        (left, top), (right, bottom) = low - margin, high + margin
        planes += [[1, 0, -left, 0], [-1, 0, right, 0], [0, 1, -top, 0], [0, -1, bottom, 0]]
    limit = 0.999 * np.sqrt(radius_limit_squared(camera.distortion))
    if np.isfinite(limit):
        angle_rad = np.arange(DISC_SIDES) * 2 * np.pi / DISC_SIDES
        reach = limit * np.cos(np.pi / DISC_SIDES)
        planes += [[-np.cos(a), -np.sin(a), reach, 0.0] for a in angle_rad]
    return np.array(planes, np.float64)


def _border_px(camera: Camera) -> Float64[np.ndarray, "n 2"]:
    """Pixels along the image border."""
    width_px, height_px = _last_px(camera)
    share = np.linspace(0.0, 1.0, 17)
    u, v = -0.5 + share * (width_px + 0.5), -0.5 + share * (height_px + 0.5)
    sides = [(u, np.full(17, -0.5)), (u, np.full(17, height_px)), (np.full(17, -0.5), v), (np.full(17, width_px), v)]
    return np.concatenate([np.column_stack(side) for side in sides])


# Pieces per edge on a distorted image.
PIECES_DISTORTED = 8

# The arrow of the heading ends so far in front of the box, share of its mean side. As in web_assets/js/box3d.js.
ARROW_BEYOND = 0.2
# An arrow that ends farther from the image than so many times its longer side is not drawn.
FARTHEST_SIZES = 4
# Angle between an arrow's shaft and the lines of its head.
HEAD_RAD = np.pi / 6

_ENDS = np.array(EDGES)


def heading_px(camera: Camera, box: OrientedBox, head_px: float) -> Float64[np.ndarray, "k 2 2"]:
    """The arrow of a box's heading on the image, not clipped to it: on the ground (-z) face, from its middle through
    the front (+x).

    Returns:
        (3, 2, 2) pixels, both ends (u, v) of the shaft and of the head's two lines of length `head_px`; (0, 2, 2) if it
        reaches behind the camera or far from the image.
    """
    reach_m = 0.5 * box.size_m[0] + ARROW_BEYOND * box.size_m.mean()
    foot_m = box.center_m - 0.5 * box.size_m[2] * box.rotation[:, 2]
    shaft = project(camera, np.stack([foot_m, foot_m + reach_m * box.rotation[:, 0]]))
    if not (np.abs(shaft) < FARTHEST_SIZES * max(camera.width_px, camera.height_px)).all():
        return np.zeros((0, 2, 2))
    tip = shaft[1]
    back = (shaft[0] - tip) / max(float(np.linalg.norm(shaft[0] - tip)), 1e-9)
    aside = np.array([-back[1], back[0]])
    ends = [tip + head_px * (np.cos(HEAD_RAD) * back + side * np.sin(HEAD_RAD) * aside) for side in (-1, 1)]
    return np.stack([shaft, *(np.stack([tip, end]) for end in ends)])


def visible_edges(camera: Camera, boxes: Sequence[OrientedBox]) -> list[Float64[np.ndarray, "k 2 2"]]:
    """The visible parts of the 12 edges of each box (camera frame), as straight pieces on the image.

    Returns:
        one array per box: (k, 2, 2) pixels, both ends (u, v) of k pieces; k = 0 if the box is not visible. On a
        distorted image, pieces may extend slightly beyond the border.
    """
    if not boxes:
        return []
    poses = np.array([box.pose for box in boxes])
    sizes = np.array([box.size_m for box in boxes])
    ends = corners(poses[:, :3, 3], poses[:, :3, :3], sizes)[:, _ENDS].reshape(-1, 2, 3)
    cut, visible = cut_segments(ends, field_of_view(camera_key(camera)))
    owner = np.repeat(np.arange(len(boxes)), len(EDGES))[visible]
    pieces = 1 if camera.is_ideal else PIECES_DISTORTED
    share = np.linspace(0.0, 1.0, pieces + 1)[None, :, None]
    along = cut[visible, :1] + share * (cut[visible, 1:] - cut[visible, :1])
    px = project(camera, along.reshape(-1, 3)).reshape(-1, pieces + 1, 2)
    drawn = np.stack([px[:, :-1], px[:, 1:]], axis=2)
    return [_finite(drawn[owner == index].reshape(-1, 2, 2)) for index in range(len(boxes))]


def sizes_on_image(camera: Camera, boxes: Sequence[OrientedBox]) -> Float64[np.ndarray, "n"]:
    """How well the image shows each box (camera frame): the square root of the share of the image that the rectangle
    around its visible edges takes, less the more corners are outside; 0 if nothing is visible.
    """
    last_px, sizes = _last_px(camera), np.zeros(len(boxes))
    for index, edges in enumerate(visible_edges(camera, boxes)):
        if len(edges):
            px = edges.reshape(-1, 2).clip(-0.5, last_px)
            inside = np.count_nonzero(inside_image(camera, project(camera, box_corners(boxes[index]))))
            # a box that is larger than the image has all corners outside
            sizes[index] = np.sqrt((np.ptp(px, axis=0) / (last_px + 0.5)).prod()) * ((1 + inside) / 9) ** 2
    return sizes


def cut_segments(
    ends: Float64[np.ndarray, "n 2 3"], half_spaces: Float64[np.ndarray, "k 4"]
) -> tuple[Float64[np.ndarray, "n 2 3"], Bool[np.ndarray, "n"]]:
    """Line segments, by both ends, clipped to half-spaces, and a mask of those that are at least partly inside."""
    height = ends @ half_spaces[:, :3].T - half_spaces[:, 3]
    first, last = height[:, 0], height[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = first / (first - last)
    start = np.where((first < 0) & (last >= 0), crossing, 0.0).max(axis=1)
    end = np.where((last < 0) & (first >= 0), crossing, 1.0).min(axis=1)
    visible = ~((first < 0) & (last < 0)).any(axis=1) & (start < end)
    along = ends[:, 1] - ends[:, 0]
    cut = np.stack([ends[:, 0] + start[:, None] * along, ends[:, 0] + end[:, None] * along], axis=1)
    return cut, visible


def _finite(pieces: Float64[np.ndarray, "k 2 2"]) -> Float64[np.ndarray, "m 2 2"]:
    return pieces[np.isfinite(pieces).all(axis=(1, 2))]


# 2D boxes as shares of the image size, as in YOLO's label files, and boxes clipped to the image.
#
# The shares are centre x and y, width and height, divided by the image's width and height (Ultralytics'
# documentation, "object detection datasets"). They are measured from the image's corner, whereas pixels are measured
# from the centre of the first pixel: the two differ by half a pixel.


def clip_to_image(box: Box2D, width_px: int, height_px: int, min_side_px: float = 0.0) -> Box2D | None:
    """The box clipped to the image; None if it is outside, or if a side is shorter than `min_side_px`."""
    x_min, x_max = (min(max(x, -0.5), width_px - 0.5) for x in (box.x_min, box.x_max))
    y_min, y_max = (min(max(y, -0.5), height_px - 0.5) for y in (box.y_min, box.y_max))
    if x_max <= x_min or y_max <= y_min or min(x_max - x_min, y_max - y_min) < min_side_px:
        return None
    return Box2D(box.label, x_min, y_min, x_max, y_max, box.score)


def shares_of(box: Box2D, width_px: int, height_px: int) -> Float64[np.ndarray, "4"]:
    """Centre x, centre y, width and height as shares of the image size."""
    low, high = np.array([box.x_min, box.y_min]) + 0.5, np.array([box.x_max, box.y_max]) + 0.5
    size = np.array([width_px, height_px])
    return np.concatenate([(low + high) / 2 / size, (high - low) / size])


def edges_of(shares: Float[np.ndarray, "4"], width_px: int, height_px: int) -> Float64[np.ndarray, "4"]:
    """The inverse of `shares_of`: x_min, y_min, x_max, y_max, pixels."""
    centre, half, size = shares[:2], shares[2:] / 2, np.array([width_px, height_px], np.float64)
    return np.concatenate([(centre - half) * size, (centre + half) * size]) - 0.5


def rectangle_intersection_pairs(
    centers_a: Float64[np.ndarray, "n 2"],
    yaws_a_rad: Float64[np.ndarray, "n"],
    sizes_a: Float64[np.ndarray, "n 2"],
    centers_b: Float64[np.ndarray, "n 2"],
    yaws_b_rad: Float64[np.ndarray, "n"],
    sizes_b: Float64[np.ndarray, "n 2"],
) -> Float64[np.ndarray, "n"]:
    """The intersection area, m^2, of rectangles a and b, for each of n pairs: the volume shared by boxes of height 1.

    Centres and full side lengths are metres in one plane. Yaws are directions of the first side, from the plane's first
    axis towards its second.
    """
    parts: list[np.ndarray] = []
    for centers, yaws, sizes in ((centers_a, yaws_a_rad, sizes_a), (centers_b, yaws_b_rad, sizes_b)):
        rotations = Rotation.from_rotvec(yaws[:, None] * [0.0, 0.0, 1.0]).as_matrix()
        parts += [np.pad(centers, ((0, 0), (0, 1))), rotations, np.pad(sizes, ((0, 0), (0, 1)), constant_values=1.0)]
    return intersection_volume_pairs(*parts)


# Boxes with a corner closer to the image plane than this, metres, are tested against all rays.
NEAREST_M = 0.05


@dataclass(frozen=True)
class Hidden:
    """The measured lines of sight towards a box.

    Attributes:
        rays: number of measured points whose ray meets the box; they lie in front of it, inside it or behind it.
        nearer: number of these points that lie in front of the box.
    """

    rays: int
    nearer: int

    @property
    def share(self) -> float:
        """The hidden share, 0..1; NaN without rays."""
        return self.nearer / self.rays if self.rays else float("nan")


class Sight:
    """The lines of sight from a camera to its measured points, computed once for all boxes of a frame."""

    def __init__(self, xyz_m: Float[np.ndarray, "n 3"]) -> None:
        """
        Args:
            xyz_m: points in the camera frame, metres; those behind the camera are ignored.
        """
        self._xyz_m = xyz_m[xyz_m[:, 2] > NEAREST_M].astype(np.float32)
        self._plane = self._xyz_m[:, :2] / self._xyz_m[:, 2:]

    def hidden(self, box: OrientedBox, margin_m: float = 0.0) -> Hidden:
        """Counts the rays towards a box, and those that end in front of it (slab test of Kay and Kajiya, 1986).

        The box is in the camera frame. Points within `margin_m` metres of its front, along their ray, count as part of
        it.
        """
        xyz = self._xyz_m[self._near(box)]
        R = box.rotation.astype(np.float32)
        # camera and rays in the box's axes; along each ray, the measured point has the parameter 1
        eye = (-box.center_m.astype(np.float32)) @ R
        along = xyz @ R
        half = (0.5 * box.size_m).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (-half - eye) / along, (half - eye) / along
        enters, leaves = np.fmin(a, b).max(axis=1), np.fmax(a, b).min(axis=1)
        meets = (enters <= leaves) & (leaves > 0)
        length_m = np.linalg.norm(xyz, axis=1)
        before = meets & ((enters - 1.0) * length_m > margin_m)
        return Hidden(int(meets.sum()), int(before.sum()))

    def _near(self, box: OrientedBox) -> np.ndarray:
        """The rays within the box's bounds on the image plane; all rays if it extends behind the camera."""
        corners = box_corners(box)
        if (corners[:, 2] <= NEAREST_M).any():
            return np.ones(len(self._xyz_m), np.bool_)
        projected = corners[:, :2] / corners[:, 2:]
        return np.asarray(((self._plane >= projected.min(axis=0)) & (self._plane <= projected.max(axis=0))).all(axis=1))
