"""KITTI label files: object `label_2/KEY.txt` and tracking `label_02.txt`.

KITTI object devkit, readme.txt ("Data Format Description"): 15 fields per row, a 16th (score) in results only,

    type truncated occluded alpha left top right bottom height width length x y z rotation_y [score]

in the frame of rectified camera 0 (x right, y down, z forward); x y z is the middle of the bottom face and rotation_y
turns about y, 0 if the object faces +x. Tracking files put `frame track_id` before the type. `Truth` objects are
returned in annotator's convention: x along the heading, y across, z up, in the camera frame.

Rows are written in the frame of rectified camera 0, too. A recording's own label frame is kept if it differs from the
colour camera's only by a translation, as KITTI's does. Otherwise rows are written in the colour camera's frame. Either
one is called the labels' frame here.

The 2D box encloses the projected corners and is clipped to the pixel centres 0..width-1 and 0..height-1, as in the
devkit's drawings (`computeBox3D.m`). Edges that reach behind the camera are cut at `NEAR_M`. The occlusion follows from
the points measured along the lines of sight to the box (`geometry/outline.py`). Its thresholds are those that agree
best with KITTI's labels (docs/formats.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.frame_names import NO_VALUES, OCCLUSION, TRUNCATION, Values, held_by_kitti, of_kitti
from annotator.formats.reading import Angles, OnFault, faults, finite_number, raise_fault, reported, text_rows
from annotator.geometry.oriented_box import EDGES, box_corners, nearest_upright
from annotator.geometry.outline import Sight, cut_segments
from annotator.geometry.projection import project
from annotator.geometry.transforms import IMAGE_UP
from annotator.types import Box2D, Camera, Frame, OrientedBox, Truth
from annotator.types.errors import FormatError
from annotator.types.label import MOST_TRACK

DONT_CARE = "DontCare"
FIELDS = 15
DECIMALS = 2
TRACKING_FIELDS = 2
# Share outside the image above which an object is partly and largely truncated (docs/formats.md).
PARTLY_OUTSIDE_SHARE, LARGELY_OUTSIDE_SHARE = 0.5, 0.9
# The sizes in rows without a 3D box.
UNKNOWN_SIZES = ((-1.0, -1.0, -1.0), (0.0, 0.0, 0.0))
# Levels of truncation in tracking files: 0 not, 1 partly, 2 largely outside the image; a fraction has decimals.
LEVELS_ALONE = ("1", "2")


@dataclass(frozen=True)
class KittiLabel:
    """One row as stored: KITTI's order, units and frame (metres, radians, pixels).

    Attributes:
        label: KITTI's `type`, such as "Car"; `DONT_CARE` for an unlabelled area, whatever its case in the file.
        truncated: fraction of the object outside the image, 0..1; -1 if unknown.
        occluded: 0 visible, 1 partly, 2 largely hidden, 3 unknown; -1 for DontCare.
        alpha: observation angle.
        left, top, right, bottom: 2D box.
        height, width, length: size of the 3D box.
        x, y, z: middle of the bottom face, rectified camera 0.
        rotation_y: heading, about the camera's y axis.
        score: score of a result; None in a label.
        frame, track: the frame's number and the track id, in tracking files.
        line: of its file, from 1; None for a row that was made.
    """

    label: str
    truncated: float
    occluded: int
    alpha: float
    left: float
    top: float
    right: float
    bottom: float
    height: float
    width: float
    length: float
    x: float
    y: float
    z: float
    rotation_y: float
    score: float | None = None
    _: KW_ONLY
    frame: int | None = None
    track: int | None = None
    line: int | None = field(default=None, compare=False)

    @property
    def is_flat(self) -> bool:
        """True for a 2D box without a 3D box: sizes of -1 (or 0), as detectors of 2D boxes write them."""
        return self.label != DONT_CARE and (self.height, self.width, self.length) in UNKNOWN_SIZES

    @property
    def is_solid(self) -> bool:
        """False for a DontCare area, and for a 2D box without a 3D box."""
        return self.label != DONT_CARE and not self.is_flat


def dont_care(edges: tuple[float, float, float, float]) -> KittiLabel:
    """Returns the row of an area where objects are not labelled: left top right bottom, pixels."""
    return KittiLabel(DONT_CARE, -1.0, -1, -10.0, *edges, -1.0, -1.0, -1.0, -1000.0, -1000.0, -1000.0, -10.0)


def dump_label_line(row: KittiLabel) -> str:
    """Returns a row as text, numbers with two decimals as in KITTI's own files; `parse_row` reads it.

    Args:
        row: the label must be one word. Of a DontCare area only the 2D box is written, as in KITTI's files.
    """
    edges = [_decimal(edge) for edge in (row.left, row.top, row.right, row.bottom)]
    if row.label == DONT_CARE:
        return " ".join([DONT_CARE, "-1 -1 -10", *edges, "-1 -1 -1 -1000 -1000 -1000 -10"])
    solid = (row.height, row.width, row.length, row.x, row.y, row.z, row.rotation_y)
    score = [] if row.score is None else [f"{row.score:.6g}"]
    first = [row.label, _decimal(row.truncated), str(row.occluded), _decimal(row.alpha)]
    return " ".join([*first, *edges, *map(_decimal, solid), *score])


def dump_tracking_line(frame: int, track_id: int, row: KittiLabel) -> str:
    """Returns a row of a tracking file as text; arguments as in `dump_label_line`. Truncation is written as a level."""
    label, truncated, rest = dump_label_line(row).split(" ", 2)
    if row.label != DONT_CARE:
        truncated = str(sum(int(row.truncated > share) for share in (PARTLY_OUTSIDE_SHARE, LARGELY_OUTSIDE_SHARE)))
    return f"{frame} {track_id} {label} {truncated} {rest}"


def _decimal(value: float) -> str:
    # no "-0.00", so that reading and writing a file leaves it unchanged
    return f"{round(value, DECIMALS) + 0.0:.{DECIMALS}f}"


def label_box(row: KittiLabel) -> OrientedBox:
    """Returns the row's 3D box in KITTI's frame (rectified camera 0).

    Raises:
        ValueError: a size that is not positive.
    """
    center = np.array([row.x, row.y - row.height / 2, row.z])
    return OrientedBox.from_parts(center, heading_rotation(row.rotation_y), _size_m(row))


def heading_rotation(rotation_y: float) -> Float64[np.ndarray, "3 3"]:
    """Returns the box's axes in rectified camera 0 as columns: x along the heading, y to its left, z up (camera -y)."""
    cos, sin = np.cos(rotation_y), np.sin(rotation_y)
    return np.array([[cos, sin, 0.0], [0.0, 0.0, -1.0], [-sin, cos, 0.0]])


