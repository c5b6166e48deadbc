"""Checks the camera's rotation: edges in depth should lie on edges of the image.

For a set of small rotations of the camera, the score is the mean strength of the image's edges at the projected depth
edges. If the calibration is right, the unrotated camera scores best (after J. Levinson and S. Thrun, "Automatic
Online Calibration of Cameras and Lasers", RSS 2013). A rotation moves pixels by a homography that does not depend on
depth, so only the pixels of the edges are needed. Repeated structures and shadows mislead in single frames, so the
scores of many frames are averaged, and both halves of these frames must give the same result.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from annotator.geometry.projection import every_nth, project, undistort_px
from annotator.types import Camera, Frame

# The tested rotations, degrees: about x and y (shifts of the image), and about z (in the image plane).
_TILTS_DEG, _ROLLS_DEG = np.arange(-3.0, 3.01, 0.5), np.arange(-3.0, 3.01, 1.0)
TURNS_DEG = np.stack(np.meshgrid(_TILTS_DEG, _TILTS_DEG, _ROLLS_DEG, indexing="ij"), axis=-1).reshape(-1, 3)
# Maximum number of examined frames, and minimum number for a result.
FRAMES = 24
LEAST_FRAMES = 4
LEAST_EDGES, MOST_EDGES = 200, 1500
MOST_POINTS = 60_000
# Minimum depth step at a foreground edge: metres, plus a fraction of the distance.
STEP_LIDAR, STEP_DEPTH = (0.5, 0.05), (0.1, 0.05)
# Pixels without depth count as far away: the background beside an edge often has no depth.
FAR_M = 20.0
# A point of a LiDAR is compared with this many neighbours on the image, within this distance.
NEIGHBOURS, REACH_PX = 6, 12.0
# A LiDAR's rows are further apart than the points within a row.
ROW_SPREAD = 3.0
# Minimum rotation that is reported; real recordings are off by up to 1.2 degrees (8 px between depth and image).
LEAST_TURN_DEG = 1.4
# Minimum gain over the unrotated camera, in standard deviations over all rotations.
LEAST_GAIN = 0.8
# Maximum difference between the best rotation of half of the frames and that of all.
MOST_APART_DEG = 0.75
# Minimum score of the unrotated camera, in the same unit. Real recordings have 2.1 to 4.7; if the calibration is off by
# more than the tested rotations, the score is at most 0.6.
LEAST_FIT, FRAMES_FOR_NO_FIT = 1.0, 8


@dataclass
class Alignment:
    """Collects the scores of the rotations, frame by frame.

    Attributes:
        scores: for each frame with enough edges, the scores of all rotations; mean 0, standard deviation 1.
    """

    scores: list[Float64[np.ndarray, "k"]] = field(default_factory=list)

    def add(self, frame: Frame) -> None:
        """Adds a frame; ignores it if it has too few edges."""
        px = depth_edges(frame)
        if len(px) < LEAST_EDGES:
            return
        scores = _fit(frame.camera, every_nth(px, MOST_EDGES), edge_strength(frame.rgb))
        spread = float(scores.std())
        if np.isfinite(spread) and spread > 0:
            self.scores.append((scores - scores.mean()) / spread)

    def problem(self) -> str | None:
        """Returns what is wrong with the calibration; None if it fits or the result is unclear."""
        if len(self.scores) < LEAST_FRAMES:
            return None
        pooled, turns = np.mean(self.scores, axis=0), TURNS_DEG
        here, best = float(pooled[np.linalg.norm(turns, axis=1).argmin()]), turns[pooled.argmax()]
        halves = [turns[np.mean(self.scores[start::2], axis=0).argmax()] for start in (0, 1)]
        # rolls are tested in steps of 1 degree
        agree = all(np.linalg.norm(half - best) <= MOST_APART_DEG + float(half[2] != best[2]) for half in halves)
        if agree and pooled.max() - here >= LEAST_GAIN and np.linalg.norm(best) >= LEAST_TURN_DEG:
            x, y, z = best
            return (
                f"edges in depth fit the image better if the camera is turned by {x:+g} {y:+g} {z:+g} degrees (x y z)"
            )
        if len(self.scores) >= FRAMES_FOR_NO_FIT and here < LEAST_FIT:
            return "edges in depth do not fit the image, even if the camera is turned by up to 3 degrees"
        return None


def depth_edges(frame: Frame) -> Float64[np.ndarray, "n 2"]:
    """Returns the pixels (u, v) of foreground edges in depth."""
    # depth from another camera has gaps between its pixels
    if frame.depth_m is None or frame.cloud.pixel_index is None:
        return _edges_of_points(frame)
    return _edges_of_image(np.where(frame.depth_m > 0, frame.depth_m, np.float32(FAR_M)))


def _edges_of_image(depth_m: Float32[np.ndarray, "h w"]) -> Float64[np.ndarray, "n 2"]:
    edges: Bool[np.ndarray, "h w"] = np.zeros(depth_m.shape, bool)
    step = STEP_DEPTH[0] + STEP_DEPTH[1] * depth_m
    for axis in (0, 1):
        for shift in (-2, 2):
            edges |= np.roll(depth_m, shift, axis) - depth_m > step
    # np.roll wraps around at the border
    edges[:3] = edges[-3:] = edges[:, :3] = edges[:, -3:] = False
    v, u = np.nonzero(edges)
    return np.stack([u, v], axis=1).astype(np.float64)


def _edges_of_points(frame: Frame) -> Float64[np.ndarray, "n 2"]:
    from scipy.spatial import cKDTree

    xyz_m = frame.cloud.xyz_m[:: len(frame.cloud) // MOST_POINTS + 1]
    px = project(frame.camera, xyz_m)
    seen = np.isfinite(px).all(axis=1)
    px, z_m = px[seen], xyz_m[seen, 2].astype(np.float64)
    if len(px) <= NEIGHBOURS:
        return np.zeros((0, 2))
    scaled_px = px * [1.0, ROW_SPREAD]
    _, neighbours = cKDTree(scaled_px).query(scaled_px, k=NEIGHBOURS + 1, distance_upper_bound=REACH_PX)
    # missing neighbours have the index len(px), where -inf is appended
    farthest_m = np.append(z_m, -np.inf)[neighbours].max(axis=1)
    return px[farthest_m - z_m > STEP_LIDAR[0] + STEP_LIDAR[1] * z_m]


def edge_strength(rgb: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Returns the edge strength of each pixel of an image, relative to its surroundings."""
    import cv2

    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    # normalised, so that foliage does not outweigh the outline of a car
    local = np.minimum(gradient / (cv2.GaussianBlur(gradient, (0, 0), 15.0) + 10.0), 3.0)
    return np.asarray(cv2.GaussianBlur(local, (0, 0), 2.0), np.float32)


def _fit(
    camera: Camera, px: Float[np.ndarray, "n 2"], strength: Float32[np.ndarray, "h w"]
) -> Float64[np.ndarray, "k"]:
    """Returns the mean strength of the image's edges at the depth edges, for each rotation."""
    from scipy.spatial.transform import Rotation

    height, width = strength.shape
    rays = np.column_stack([undistort_px(camera, px), np.ones(len(px))])
    rays = rays[np.isfinite(rays).all(axis=1)]
    rotations = Rotation.from_rotvec(TURNS_DEG, degrees=True).as_matrix()
    average, scores = float(strength.mean()), np.empty(len(rotations))
    for number, R in enumerate(rotations):
        # pixels that cannot be projected are NaN and compare as false
        u, v = np.rint(project(camera, rays @ R.T)).T
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        # a rotation that moves half of the edges off the image gets a neutral score
        scores[number] = (
            strength[v[inside].astype(np.int64), u[inside].astype(np.int64)].mean() if inside.mean() > 0.5 else average
        )
    return scores
