"""The lines of sight of a sensor as a grid of cells: which points hide others, and how a distant object is sampled.

A depth camera has one cell per pixel. A LiDAR has cells of equal angles, whose size is estimated from its points; its
origin is taken to be that of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial import cKDTree

from annotator.geometry.projection import project
from annotator.geometry.thinning import thin
from annotator.types import Camera, Frame

# Gaps between the cells of a surface up to this size are closed, cells.
GAP = 4
# A point is hidden only if it lies behind the hiding surface by more than this share of its distance.
BEHIND_SHARE = 0.01
# Points of a LiDAR whose neighbours are measured, and the number of neighbours that give the density.
SAMPLED, NEIGHBOURS = 2000, 32


@dataclass(frozen=True, eq=False)
class SightGrid:
    """The cells of a sensor.

    Attributes:
        camera: of a depth camera, whose cells are pixels; None for a LiDAR.
        step_rad: angle between the lines of sight, horizontally and vertically.
    """

    camera: Camera | None
    step_rad: tuple[float, float]

    @classmethod
    def of(cls, frame: Frame) -> SightGrid:
        """The grid of the sensor that measured a frame's cloud; a cloud without points has an arbitrary one."""
        if frame.cloud.pixel_index is not None:
            return cls(frame.camera, (1 / frame.camera.fx, 1 / frame.camera.fy))
        return cls(None, _angular_steps(frame.cloud.xyz_m))

    def cells(self, xyz_m: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Column and row of each point (camera frame), not rounded; NaN for points that the camera cannot see."""
        if self.camera is not None:
            return project(self.camera, xyz_m)
        return _angles(xyz_m) / self.step_rad

    def hides(self, front_m: Float[np.ndarray, "n 3"], behind_m: Float[np.ndarray, "m 3"]) -> Bool[np.ndarray, "m"]:
        """Which points of `behind_m` lie behind the surface that `front_m` samples, as seen from the sensor."""
        hidden = np.zeros(len(behind_m), np.bool_)
        at, known = _rounded(self.cells(behind_m))
        front_at, usable = _rounded(self.cells(front_m))
        if not known.any() or not usable.any():
            return hidden
        low, high = front_at[usable].min(axis=0) - GAP, front_at[usable].max(axis=0) + GAP
        low, high = np.maximum(low, at[known].min(axis=0) - GAP), np.minimum(high, at[known].max(axis=0) + GAP)
        if (high < low).any():
            return hidden
        inside = usable & ((front_at >= low) & (front_at <= high)).all(axis=1)
        width, height = high - low + 1
        nearest = np.full(height * width, np.inf, np.float32)
        place = (front_at[inside] - low) @ np.array([1, width])
        np.minimum.at(nearest, place, np.linalg.norm(front_m[inside], axis=1).astype(np.float32))
        surface = _closed(nearest.reshape(height, width))
        candidates = np.flatnonzero(known & ((at >= low) & (at <= high)).all(axis=1))
        column, row = (at[candidates] - low).T
        distance = np.linalg.norm(behind_m[candidates], axis=1)
        hidden[candidates] = distance * (1 - BEHIND_SHARE) > surface[row, column]
        return hidden


def kept_by_coarser(
    cells: Float64[np.ndarray, "n 2"], factors: tuple[float, float], phases: tuple[float, float]
) -> Bool[np.ndarray, "n"]:
    """Which points a sensor would still measure whose cells are larger: whole columns and rows of cells are left out.

    Args:
        cells: column and row of each point, as measured.
        factors: how many times larger the cells are, horizontally and vertically; below 1 all points are kept.
        phases: 0..1, position of the first kept column and row.
    """
    keep = np.ones(len(cells), np.bool_)
    for numbers, factor, phase in zip(np.rint(cells).T, factors, phases, strict=True):
        if factor > 1:
            keep &= np.floor(numbers / factor + phase) != np.floor((numbers - 1) / factor + phase)
    return keep


def _angles(xyz_m: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    x, y, z = np.asarray(xyz_m, np.float64).T
    return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=1)


def _angular_steps(xyz_m: Float[np.ndarray, "n 3"]) -> tuple[float, float]:
    """The angles between neighbouring measurements of a scan line, and between scan lines (at least as large)."""
    if len(xyz_m) <= NEIGHBOURS:
        return (1e-3, 1e-3)
    angles = _angles(xyz_m)
    chosen = thin(len(angles), SAMPLED)
    distances = cKDTree(angles).query(angles if chosen is None else angles[chosen], k=NEIGHBOURS + 1)[0]
    along = max(float(np.median(distances[:, 1])), 1e-5)
    per_point = np.pi * float(np.median(distances[:, NEIGHBOURS])) ** 2 / NEIGHBOURS
    return along, max(per_point / along, along)


def _rounded(cells: Float64[np.ndarray, "n 2"]) -> tuple[Int64[np.ndarray, "n 2"], Bool[np.ndarray, "n"]]:
    known = np.isfinite(cells).all(axis=1) & (np.abs(cells) < 1e6).all(axis=1)
    return np.rint(np.where(known[:, None], cells, 0.0)).astype(np.int64), known


def _closed(nearest_m: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Distances with small gaps between cells filled by the farthest neighbour; infinite outside the surface."""
    kernel = np.ones((GAP + 1, GAP + 1), np.uint8)
    measured = np.isfinite(nearest_m)
    padded = np.pad(measured.astype(np.uint8), GAP)
    filled = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[GAP:-GAP, GAP:-GAP].astype(bool) & ~measured
    farthest = cv2.dilate(np.where(measured, nearest_m, 0).astype(np.float32), kernel)
    return np.where(filled & (farthest > 0), farthest, nearest_m)
