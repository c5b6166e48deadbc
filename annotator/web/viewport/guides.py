"""What orients the viewer of a scene: a grid on the ground, rings around a LiDAR, axes, the camera, and named views."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from annotator.geometry.ground import Ground
from annotator.geometry.projection import undistort_px
from annotator.types import Frame, OrientedBox
from annotator.web.viewport.palette import Palette

Vector = Float64[np.ndarray, "3"]
Segments = Float32[np.ndarray, "k 2 3"]
Colors = UInt8[np.ndarray, "k 2 3"]

# Ahead, left, up: red, green, blue.
AXES_COLORS = ((232, 86, 74), (96, 190, 96), (96, 144, 246))
# The grid and the rings reach the points up to this percentile of their distances; number of grid cells and of rings to
# there, at most; lines of a ring; length of the axes as a share.
REACH_PERCENT, MOST_CELLS, MOST_RINGS, RING_LINES, AXES_SHARE = 90.0, 10, 5, 72, 0.06
# Points for estimates of distances, and the reach of an empty scene, metres.
SAMPLE, EMPTY_M = 5_000, 5.0
# Opening angles: of most views, and of those along an axis, which hardly shrink what is far.
FOV_RAD, NARROW_RAD = math.radians(60.0), math.radians(20.0)
# The first view stands behind and above the camera: shares of the scene's distance. Distances of the other views: in
# sides of the selected box, whose surroundings are to be seen; behind it, and above.
BEHIND, ABOVE = 0.2, 0.2
AROUND_SIDES, FOCUS_SIDES, BEHIND_SIDES, ABOVE_SIDES = 4.0, 2.2, 2.0, 0.9
# An arrow's head: length and radius as shares of the arrow, and number of lines of its cone.
HEAD_LENGTH, HEAD_RADIUS, HEAD_LINES = 0.12, 0.045, 16
# A number beside a ring is written in strokes, like a road marking: its height as a share of the radius, the width of
# a digit and its gap as a share of that, and for each digit its segments, as on a pocket calculator.
DIGIT_SHARE, DIGIT_ASPECT = 0.11, 0.35
STROKES = np.array(
    [
        [[0, 2], [1, 2]],
        [[1, 2], [1, 1]],
        [[1, 1], [1, 0]],
        [[0, 0], [1, 0]],
        [[0, 1], [0, 0]],
        [[0, 2], [0, 1]],
        [[0, 1], [1, 1]],
    ]
)
DIGITS = ("012345", "12", "01346", "01236", "1256", "02356", "023456", "012", "0123456", "012356")


class Look(StrEnum):
    """A named view: of the scene, or of the selected box (the last two: only of that)."""

    START = "start"
    TOP = "top"
    FRONT = "front"
    SIDE = "side"
    CAMERA = "camera"
    BEHIND = "behind"
    FOCUS = "focus"


@dataclass(frozen=True, eq=False)
class Stand:
    """Where the viewer stands and what it looks at, camera frame, and its vertical opening angle."""

    position_m: Vector
    look_at_m: Vector
    up: Vector
    fov_rad: float = FOV_RAD


def stand(
    look: Look, frame: Frame, ground: Ground, box: OrientedBox | None, gaze: Vector, aspect: float
) -> Stand | None:
    """The viewer of a named view; None if that is one of the selected box and there is none.

    Args:
        gaze: direction in which the viewer looks now.
        aspect: width of the view divided by its height.
    """
    ahead, left, up = ground.axes
    if look is Look.CAMERA:
        camera = frame.camera
        fov_rad = 2 * math.atan(0.5 * max(camera.height_px / camera.fy, camera.width_px / camera.fx / aspect))
        return Stand(np.zeros(3), np.array([0.0, 0.0, _depth_m(frame)]), np.array([0.0, -1.0, 0.0]), fov_rad)
    if look is Look.START:
        middle = np.array([0.0, 0.0, _depth_m(frame)])
        return Stand(middle[2] * (ABOVE * up - BEHIND * np.array([0.0, 0.0, 1.0])), middle, up)
    if box is None:
        if look in (Look.BEHIND, Look.FOCUS):
            return None
        middle, size_m = _depth_m(frame) * ahead + ground.level_m * up, 2 * _depth_m(frame)
    else:
        side_m = float(box.size_m.max())
        middle, size_m = box.center_m, AROUND_SIDES * side_m + 0.5 * _depth_m(frame)
        ahead = box.rotation[:, 0] - (box.rotation[:, 0] @ up) * up
        if np.linalg.norm(ahead) < 1e-3:
            ahead = ground.axes[0]
        ahead = ahead / np.linalg.norm(ahead)
        left = np.cross(up, ahead)
        if look is Look.FOCUS:
            return Stand(middle - FOCUS_SIDES * side_m * gaze, middle, up)
        if look is Look.BEHIND:
            return Stand(middle + side_m * (ABOVE_SIDES * up - BEHIND_SIDES * ahead), middle, up)
    # a scene is seen from where its camera stands, an object from in front of it
    toward = {Look.TOP: up - 1e-3 * ahead, Look.FRONT: -ahead if box is None else ahead, Look.SIDE: left}[look]
    return Stand(middle + 0.5 * size_m / math.tan(0.5 * NARROW_RAD) * toward, middle, up, NARROW_RAD)


def guide_lines(frame: Frame, ground: Ground, reach_m: float, palette: Palette) -> tuple[Segments, Colors]:
    """The grid, the rings around a LiDAR with their radii in metres, axes on the ground and the camera's frustum.

    Args:
        reach_m: from `scene_reach_m`, of one frame for all of a recording, so that nothing jumps between frames.
    """
    level = ground.level_m * ground.axes[2]
    step_m = _round_up(reach_m / MOST_CELLS)
    is_lidar = frame.depth_m is None
    half = math.ceil(reach_m / step_m) * step_m
    marks = np.arange(-half, half + 0.5 * step_m, step_m)
    # a depth camera sees nothing behind it
    back = -half if is_lidar else 0.0
    across = [[[along, -half], [along, half]] for along in marks if along >= back]
    grid = np.array([*across, *([[back, side], [half, side]] for side in marks)])
    parts = [(grid @ ground.axes[:2] + level, palette.grid)]
    size_m = AXES_SHARE * reach_m
    if is_lidar:
        ring_m = _round_up(reach_m / MOST_RINGS)
        angle = np.linspace(0, 2 * np.pi, RING_LINES + 1)
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ ground.axes[:2]
        for radius_m in np.arange(ring_m, half + 0.5 * ring_m, ring_m):
            around = radius_m * ring
            parts.append((np.stack([around[:-1], around[1:]], axis=1) + level, palette.rings))
            number = _number_lines(f"{radius_m:g}", DIGIT_SHARE * radius_m) + np.array([radius_m, 0.0])
            parts.append((number @ ground.axes[:2] + level, palette.rings))
    parts += [
        (arrow_lines(level, level + size_m * axis, level + size_m * axis), color)
        for axis, color in zip(ground.axes, AXES_COLORS, strict=True)
    ]
    parts.append((_camera_lines(frame, size_m), palette.camera))
    lines = np.concatenate([part for part, _ in parts]).astype(np.float32)
    colors = np.concatenate([np.broadcast_to(np.array(color, np.uint8), part.shape) for part, color in parts])
    return lines, colors


def _number_lines(text: str, height_m: float) -> Float64[np.ndarray, "k 2 2"]:
    """Strokes of a number, ahead and left, beyond the origin and centred on it; a gap stands for a decimal point."""
    lines = np.concatenate(
        [
            STROKES[[int(stroke) for stroke in DIGITS[int(letter)]]] * [0.7, 0.5] + [place, 0.3]
            for place, letter in enumerate(text)
            if letter.isdigit()
        ]
    )
    right, ahead = lines[..., 0], lines[..., 1]
    return height_m * np.stack([ahead, DIGIT_ASPECT * (0.5 * (len(text) - 0.3) - right)], axis=-1)


def arrow_lines(
    start_m: Float64[np.ndarray, "3"], tip_m: Float64[np.ndarray, "3"], end_m: Float64[np.ndarray, "3"]
) -> Segments:
    """An arrow as lines: its shaft, then the cone of its head from the tip to a ring, then the ring.

    The colour of lines does not depend on the lights, in contrast to that of a mesh.

    Args:
        start_m, end_m: of the shaft.
        tip_m: tip of the head, on the shaft: at the end of the shaft, points would hide it.
    """
    along = end_m - start_m
    length = float(np.linalg.norm(along))
    direction = along / length
    across = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    across /= np.linalg.norm(across)
    angle = 2 * np.pi * np.arange(HEAD_LINES)[:, None] / HEAD_LINES
    spokes = np.cos(angle) * across + np.sin(angle) * np.cross(direction, across)
    ring = tip_m - HEAD_LENGTH * along + HEAD_RADIUS * length * spokes
    cone = np.stack([np.broadcast_to(tip_m, ring.shape), ring], axis=1)
    rim = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)
    return np.concatenate([np.stack([start_m, end_m])[None], cone, rim]).astype(np.float32)


def _camera_lines(frame: Frame, depth_m: float) -> Float64[np.ndarray, "k 2 3"]:
    """The camera's frustum to a depth, its rays and their ends."""
    width, height = frame.camera.width_px - 0.5, frame.camera.height_px - 0.5
    corners_px = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
    ends = depth_m * np.column_stack([undistort_px(frame.camera, corners_px), np.ones(4)])
    lines = np.concatenate(
        [np.stack([np.zeros_like(ends), ends], axis=1), np.stack([ends, np.roll(ends, -1, 0)], axis=1)]
    )
    return lines[np.isfinite(lines).all(axis=(1, 2))]


def _depth_m(frame: Frame) -> float:
    """Median depth of the points in front of the camera, metres."""
    depth = frame.cloud.xyz_m[:: max(1, len(frame.cloud) // SAMPLE), 2]
    depth = depth[depth > 0]
    return max(float(np.median(depth)), 0.2) if len(depth) else EMPTY_M


def scene_reach_m(frame: Frame) -> float:
    """How far the guides reach: to most of the points, metres."""
    if len(frame.cloud) == 0:
        return EMPTY_M
    distance = np.linalg.norm(frame.cloud.xyz_m[:: max(1, len(frame.cloud) // SAMPLE)], axis=1)
    return max(float(np.percentile(distance, REACH_PERCENT)), 0.2)


def _round_up(length_m: float) -> float:
    """The next of 1, 2, 5 and 10 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return power * next(step for step in (1, 2, 5, 10) if step * power >= length_m * (1 - 1e-9))
