"""Where the virtual camera of a recording of clouds stands: at the LiDAR, or where the points of map coordinates are.

Clouds without a camera are usually in the sensor's own coordinates. If the middle of a cloud is farther from (0, 0, 0)
than the points of a scan are from their sensor, its coordinates are those of a map or of a local grid, and 32-bit
floats cannot hold them. Then the *origin* of the recording is the middle of its first readable cloud, in whole metres.
It is one for all frames, so that what stands still does so in all of them, and it is stored with the recording
(`ReaderOptions.origin`), so that frames stay the same when the first file is gone.

The virtual camera stands at the origin. A frame farther away than `STEP_M` (a vehicle that drives on) has its camera
whole steps from the origin: the points stay near the camera, which moves in few frames instead of a little in each.

Its image is rendered from the points, for operators and detectors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import islice

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import RigidTransform

from annotator.geometry.projection import inside_image, project
from annotator.recordings.clouds.columns import RawCloud
from annotator.recordings.plausible import DISTANCES_M
from annotator.recordings.recording import Place
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import FrameError

# A LiDAR may see farther, but the middle of what it sees is nearer.
FARTHEST_MIDDLE_M = 500.0
STEP_M = 100.0
# No cloud reaches so far from a camera in it.
FARTHEST_POINT_M = 100_000.0
# Rounding of coordinates that users should know.
LEAST_STEP_M = 1e-3
# Points that give the middle of a cloud.
MOST_POINTS = 10_000
# If this many frames at the beginning are unreadable, the others are not tried.
FRAMES_TRIED = 5
NOWHERE = np.zeros(3)


class Origin:
    """The origin of one recording, `given` by the option, in the clouds' coordinates, or by the first readable cloud.

    `notes` tell what was found in the clouds that were read; a damaged one is told by its own frame.
    """

    def __init__(self, given: Place | None, clouds: Callable[[], Iterable[Callable[[], RawCloud]]]) -> None:
        self._given, self._clouds = given, clouds
        self._found: Float64[np.ndarray, "3"] | None = None if given is None else np.array(given)
        self.notes: tuple[str, ...] = ()

    @property
    def xyz_m(self) -> Float64[np.ndarray, "3"]:
        """The origin; zeros in the sensor's own coordinates. Without the option, it reads a cloud."""
        if self._found is None:
            self._found = NOWHERE
            for read in islice(self._clouds(), FRAMES_TRIED):
                with suppress(FrameError, ValueError, OSError):
                    self._found = _far_middle(read())
                    break
        return self._found

    def of(self, raw: RawCloud) -> Float64[np.ndarray, "3"]:
        """Returns the place of a frame's virtual camera, in the clouds' coordinates."""
        points = _different(raw)
        middle = np.median(points, axis=0)
        if self._given is None and not is_far(middle):
            return NOWHERE
        self.notes = self.notes or (*_unit_note(points, middle), *_rounding_note(raw))
        away = middle - self.xyz_m
        reach = STEP_M if self.xyz_m.any() else FARTHEST_MIDDLE_M
        return self.xyz_m if np.linalg.norm(away) <= reach else self.xyz_m + STEP_M * np.round(away / STEP_M)


def without_strays(raw: RawCloud, place_m: Float64[np.ndarray, "3"]) -> RawCloud:
    """Returns a cloud in map coordinates without points that are no returns, but are not exactly (0, 0, 0) either.

    Some drivers add the sensor's height to all points, or write -9999. `place_m` is the camera's; zeros in a sensor's
    own coordinates, in which such points cannot be told.
    """
    if not place_m.any():
        return raw
    near = (np.abs(raw.xyz_m - place_m) < FARTHEST_POINT_M).all(axis=1)
    return raw if near.all() or not near.any() else raw.select(near)


def world_pose(T_camera_cloud: RigidTransform) -> RigidTransform | None:
    """Returns the pose of a real camera in the clouds' coordinates if these are those of a map, else None."""
    T_cloud_camera = T_camera_cloud.inv()
    return T_cloud_camera if is_far(T_cloud_camera.translation) else None


def is_far(xyz_m: Float64[np.ndarray, "3"]) -> bool:
    """True if a camera or the middle of a cloud is at a place that no coordinates of a sensor have."""
    return bool(np.linalg.norm(xyz_m) > FARTHEST_MIDDLE_M)


