"""What a viewport shows, as data: its content, the shown points and their colours, the lines of boxes and views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8

from annotator.geometry.ground import Ground
from annotator.geometry.oriented_box import CORNER_SIGNS, EDGES, contains
from annotator.geometry.projection import in_frustum, thin, undistort_px
from annotator.types import Box2D, Frame, OrientedBox, PointCloud, PseudoView, ReviewState
from annotator.web.viewport.guides import Look
from annotator.web.viewport.palette import PALETTES, Color, Palette, Theme

# Limit of shown points: all of a frame's, which graphics cards draw without delay. Browsers without one ask for fewer.
MOST_POINTS = 1_000_000


class Gizmo(StrEnum):
    """How the selected box can be moved: not, by handles on its faces, or by a gizmo."""

    OFF = "off"
    FACES = "faces"
    TRANSLATE = "translate"
    ROTATE = "rotate"


class PointColor(StrEnum):
    """The quantity that the points' colours show; `UNLABELLED`: what stands on the ground and is in no box."""

    RGB = "rgb"
    DEPTH = "depth"
    HEIGHT = "height"
    INTENSITY = "intensity"
    UNLABELLED = "unlabelled"


@dataclass(frozen=True, eq=False)
class ShownBox:
    """A 3D box of the scene. Its colour is that of its state unless another one is given."""

    uid: str | None
    box: OrientedBox
    state: ReviewState
    color: Color | None = None


@dataclass(frozen=True, eq=False)
class Draft:
    """An object that is being labelled.

    Attributes:
        box: the 3D box from the 2D boxes drawn so far, camera frame.
    """

    image_box: Box2D
    views: tuple[PseudoView, ...]
    box: OrientedBox | None


@dataclass(frozen=True, eq=False)
class Ahead:
    """A frame that may be shown next, and the ground below its points."""

    frame: Frame
    ground: Ground


@dataclass(frozen=True, eq=False)
class SceneContent:
    """The content of a viewport.

    Attributes:
        key: identifies the recording; the viewer is moved if it changes.
        frame: None = an empty viewport.
        point_size: factor of the default size, which depends on the cloud's distance.
        hide_ground, most_height_m: leave out points of the ground, and those higher above it.
        only_selected: leave out other boxes, and points that are not near the selected one.
        look: moves the viewer.
        ground: below the frame's points; None = to be found.
        ahead: the frame that may be shown next.
    """

    key: tuple[str, int] | None
    frame: Frame | None
    boxes: tuple[ShownBox, ...] = ()
    selected: str | None = None
    gizmo: Gizmo = Gizmo.OFF
    draft: Draft | None = None
    color: PointColor = PointColor.RGB
    most_points: int = MOST_POINTS
    point_size: float = 1.0
    hide_ground: bool = False
    most_height_m: float | None = None
    only_selected: bool = False
    look: Look | None = None
    theme: Theme = Theme.DARK
    ground: Ground | None = None
    ahead: Ahead | None = None

    @property
    def palette(self) -> Palette:
        """The colours of its theme."""
        return PALETTES[self.theme]

    @property
    def selected_box(self) -> ShownBox | None:
        """The selected box, which the gizmo moves."""
        return next((shown for shown in self.boxes if shown.uid is not None and shown.uid == self.selected), None)

    @property
    def is_of_boxes(self) -> bool:
        """Whether the points that are shown, or their colours, depend on the boxes."""
        return self.only_selected or self.color is PointColor.UNLABELLED

    @property
    def points_key(self) -> tuple[object, ...]:
        """Equal for two contents that show the same points of a frame."""
        near = self.selected_box if self.only_selected else None
        return (
            self.most_points,
            self.hide_ground,
            self.most_height_m,
            near and (near.box.pose.tobytes(), *near.box.size_m),
        )

    @property
    def colors_key(self) -> tuple[object, ...]:
        """Equal for two contents whose points have the same colours."""
        boxes = self.boxes if self.color is PointColor.UNLABELLED else ()
        return self.color, self.theme, *((shown.box.pose.tobytes(), *shown.box.size_m) for shown in boxes)


# Depth and height colours cover the range between these percentiles, so that outliers do not compress them.
LOW_PERCENT, HIGH_PERCENT = 2.0, 98.0
# Point size as a share of the cloud's median distance: small for the lines of a LiDAR, which no size would close. For a
# depth camera, as multiples of the distance between the points on a surface that it sees from the front.
LIDAR_SHARE, DEPTH_SPACINGS = 0.0015, 1.5
# Number of points for estimates of a scene's distance.
SAMPLE = 5_000
# Points near the selected box: within this share of its longest side.
NEAR_SHARE = 0.25
# Distance of an empty scene, metres.
EMPTY_DISTANCE_M = 3.0

CAMERA_UP = np.array([0.0, -1.0, 0.0])


