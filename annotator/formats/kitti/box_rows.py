"""Converts boxes to KITTI rows: upright, with rotation_y, alpha, 2D box, truncation and occlusion.

KITTI's labels are in the frame of rectified camera 0. A recording's own label frame is kept if it differs from the
colour camera's only by a translation, as KITTI's does. Otherwise rows are written in the colour camera's frame. Either
one is called the labels' frame here.

The 2D box encloses the projected corners and is clipped to the pixel centres 0..width-1 and 0..height-1, as in the
devkit's drawings (`computeBox3D.m`). Edges that reach behind the camera are cut at `NEAR_M`. The occlusion follows from
the points measured along the lines of sight to the box (`geometry/occlusion.py`). Its thresholds are those that agree
best with KITTI's labels (docs/formats.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.attributes import NO_VALUES, OCCLUSION, TRUNCATION, Values, held_by_kitti
from annotator.formats.kitti.label_files import DECIMALS, KittiLabel, heading_rotation
from annotator.geometry.occlusion import Sight
from annotator.geometry.oriented_box import EDGES, box_corners, nearest_upright
from annotator.geometry.outline import cut_segments
from annotator.geometry.projection import project
from annotator.geometry.transforms import IMAGE_UP
from annotator.types import Camera, Frame, OrientedBox

OUTSIDE_IMAGE = (0.0, 0.0, 0.0, 0.0)
VISIBLE, PARTLY_HIDDEN, LARGELY_HIDDEN, UNKNOWN = 0, 1, 2, 3
# Hidden fraction above which an object is partly and largely hidden.
PARTLY_SHARE, LARGELY_SHARE = 0.1, 0.55
# Points closer than this to the front of a box, as a fraction of its mean side, do not count as hiding it: they are the
# object's own surface or the ground.
MARGIN = 0.13
# Minimum number of lines of sight; with fewer, the occlusion is unknown.
LEAST_RAYS = 3
# Largest rotation that counts as rounding error, radians.
NO_TURN_RAD = 1e-9


def label_frame(frame: Frame) -> RigidTransform | None:
    """Returns the transform from the labels' frame (see above) to the colour camera's; None if they are the same."""
    T = frame.T_camera_label
    return None if T is None or T.rotation.magnitude() > NO_TURN_RAD else T


def upright_box(box: OrientedBox, frame: Frame) -> tuple[OrientedBox, float]:
    """Returns the nearest box that a row can store, in the labels' frame, and the angle between it and `box`, radians.

    KITTI's boxes rotate about the camera's y axis only, whatever the direction of gravity.
    """
    T = label_frame(frame)
    return nearest_upright(box if T is None else box.transformed(T.inv()), IMAGE_UP)


def rounded_box(box: OrientedBox) -> OrientedBox:
    """Returns an upright box in the labels' frame, rounded as in a row; sizes stay positive."""
    x, y, z = box.center_m.tolist()
    length, width, height = (max(round(size, DECIMALS), 10.0**-DECIMALS) for size in box.size_m.tolist())
    bottom = round(y + box.size_m[2] / 2, DECIMALS)
    center = np.array([round(x, DECIMALS), bottom - height / 2, round(z, DECIMALS)])
    turn = heading_rotation(round(heading(box), DECIMALS))
    return OrientedBox.from_parts(center, turn, np.array([length, width, height]))


def upright_row(
    label: str,
    box: OrientedBox,
    score: float | None,
    frame: Frame,
    sight: Sight | None = None,
    attributes: Values = NO_VALUES,
) -> KittiLabel:
    """Returns the row of a box that is upright in the labels' frame.

    The 2D box is in the image of an ideal camera with the same matrix. A box outside that image gets a 2D box without
    extent, which KITTI's evaluation ignores.

    Args:
        score: score of a result; None in a label.
        sight: lines of sight of the frame's cloud, for the occlusion; None: the box counts as visible.
        attributes: of the label; its `truncation` and `occlusion` replace the measured ones.
    """
    T = label_frame(frame)
    derived = derived_box(replace(frame.camera, distortion=()), box, T)
    x, y, z = box.center_m.tolist()
    length, width, height = box.size_m.tolist()
    rotation_y = heading(box)
    edges, truncated = (OUTSIDE_IMAGE, 1.0) if derived is None else (derived.clipped, derived.truncated)
    alpha, bottom = observation_angle(rotation_y, x, z), y + height / 2
    held = held_by_kitti(attributes)
    truncated = float(held.get(TRUNCATION, truncated))
    if OCCLUSION in held:
        sight = None
    occluded = (
        int(held.get(OCCLUSION, VISIBLE))
        if sight is None
        else occlusion(box if T is None else box.transformed(T), sight)
    )
    return KittiLabel(label, truncated, occluded, alpha, *edges, height, width, length, x, bottom, z, rotation_y, score)


