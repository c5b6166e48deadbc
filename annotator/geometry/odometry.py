"""Where a sensor was, by what it has seen: each frame is registered with what was seen before.

Depth images: colours and depths of a frame and of the latest *key frame*, which another one follows once little of it
is seen: errors grow with key frames, not with frames. F. Steinbruecker, J. Sturm, D. Cremers, "Real-Time Visual
Odometry from Dense RGB-D Images" (ICCV Workshops 2011), with a term for depth, as Open3D has it.
Scans: points onto planes of a map of the latest scans. Residuals are weighted, so that what moves counts little.

There is no loop closure: a place that is seen again after others corrects nothing.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.geometry.normals import normals_knn
from annotator.geometry.projection import every_nth
from annotator.types import Frame

if TYPE_CHECKING:
    from types import ModuleType

Matrix = Float64[np.ndarray, "4 4"]

# Depth images are thinned to at most this width, and used up to this distance.
WIDTH_PX, FARTHEST_M = 640, 8.0
# Iterations, at the coarsest scale first; depths that differ by more are no counterparts.
ITERATIONS, DEPTH_APART_M = (10, 7, 5), 0.07
# A frame is registered again until that moves it by less than this; once is enough if its speed was guessed so well.
ROUNDS, SETTLED_M, GUESSED_M = 6, 1e-3, 1e-2
# A frame becomes the key frame if it sees less of the last one, share of what others saw, or has moved or turned by so
# much.
KEY_OVERLAP, KEY_MOVED_M, KEY_TURNED_RAD = 0.92, 0.2, 0.2
# Pixels whose brightness differs so much from their neighbours' hold a frame; of 255.
EDGE, NORMAL_POINTS, NEIGHBOURS = 12.0, 3000, 12

# Scans are thinned to points this far apart, share of their median distance, and within these limits.
SPACING, SPACINGS_M = 0.03, (0.02, 1.0)
# What is nearer than this, share of that distance, is what carries the sensor.
OWN = 0.15
# Points of one scan, and of the map, are further apart or closer by these factors; how far counterparts may be, first
# where the speed is not known; residuals from which weights fall; how far the sensor moves between scans of the map.
COARSE, FINE, REACHES, TOLERANCE, MAP_STEP = 1.5, 0.5, (12.0, 3.0, 1.2), 0.4, 2.0
MAP_SCANS, SCAN_ITERATIONS = 20, 30

# A frame is trusted from these on. Of generated drives and tours, also with an eighth of their frames, those that were
# well registered had at least 0.557 and 0.089; the others at most 0.559, or a grip of at most 0.034.
LEAST_OVERLAP, LEAST_GRIP = 0.57, 0.05
LEAST_POINTS = 100


@dataclass(frozen=True)
class Placed:
    """Where a frame's camera is, in the frame of the first camera, and how sure that is.

    Attributes:
        T_first_camera: None if it is not to be trusted.
        overlap: share of the frame that has counterparts in what was seen before.
        rmse: root mean square residual of these: metres for scans; of depths and brightness for depth images.
        grip: how well the seen surfaces and edges hold the frame in each direction, 0..1: along a bare wall, or in a
            tunnel, it may slide.
    """

    T_first_camera: RigidTransform | None
    overlap: float = 1.0
    rmse: float = 0.0
    grip: float = 1.0


class Found(NamedTuple):
    T: Matrix
    overlap: float
    rmse: float
    grip: float


class Odometry:
    """Places frames, which are added in their order. One that is not trusted is left out, and the next one is tried."""

    def __init__(self, first: Frame) -> None:
        has_depth = first.depth_m is not None and first.cloud.pixel_index is not None
        # the images of what is not registered so, or not undistorted, do not fit its depth
        self._way = DepthImages() if has_depth and not any(first.camera.distortion) else Scans(first)
        # of the latest frames that follow one another
        self._poses = deque[Matrix](maxlen=2)

    def add(self, frame: Frame) -> Placed:
        """Places a frame; the first one is where the world begins. None of them may be empty."""
        seen = self._way.seen(frame)
        if not self._poses:
            self._poses.append(np.eye(4))
            self._way.keep(seen, np.eye(4), 0.0)
            return Placed(RigidTransform.identity())
        before, last = self._poses[0], self._poses[-1]
        found = self._way.place(seen, last @ np.linalg.inv(before) @ last, len(self._poses) > 1)
        if found.overlap < LEAST_OVERLAP or found.grip < LEAST_GRIP:
            self._poses = deque([last], maxlen=2)
            return Placed(None, *found[1:])
        # repeated products are no rotations for ever
        T = RigidTransform.from_matrix(found.T)
        self._poses.append(T.as_matrix())
        self._way.keep(seen, T.as_matrix(), found.overlap)
        return Placed(T, *found[1:])


class DepthImage(NamedTuple):
    """Of Open3D; the share of its pixels that have a depth; and how well it holds."""

    image: Any
    intrinsics: Any
    share: float
    grip: float


class DepthImages:
    """Colours and depths, registered with those of a key frame."""

    _key: DepthImage
    _T_key: Matrix
    # the largest overlap with the key frame
    _most = 0.0

    def seen(self, frame: Frame) -> DepthImage:
        assert frame.depth_m is not None
        o3d, every = _open3d(), -(-frame.camera.width_px // WIDTH_PX)
        rgb, depth_m = (np.ascontiguousarray(each[::every, ::every]) for each in (frame.rgb, frame.depth_m))
        matrix = frame.camera.matrix.astype(np.float64)
        matrix[:2] /= every
        images = (o3d.t.geometry.Image(o3d.core.Tensor(each)) for each in (rgb, depth_m))
        grey = rgb.mean(axis=2)
        edges = np.abs(grey[1:, :-1] - grey[:-1, :-1]) + np.abs(grey[:-1, 1:] - grey[:-1, :-1])
        normals = normals_knn(every_nth(frame.cloud.xyz_m, NORMAL_POINTS), NEIGHBOURS)
        grip = max(_least_share(normals), float((edges > EDGE).mean()))
        share = float(((depth_m > 0) & (depth_m < FARTHEST_M)).mean())
        return DepthImage(o3d.t.geometry.RGBDImage(*images), o3d.core.Tensor(matrix), max(share, 1e-3), grip)

    def place(self, seen: DepthImage, guess: Matrix, is_steady: bool) -> Found:
        o3d = _open3d()
        of = o3d.t.pipelines.odometry
        limits = [of.OdometryConvergenceCriteria(count) for count in ITERATIONS]
        loss = of.OdometryLossParams(DEPTH_APART_M)
        T = np.linalg.inv(self._T_key) @ guess
        settled_m = GUESSED_M if is_steady else SETTLED_M
        for _ in range(ROUNDS):
            start = o3d.core.Tensor(T)
            try:
                found = of.rgbd_odometry_multi_scale(
                    seen.image, self._key.image, seen.intrinsics, start, 1.0, FARTHEST_M, limits, of.Method.Hybrid, loss
                )
            except RuntimeError:  # nothing tells how to move it
                return Found(guess, 0.0, 0.0, seen.grip)
            moved_m, T = np.linalg.norm(found.transformation.numpy()[:3, 3] - T[:3, 3]), found.transformation.numpy()
            if moved_m < settled_m:
                break
            settled_m = SETTLED_M
        return Found(self._T_key @ T, min(found.fitness / seen.share, 1.0), found.inlier_rmse, seen.grip)

    def keep(self, seen: DepthImage, T: Matrix, overlap: float) -> None:
        if overlap == 0:  # the first frame
            self._key, self._T_key = seen, T
        moved = np.linalg.inv(self._T_key) @ T
        turned = RigidTransform.from_matrix(moved).rotation.magnitude()
        self._most = max(self._most, overlap)
        if overlap < KEY_OVERLAP * self._most or np.linalg.norm(moved[:3, 3]) > KEY_MOVED_M or turned > KEY_TURNED_RAD:
            self._key, self._T_key, self._most = seen, T, 0.0


class Scans:
    """Points, registered with a map of those before."""

    def __init__(self, first: Frame) -> None:
        distance_m = float(np.median(np.linalg.norm(first.cloud.xyz_m, axis=1)))
        self._own_m, self._spacing_m = OWN * distance_m, float(np.clip(SPACING * distance_m, *SPACINGS_M))
        self._scans = deque[tuple[Matrix, Any]](maxlen=MAP_SCANS)

    def seen(self, frame: Frame) -> Any:
        o3d, xyz_m = _open3d(), frame.cloud.xyz_m.astype(np.float64)
        others = xyz_m[np.linalg.norm(xyz_m, axis=1) > self._own_m]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(others))
        cloud = cloud.voxel_down_sample(FINE * self._spacing_m)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3 * self._spacing_m, 20))
        return cloud

    def place(self, seen: Any, guess: Matrix, is_steady: bool) -> Found:
        of = _open3d().pipelines.registration
        points = seen.voxel_down_sample(COARSE * self._spacing_m)
        onto = of.TransformationEstimationPointToPlane(of.GMLoss(TOLERANCE * self._spacing_m))
        limits = of.ICPConvergenceCriteria(1e-6, 1e-6, SCAN_ITERATIONS)
        for reach in REACHES[is_steady:]:
            found = of.registration_icp(points, self._map, reach * self._spacing_m, guess, onto, limits)
            guess = found.transformation
        normals = np.asarray(self._map.normals)[np.asarray(found.correspondence_set).reshape(-1, 2)[:, 1]]
        return Found(guess.copy(), found.fitness, found.inlier_rmse, _least_share(normals))

    def keep(self, seen: Any, T: Matrix, overlap: float) -> None:
        if self._scans and np.linalg.norm(T[:3, 3] - self._scans[-1][0][:3, 3]) < MAP_STEP * self._spacing_m:
            return
        o3d = _open3d()
        self._scans.append((T, o3d.geometry.PointCloud(seen).transform(T)))
        together = o3d.geometry.PointCloud()
        for _, scan in self._scans:
            together += scan
        self._map = together.voxel_down_sample(FINE * self._spacing_m)
        self._map.normalize_normals()


def _least_share(normals: np.ndarray) -> float:
    """Least share of surfaces that face a direction; 1/3 if they face all of them."""
    return float(np.linalg.eigvalsh(normals.T @ normals / max(len(normals), 1))[0])


def _open3d() -> ModuleType:
    import open3d  # loads slowly

    # a line for each frame that cannot be registered
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