def wanted_points(content: SceneContent, frame: Frame, ground: Ground) -> PointCloud:
    """The points of a frame that the content does not leave out, with colours and reflectance."""
    cloud, near = frame.cloud, content.selected_box
    keep = np.ones(len(cloud), bool)
    if content.only_selected and near is not None:
        keep &= contains(near.box, cloud.xyz_m, NEAR_SHARE * float(near.box.size_m.max()))
    if content.hide_ground or content.most_height_m is not None:
        above_m = ground.above_m(cloud.xyz_m)
        keep &= above_m > (ground.thickness_m if content.hide_ground else -np.inf)
        keep &= above_m < (np.inf if content.most_height_m is None else content.most_height_m)
    return cloud if keep.all() else cloud.select(keep)


def shown_points(cloud: PointCloud, most: int) -> PointCloud:
    """At most `most` points of a cloud, with colours and reflectance, in random order: any number of the first ones is
    the cloud thinned evenly, which a slow browser draws while the camera moves.
    """
    order = _order(len(cloud), most)
    rgb, reflectance = (
        None if values is None else values.take(order, axis=0) for values in (cloud.rgb, cloud.reflectance)
    )
    return PointCloud(cloud.xyz_m.take(order, axis=0), rgb, reflectance)


@lru_cache(maxsize=4)
def _order(n_points: int, most: int) -> Int64[np.ndarray, "m"]:
    keep = thin(n_points, most)
    return np.random.default_rng(0).permutation(n_points if keep is None else keep)


def point_colors(
    cloud: PointCloud, color: PointColor, ground: Ground, palette: Palette, boxes: Sequence[ShownBox] = ()
) -> UInt8[np.ndarray, "n 3"]:
    """The colour of each point; a cloud without the required quantity is coloured by depth."""
    if color is PointColor.RGB and cloud.rgb is not None:
        return cloud.rgb
    if color is PointColor.HEIGHT:
        return _mapped(ground.above_m(cloud.xyz_m))
    if color is PointColor.UNLABELLED:
        return _unlabelled(cloud, ground, palette, boxes)
    if color is not PointColor.DEPTH and cloud.reflectance is not None:
        # the square root brightens dark values, which most LiDAR returns have
        return _gray(np.sqrt(np.clip(cloud.reflectance, 0, 1)), palette)
    if color is PointColor.INTENSITY and cloud.rgb is not None:
        return _gray(cloud.rgb @ np.array([0.299, 0.587, 0.114], np.float32) / np.float32(255), palette)
    return _mapped(-np.log(np.maximum(cloud.xyz_m[:, 2], np.float32(0.05))))


def _unlabelled(
    cloud: PointCloud, ground: Ground, palette: Palette, boxes: Sequence[ShownBox]
) -> UInt8[np.ndarray, "n 3"]:
    colors = np.tile(np.array(palette.unlabelled, np.uint8), (len(cloud), 1))
    colors[ground.above_m(cloud.xyz_m) < ground.thickness_m] = palette.ground
    for shown in boxes:
        colors[contains(shown.box, cloud.xyz_m)] = palette.labelled
    return colors


