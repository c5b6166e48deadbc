"""Boxes of our frames as rows of KITTI: upright, with the 2D box, alpha, truncation and occlusion that follow.

KITTI's labels are in the frame of rectified camera 0. Recordings whose labels are only shifted against the colour
camera (KITTI's own) keep that frame; all others have the colour camera for it. A row's occlusion follows from what was
measured along the lines of sight to the box (`geometry/occlusion.py`): the shares at which it becomes 1 and 2 are those
that agree best with KITTI's labels (docs/formats.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.formats.kitti import DECIMALS, KittiLabel, heading_rotation
from annotator.formats.kitti_derived import derived_box, heading, observation_angle
from annotator.geometry.level import IMAGE_UP
from annotator.geometry.nearest_upright import nearest_upright
from annotator.geometry.occlusion import Sight
from annotator.types import Frame, OrientedBox

NOT_IN_THE_PICTURE = (0.0, 0.0, 0.0, 0.0)
VISIBLE, PARTLY_HIDDEN, LARGELY_HIDDEN, UNKNOWN = 0, 1, 2, 3
# The hidden share above which an object is partly, and largely, hidden.
PARTLY_SHARE, LARGELY_SHARE = 0.1, 0.55
# Points so near before a box are its own object's (boxes are tight, and the ground begins there): a part of its size.
MARGIN = 0.13
# Fewer lines of sight say nothing.
LEAST_RAYS = 3
# A turn by less is none, radians: what is left of a product of rotations.
NO_TURN_RAD = 1e-9


def label_frame(frame: Frame) -> RigidTransform | None:
    """From rectified camera 0 of a frame's KITTI labels to its colour camera; None where they are the same."""
    T = frame.T_camera_label
    return None if T is None or T.rotation.magnitude() > NO_TURN_RAD else T


def upright_box(box: OrientedBox, frame: Frame) -> tuple[OrientedBox, float]:
    """The nearest box that a row can hold, in the labels' frame, and by how much it was turned for that, radians.

    KITTI's boxes turn about the camera's y axis alone, wherever gravity points.
    """
    T = label_frame(frame)
    return nearest_upright(box if T is None else box.transformed(T.inv()), IMAGE_UP)


def rounded_box(box: OrientedBox) -> OrientedBox:
    """An upright box in the labels' frame as it reads back from a row; no size becomes zero."""
    x, y, z = box.center_m.tolist()
    length, width, height = (max(round(size, DECIMALS), 10.0**-DECIMALS) for size in box.size_m.tolist())
    bottom = round(y + box.size_m[2] / 2, DECIMALS)
    center = np.array([round(x, DECIMALS), bottom - height / 2, round(z, DECIMALS)])
    turn = heading_rotation(round(heading(box), DECIMALS))
    return OrientedBox.from_parts(center, turn, np.array([length, width, height]))


def upright_row(
    label: str, box: OrientedBox, score: float | None, frame: Frame, sight: Sight | None = None
) -> KittiLabel:
    """The row of a box that stands upright in the labels' frame.

    The picture is that of an ideal camera with the same matrix. A box that is not in it has a 2D box without extent,
    which KITTI's evaluation passes over.

    Args:
        score: of a result; None in a label.
        sight: of the frame's cloud, for the occlusion; None: the box counts as visible.
    """
    T = label_frame(frame)
    derived = derived_box(replace(frame.camera, distortion=()), box, T)
    x, y, z = box.center_m.tolist()
    length, width, height = box.size_m.tolist()
    rotation_y = heading(box)
    edges, truncated = (NOT_IN_THE_PICTURE, 1.0) if derived is None else (derived.clipped, derived.truncated)
    alpha, bottom = observation_angle(rotation_y, x, z), y + height / 2
    occluded = VISIBLE if sight is None else occlusion(box if T is None else box.transformed(T), sight)
    return KittiLabel(label, truncated, occluded, alpha, *edges, height, width, length, x, bottom, z, rotation_y, score)


def kitti_row(
    label: str, box: OrientedBox, score: float | None, frame: Frame, sight: Sight | None = None
) -> KittiLabel:
    """The row of any box in the camera frame, by the upright one that is nearest to it; arguments as `upright_row`."""
    return upright_row(label, upright_box(box, frame)[0], score, frame, sight)


def is_in_picture(row: KittiLabel) -> bool:
    """True where the row's 2D box has an extent, also when it is written."""
    return round(row.left, DECIMALS) < round(row.right, DECIMALS) and round(row.top, DECIMALS) < round(
        row.bottom, DECIMALS
    )


def occlusion(box: OrientedBox, sight: Sight) -> int:
    """How much of a box (camera frame) is hidden, in KITTI's levels 0 to 3."""
    hidden = sight.hidden(box, MARGIN * float(np.cbrt(box.volume_m3)))
    if hidden.rays < LEAST_RAYS:
        return UNKNOWN
    if hidden.share <= PARTLY_SHARE:
        return VISIBLE
    return PARTLY_HIDDEN if hidden.share <= LARGELY_SHARE else LARGELY_HIDDEN