def kitti_row(
    label: str, box: OrientedBox, score: float | None, frame: Frame, sight: Sight | None = None
) -> KittiLabel:
    """Returns the row of the upright box nearest to any box in the camera frame; arguments as in `upright_row`."""
    return upright_row(label, upright_box(box, frame)[0], score, frame, sight)


def is_in_image(row: KittiLabel) -> bool:
    """True if the row's 2D box has an extent after rounding."""
    return round(row.left, DECIMALS) < round(row.right, DECIMALS) and round(row.top, DECIMALS) < round(
        row.bottom, DECIMALS
    )


def occlusion(box: OrientedBox, sight: Sight) -> int:
    """Returns the occlusion of a box (camera frame), in KITTI's levels 0 to 3."""
    hidden = sight.hidden(box, MARGIN * float(np.cbrt(box.volume_m3)))
    if hidden.rays < LEAST_RAYS:
        return UNKNOWN
    if hidden.share <= PARTLY_SHARE:
        return VISIBLE
    return PARTLY_HIDDEN if hidden.share <= LARGELY_SHARE else LARGELY_HIDDEN


# Near plane of the projection, metres along z of the labels' frame.
NEAR_M = 0.1


@dataclass(frozen=True)
class DerivedBox:
    """The 2D box of a 3D box, pixels: left, top, right, bottom.

    Attributes:
        unclipped: the whole box, including its part outside the image.
        clipped: the part within the image; without extent if the box is outside.
    """

    unclipped: tuple[float, float, float, float]
    clipped: tuple[float, float, float, float]

    @property
    def truncated(self) -> float:
        """The fraction of the box that is outside the image, 0..1."""
        whole = _area(self.unclipped)
        return 1.0 - _area(self.clipped) / whole if whole > 0 else 1.0


def derived_box(camera: Camera, box: OrientedBox, T_camera_label: RigidTransform | None) -> DerivedBox | None:
    """Returns the 2D box of a 3D box in the labels' frame (rectified camera 0); None if it is behind the camera.

    Args:
        camera: the colour camera, an ideal pinhole.
        T_camera_label: from rectified camera 0 to the colour camera (`Frame.T_camera_label`); None for identity.
    """
    ends = box_corners(box)[np.array(EDGES)]
    cut, seen = cut_segments(ends, np.array([[0.0, 0.0, 1.0, NEAR_M]]))
    xyz = cut[seen].reshape(-1, 3)
    if len(xyz) == 0:
        return None
    px = project(camera, xyz if T_camera_label is None else T_camera_label.apply(xyz))
    if not np.isfinite(px).all():
        return None
    last = np.array([camera.width_px, camera.height_px]) - 1.0
    low, high = px.min(axis=0), px.max(axis=0)
    return DerivedBox(_edges(low, high), _edges(low.clip(0.0, last), high.clip(0.0, last)))


def heading(box: OrientedBox) -> float:
    """Returns rotation_y of a box in the labels' frame: the direction of its length on the ground, -pi..pi."""
    along = box.rotation[:, 0]
    return math.atan2(-along[2], along[0])


def observation_angle(rotation_y: float, x: float, z: float) -> float:
    """Returns alpha: rotation_y minus the direction from the camera to the box's centre, -pi..pi."""
    return math.remainder(rotation_y - math.atan2(x, z), 2.0 * math.pi)


def _edges(low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> tuple[float, float, float, float]:
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _area(edges: tuple[float, float, float, float]) -> float:
    return (edges[2] - edges[0]) * (edges[3] - edges[1])