def _different(raw: RawCloud) -> Float64[np.ndarray, "n 3"]:
    """Returns a cloud's different points (of every n-th one, if they are many).

    A driver may write one place for all beams without a return, which may be most of the points.
    """
    return np.unique(raw.xyz_m[:: len(raw.xyz_m) // MOST_POINTS + 1], axis=0)


def _unit_note(points: Float64[np.ndarray, "n 3"], middle: Float64[np.ndarray, "3"]) -> tuple[str, ...]:
    """Returns a note on a cloud that has its place in a map only because it is not in metres, as it seems."""
    distance_m = float(np.median(np.linalg.norm(points - middle, axis=1)))
    if distance_m <= DISTANCES_M[1]:
        return ()
    return (f"half of its points are more than {distance_m:.4g} m from their middle; are they in metres?",)


def _rounding_note(raw: RawCloud) -> tuple[str, ...]:
    """Returns a note on the points of a file that was saved with 32-bit floats, if these are too coarse."""
    highest = float(np.abs(raw.xyz_m).max())
    step_m = float(np.spacing(np.float32(highest)))
    if step_m < LEAST_STEP_M or (raw.xyz_m != raw.xyz_m.astype(np.float32)).any():
        return ()
    return (
        f"its coordinates, up to {highest:,.0f} m, are rounded to {step_m:.2g} m, as 32-bit floats are; save clouds "
        "with 64-bit floats, or relative to an origin",
    )


def _far_middle(raw: RawCloud) -> Float64[np.ndarray, "3"]:
    middle = np.median(_different(raw), axis=0)
    return np.floor(middle) if is_far(middle) else NOWHERE


# A point is drawn as a square: this length, projected, is its side, within these bounds in pixels.
POINT_SIZE_M = 0.06
SMALLEST_PX, LARGEST_PX = 2, 9
NEAREST_M = 0.1


def virtual_image(camera: Camera, cloud: PointCloud) -> UInt8[np.ndarray, "h w 3"]:
    """Renders points (camera frame) as squares, nearest in front, in their colours; without these, by distance."""
    import cv2

    px = project(camera, cloud.xyz_m)
    z_m = cloud.xyz_m[:, 2]
    drawn = np.flatnonzero(inside_image(camera, px) & (z_m > NEAREST_M))
    # ranks from 1, far to near: the point with the highest rank is visible at a pixel
    drawn = drawn[np.argsort(-z_m[drawn], kind="stable")]
    size_px = np.clip(np.ceil(POINT_SIZE_M * camera.fx / z_m[drawn]), SMALLEST_PX, LARGEST_PX).astype(np.int64)
    corner = np.floor(px[drawn] - size_px[:, None] / 2 + 1).astype(np.int64) + LARGEST_PX
    seen = np.zeros((camera.height_px + LARGEST_PX, camera.width_px + LARGEST_PX))
    for size in range(SMALLEST_PX, LARGEST_PX + 1):
        of_size = np.flatnonzero(size_px == size)
        if len(of_size) == 0:
            continue
        rank = np.zeros_like(seen)
        # if several points have the same corner, the last one stays, which is the nearest
        rank[corner[of_size, 1], corner[of_size, 0]] = of_size + 1
        # fills the square right of and below each corner
        squares = cv2.dilate(rank, np.ones((size, size), np.uint8), anchor=(size - 1, size - 1))
        np.maximum(seen, squares, out=seen)
    palette = np.concatenate([np.zeros((1, 3), np.uint8), _point_colors(cloud)[drawn]])
    return palette[seen[LARGEST_PX:, LARGEST_PX:].astype(np.int64)]


def has_virtual_image(frame: Frame) -> bool:
    """True if a frame's image is rendered from its cloud, so that the two cannot lie beside each other.

    The frame is as its recording gives it, without a correction.
    """
    return np.array_equal(frame.rgb, virtual_image(frame.camera, frame.cloud))


def _point_colors(cloud: PointCloud) -> UInt8[np.ndarray, "n 3"]:
    """Returns the points' colours, or colours by distance (red near, blue far), with reflectance as brightness."""
    import cv2

    if cloud.rgb is not None:
        return cloud.rgb
    near = 1 / np.maximum(np.linalg.norm(cloud.xyz_m, axis=1), 1.0)
    level = np.rint(255 * np.sqrt(near)).astype(np.uint8)
    bgr = cv2.applyColorMap(level[:, None], cv2.COLORMAP_JET)[:, 0]
    if cloud.reflectance is None:
        return np.ascontiguousarray(bgr[:, ::-1])
    brightness = 0.5 + 0.5 * np.sqrt(cloud.reflectance)
    return np.rint(bgr[:, ::-1] * brightness[:, None]).astype(np.uint8)