def read_rows(
    path: Path, text: str | None = None, *, tracking: bool = False, on_fault: OnFault = raise_fault
) -> Iterator[KittiLabel]:
    """Yields the rows of a label file in its order.

    Args:
        text: the content of the file; None: it is read.
        tracking: rows begin with frame number and track id.
    """
    for line, fields in text_rows(path, text):
        with reported(on_fault):
            yield parse_row(fields, path, line, tracking=tracking)


def parse_row(fields: list[str], path: Path, line: int, *, tracking: bool = False) -> KittiLabel:
    """Returns the row of 15 or 16 fields, in tracking files after frame number and track id.

    KITTI's own tracking files have levels of truncation, the whole numbers 0, 1 and 2, where other files have a
    fraction with decimals (KITTI tracking devkit, readme.txt). The fraction of levels 1 and 2 is unknown.
    """
    first = TRACKING_FIELDS if tracking else 0
    if tracking and len(fields) < first + FIELDS:
        raise FormatError(path, f"a tracking row has {first + FIELDS} fields, not {len(fields)}", line)
    frame, track = (_integer(field, path, line) for field in fields[:first]) if tracking else (None, None)
    if frame is not None and track is not None and max(abs(frame), abs(track)) > MOST_TRACK:
        problem = f"frame and track id must be at most {MOST_TRACK}, not {frame:.6g} and {track:.6g}"
        raise FormatError(path, problem, line)
    label, *rest = fields[first:]
    if len(rest) not in (FIELDS - 1, FIELDS):
        problem = f"a label row has {FIELDS} fields (or {FIELDS + 1} with a score), not {len(rest) + 1}"
        raise FormatError(path, problem, line)
    truncated, _, *values = (finite_number(field, path, line) for field in rest)
    if tracking and rest[0] in LEVELS_ALONE:
        truncated = -1.0
    # the devkit ignores the case of this type
    label = DONT_CARE if label.lower() == DONT_CARE.lower() else label
    occluded = _integer(rest[1], path, line)
    return KittiLabel(label, truncated, occluded, *values, frame=frame, track=track, line=line)


def _integer(field: str, path: Path, line: int) -> int:
    value = finite_number(field, path, line)
    if value != int(value):
        raise FormatError(path, f"{field!r} is not a whole number", line)
    return int(value)


def _size_m(row: KittiLabel) -> Float64[np.ndarray, "3"]:
    return np.array([row.length, row.width, row.height])


def row_truth(row: KittiLabel, T: RigidTransform | None, path: Path, angles: Angles) -> Truth:
    """Returns a row's object in the camera frame.

    Args:
        row: one that has a 3D box.
        T: from rectified camera 0 to the camera frame (`Frame.T_camera_label`); None for identity.
        angles: those of all rows that belong together.
    """
    if (_size_m(row) <= 0).any():
        problem = f"height width length must be positive, not {row.height} {row.width} {row.length}"
        raise FormatError(path, problem, row.line)
    with faults(path, line=row.line):
        box = label_box(replace(row, rotation_y=angles.radians(row.rotation_y, path, row.line)))
        edges, score = (row.left, row.top, row.right, row.bottom), 1.0 if row.score is None else row.score
        has_extent = row.right > row.left and row.bottom > row.top
        image_box = Box2D(row.label, *edges, score) if has_extent else None
        values = of_kitti(row.truncated, row.occluded)
        box = box if T is None else box.transformed(T)
        return Truth(row.label, box, row.track, row.score, image_box, attributes=values)


OUTSIDE_IMAGE = (0.0, 0.0, 0.0, 0.0)
VISIBLE, UNKNOWN = 0, 3
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
    truncated = held.get(TRUNCATION, truncated)
    if sight is None or OCCLUSION in held:
        occluded = int(held.get(OCCLUSION, VISIBLE))
    else:
        occluded = occlusion(box if T is None else box.transformed(T), sight)
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
    return int(hidden.share > PARTLY_SHARE) + int(hidden.share > LARGELY_SHARE)


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
