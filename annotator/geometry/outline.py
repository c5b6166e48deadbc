"""What an oriented box, or a set of points, spans on a camera image: its 2D box.

Each face of the box is a convex polygon. It is cut to what lies in front of the camera and within the camera's field of
view, in 3D, where all of these are half-spaces (Sutherland and Hodgman, 1974); what is left goes on the image and is
cut to the picture. So a box with a corner behind the camera, or beyond the picture's edge, gets the 2D box of its
visible part and not of a part that nobody sees. Every ray that meets the box in front of the camera leaves it through a
face there, so nothing is missed where the near plane has cut the box open.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64

from annotator.geometry.distortion import radius_limit_squared
from annotator.geometry.oriented_box import box_corners
from annotator.geometry.projection import CameraKey, camera_key, project, undistort_px
from annotator.types import Box2D, Camera, OrientedBox

# What lies nearer to the camera than this is not on the image, metres.
NEAR_M = 0.1
# A thinner 2D box is none, pixels.
MIN_SIDE_PX = 2.0
# Straight edges are bent on a distorted image; each is followed in so many steps.
STEPS_DISTORTED = 16
# The disc within which a distortion model holds, as a polygon of so many sides.
DISC_SIDES = 48
# Field of view that is kept around a distorted picture, as a share of its size: the cut to the picture follows.
FIELD_MARGIN = 0.05

# The six faces by the numbers of their corners, in order around each.
FACES = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])

# Half-spaces: rows (normal, offset) of what is kept, normal . p >= offset.
HalfSpaces = Float64[np.ndarray, "k d1"]
Polygon = Float64[np.ndarray, "_ d"]


def box_on_image(camera: Camera, box: OrientedBox, label: str, min_side_px: float = MIN_SIDE_PX) -> Box2D | None:
    """The 2D box of the visible part of a 3D box, in front of the camera (by `NEAR_M`) and within the picture.

    Args:
        camera: its distortion is included.
        box: in the camera frame.
        label: of the 2D box.
        min_side_px: a 2D box that is narrower or lower is none.

    Returns:
        The box, pixels; None where nothing of it is in the picture.
    """
    polygons = _seen_faces(camera, box_corners(box))
    px, last_px = project(camera, _at_one_metre(np.concatenate(polygons))), _last_px(camera)
    if not ((px >= -0.5) & (px <= last_px)).all():
        ends = np.cumsum([len(polygon) for polygon in polygons])[:-1]
        px = np.concatenate([_in_picture(polygon, last_px) for polygon in np.split(px, ends)])
    # the cut may miss the picture's edge by a rounding error
    return _around(px.clip(-0.5, last_px), label, min_side_px)


def points_on_image(
    camera: Camera, xyz_m: Float[np.ndarray, "n 3"], label: str, min_side_px: float = MIN_SIDE_PX
) -> Box2D | None:
    """The 2D box around those of the points (camera frame, metres) that are in front of the camera and in the picture.

    Arguments and answer as of `box_on_image`.
    """
    px = project(camera, xyz_m[xyz_m[:, 2] >= NEAR_M])
    # comparisons with NaN are false, so what cannot be projected drops out
    inside = ((px >= -0.5) & (px <= _last_px(camera))).all(axis=1)
    return _around(px[inside], label, min_side_px)


def _around(px: Float64[np.ndarray, "n 2"], label: str, min_side_px: float) -> Box2D | None:
    if len(px) == 0:
        return None
    low, high = px.min(axis=0), px.max(axis=0)
    if (high - low < min_side_px).any():
        return None
    return Box2D(label, float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _seen_faces(camera: Camera, corners_m: Float64[np.ndarray, "8 3"]) -> list[Float64[np.ndarray, "_ 2"]]:
    """What the field of view leaves of each face, as polygons of (x/z, y/z); empty where it leaves nothing."""
    faces, planes = corners_m[FACES], field_of_view(camera_key(camera))
    if (corners_m @ planes[:, :3].T >= planes[:, 3]).all():
        return list(_as_seen(camera, faces))
    return [_as_seen(camera, cut_polygon(face, planes)) for face in faces]


def _as_seen(camera: Camera, polygons_m: Float64[np.ndarray, "*k n 3"]) -> Float64[np.ndarray, "*k m 2"]:
    """Polygons before the camera as (x/z, y/z), with as many corners as it takes to bend their edges."""
    xy = polygons_m[..., :2] / polygons_m[..., 2:]
    return xy if camera.is_ideal else _subdivided(xy)


def _at_one_metre(xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    return np.column_stack([xy, np.ones(len(xy))])


def _in_picture(
    polygon_px: Float64[np.ndarray, "n 2"], last_px: Float64[np.ndarray, "2"]
) -> Float64[np.ndarray, "m 2"]:
    """What the picture leaves of a polygon; empty where it leaves nothing."""
    width_px, height_px = last_px
    edges = np.array([[1, 0, -0.5], [-1, 0, -width_px], [0, 1, -0.5], [0, -1, -height_px]], np.float64)
    return cut_polygon(polygon_px, edges)


def cut_polygon(polygon: Polygon, half_spaces: HalfSpaces) -> Polygon:
    """What half-spaces leave of a convex polygon; empty where they leave nothing.

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
        # each corner that stays, and behind it the place where the edge that begins there crosses the plane
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
    """Half-spaces of the camera frame that hold all that can be in the picture."""
    camera = Camera(*key)
    planes = [[0.0, 0.0, 1.0, NEAR_M]]
    rays = undistort_px(camera, _border_px(camera))
    # A picture whose corners the distortion model does not reach has no bounds but the model's own.
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
    """Pixels around the picture's border."""
    width_px, height_px = _last_px(camera)
    share = np.linspace(0.0, 1.0, 17)
    u, v = -0.5 + share * (width_px + 0.5), -0.5 + share * (height_px + 0.5)
    sides = [(u, np.full(17, -0.5)), (u, np.full(17, height_px)), (np.full(17, -0.5), v), (np.full(17, width_px), v)]
    return np.concatenate([np.column_stack(side) for side in sides])
