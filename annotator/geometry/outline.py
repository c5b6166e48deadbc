"""The 2D box of an oriented box, or of a set of points, on a camera image.

Each face of the box is a convex polygon. In 3D, it is clipped to the half-spaces in front of the camera and within its
field of view (Sutherland and Hodgman, 1974). The rest is projected and clipped to the image. So a box that extends
behind the camera or beyond the image border gets the 2D box of its visible part. The hole that clipping leaves in the
near plane does not matter: a ray that enters the box through this hole leaves it through a face.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64

from annotator.geometry.distortion import radius_limit_squared
from annotator.geometry.oriented_box import box_corners
from annotator.geometry.projection import CameraKey, camera_key, project, undistort_px
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
    """The 2D box of the visible part of a 3D box: at least `NEAR_M` in front of the camera and within the image.

    Args:
        camera: distortion is taken into account.
        box: in the camera frame.
        label: of the 2D box.
        min_side_px: minimum width and height.

    Returns:
        the box, pixels; None if nothing is visible, or if it is smaller than `min_side_px`.
    """
    polygons = _visible_faces(camera, box_corners(box))
    px, last_px = project(camera, _at_one_metre(np.concatenate(polygons))), _last_px(camera)
    if not ((px >= -0.5) & (px <= last_px)).all():
        ends = np.cumsum([len(polygon) for polygon in polygons])[:-1]
        px = np.concatenate([_in_image(polygon, last_px) for polygon in np.split(px, ends)])
    # clipping may miss the image border by a rounding error
    return _around(px.clip(-0.5, last_px), label, min_side_px)


def edges_at_border(camera: Camera, box: Box2D, margin_px: float) -> tuple[bool, bool, bool, bool]:
    """Which edges of a 2D box lie on the image border or beyond it: left, right, top, bottom.

    Args:
        margin_px: distance from the border within which an edge counts as lying on it.
    """
    right, bottom = _last_px(camera) - margin_px
    first = margin_px - 0.5
    return bool(box.x_min <= first), bool(box.x_max >= right), bool(box.y_min <= first), bool(box.y_max >= bottom)


def points_on_image(
    camera: Camera, xyz_m: Float[np.ndarray, "n 3"], label: str, min_side_px: float = MIN_SIDE_PX
) -> Box2D | None:
    """The 2D box around the points (camera frame, metres) that are in front of the camera and within the image.

    Other arguments and the result are as in `box_on_image`.
    """
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


def _at_one_metre(xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    return np.column_stack([xy, np.ones(len(xy))])


def _in_image(polygon_px: Float64[np.ndarray, "n 2"], last_px: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "m 2"]:
    """The part of a polygon within the image; empty if there is none."""
    width_px, height_px = last_px
    edges = np.array([[1, 0, -0.5], [-1, 0, -width_px], [0, 1, -0.5], [0, -1, -height_px]], np.float64)
    return cut_polygon(polygon_px, edges)


def cut_polygon(polygon: Polygon, half_spaces: HalfSpaces) -> Polygon:
    """The part of a convex polygon within half-spaces; empty if there is none.

    Args:
        polygon: (n, d) corners in order.
        half_spaces: (k, d + 1) rows of a normal and an offset; points with normal . p >= offset are kept.
    """
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