def typical_distance_m(cloud: PointCloud) -> float:
    """Median distance of the points from the camera, metres."""
    if len(cloud) == 0:
        return EMPTY_DISTANCE_M
    some = cloud.xyz_m[:: max(1, len(cloud) // SAMPLE)]
    return max(float(np.median(np.linalg.norm(some, axis=1))), 0.05)


def point_size_m(frame: Frame, shown_share: float) -> float:
    """The default point size, metres.

    Args:
        shown_share: of a depth camera's points; the fewer, the larger each is, so that surfaces stay closed.
    """
    distance_m = typical_distance_m(frame.cloud)
    if frame.depth_m is None:
        return LIDAR_SHARE * distance_m
    return DEPTH_SPACINGS * distance_m / frame.camera.fx / math.sqrt(max(shown_share, 1e-3))


def scene_up(frame: Frame) -> Float64[np.ndarray, "3"]:
    """The up direction in the camera frame: against gravity if known, else up in the image."""
    return CAMERA_UP if frame.up is None else frame.up


def _gray(share: Float[np.ndarray, "n"], palette: Palette) -> UInt8[np.ndarray, "n 3"]:
    weakest, strongest = palette.grays
    level = (share * (strongest - weakest) + weakest).astype(np.uint8)
    return np.repeat(level[:, None], 3, axis=1)


def _mapped(values: Float32[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    """Blue for low values to red for high ones."""
    if len(values) == 0:
        return np.zeros((0, 3), np.uint8)
    low, high = np.percentile(values[:: max(1, len(values) // SAMPLE)], [LOW_PERCENT, HIGH_PERCENT])
    level = np.clip((values - np.float32(low)) * np.float32(255 / max(high - low, 1e-6)), 0, 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(level[None], cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)[0]


def pick(
    boxes: Sequence[OrientedBox], origin_m: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"]
) -> int | None:
    """The box that a ray enters first. Boxes around the ray's origin come last, the smallest of them first.

    Args:
        origin_m, direction: of the ray, camera frame.

    Returns:
        Its index, or None if the ray misses all boxes.
    """
    hits = [(*hit, box.volume_m3, n) for n, box in enumerate(boxes) if (hit := _entry(box, origin_m, direction))]
    return min(hits)[-1] if hits else None


def _entry(
    box: OrientedBox, origin_m: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"]
) -> tuple[bool, float] | None:
    """Whether the ray starts inside the box, and the distance at which it enters; None if it misses (slab test)."""
    T_box_camera = box.T_camera_box.inv()
    start = T_box_camera.apply(origin_m)
    along = T_box_camera.rotation.apply(direction)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        to_planes = (np.array([[-0.5], [0.5]]) * box.size_m - start) / along
    # a ray within the plane of a face gives 0/0, and counts as inside that slab
    near = np.nan_to_num(np.minimum(*to_planes), nan=-np.inf).max()
    far = np.nan_to_num(np.maximum(*to_planes), nan=np.inf).min()
    if far < max(near, 0.0):
        return None
    return (True, 0.0) if near < 0 else (False, float(near))


Segments = Float32[np.ndarray, "k 2 3"]

# Number of segments per side of an image box, since lens distortion curves its rays.
SIDE_STEPS = 4
# The frustum ends at this percentile of its points' depths; if it has no points, at this depth, metres.
FAR_PERCENT, EMPTY_FAR_M = 99.0, 5.0
# Distance between a view's image and the nearest of its points, as a share of the view's larger side.
GAP = 0.15
# The head of a box's heading begins and ends in front of the box, where no edge hides it: distances from the front and
# radius, shares of the box's mean side.
HEADING_FROM, HEADING_TO, HEADING_RADIUS = 0.08, 0.4, 0.13


def box_lines(size_m: Float64[np.ndarray, "3"]) -> Segments:
    """Edges of a box in its own axes, and an arrow from the middle of its top to beyond its front (+x): its heading.

    At the top, the object's own points do not hide it. Its head is four lines from the tip to the corners of a square,
    and the square: seen from anywhere, some of them are beside the shaft.
    """
    corners = 0.5 * CORNER_SIGNS * size_m
    (length_m, _, height_m), mean_m = size_m, size_m.mean()
    middle, ahead = np.array([0.0, 0.0, 0.5 * height_m]), np.array([1.0, 0.0, 0.0])
    tip = middle + (0.5 * length_m + HEADING_TO * mean_m) * ahead
    around = np.array([[0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]])
    square = middle + (0.5 * length_m + HEADING_FROM * mean_m) * ahead + HEADING_RADIUS * mean_m * around
    shaft = np.stack([middle, tip])
    head = np.stack([np.broadcast_to(tip, square.shape), square], axis=1)
    rim = np.stack([square, np.roll(square, -1, axis=0)], axis=1)
    return np.concatenate([corners[np.array(EDGES)], shaft[None], head, rim]).astype(np.float32)


def placed_box_lines(box: OrientedBox) -> Segments:
    """As `box_lines`, in the camera frame."""
    pose = box.pose
    return (box_lines(box.size_m) @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)


def frustum_lines(frame: Frame, image_box: Box2D) -> Segments:
    """The frustum of an image box: rays through its corners to the far end, and the outline there."""
    border = _border_px(image_box)
    rays = np.column_stack([undistort_px(frame.camera, border), np.ones(len(border))])
    depth = frame.cloud.xyz_m[in_frustum(frame.camera, frame.cloud.xyz_m, image_box), 2]
    far = rays * (float(np.percentile(depth, FAR_PERCENT)) if len(depth) else EMPTY_FAR_M)
    corners = far[::SIDE_STEPS]
    lines = [*zip(np.zeros_like(corners), corners, strict=True), *zip(far, np.roll(far, -1, axis=0), strict=True)]
    segments = np.array(lines, np.float32)
    # a corner outside the range of the lens model has no ray
    return segments[np.isfinite(segments).all(axis=(1, 2))]


def view_placement(view: PseudoView) -> Float64[np.ndarray, "3 3"]:
    """Where a pseudo-view's image is shown, parallel to its plane, camera frame. Rows: the start of the viewing
    direction's arrow; the centre of the image, in front of its nearest point; the arrow's end, at the median depth.
    """
    height_px, width_px = view.rgb.shape[:2]
    right, down = view.origin_m + 0.5 * (np.array([width_px, height_px]) - 1) * view.metres_per_px
    depth = view.xyz_m @ view.axes[2].astype(np.float32)
    near = float(depth.min()) if len(depth) else 0.0
    median = float(np.median(depth)) if len(depth) else 0.0
    in_front = near - GAP * float(view.extent_m.max())
    seen_from = in_front - 2 * GAP * float(view.extent_m.max())
    return np.array([[right, down, z] for z in (seen_from, in_front, median)]) @ view.axes


def _border_px(box: Box2D) -> Float64[np.ndarray, "n 2"]:
    corners = np.array(
        [[box.x_min, box.y_min], [box.x_max, box.y_min], [box.x_max, box.y_max], [box.x_min, box.y_max]], np.float64
    )
    share = np.arange(SIDE_STEPS)[:, None] / SIDE_STEPS
    return np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
