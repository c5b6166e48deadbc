"""2D and 3D boxes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.types.checks import as_array

# Upper limit of sizes and distances; beyond it, volumes overflow.
FARTHEST_M = 1e9
# A matrix this close to a rotation is not normalised.
ORTHONORMAL = 1e-12


def _distance_from_rotation(columns: list[list[float]]) -> float:
    """The largest deviation of a matrix from orthonormality; infinite for a reflection or NaN.

    Compares the columns' squared lengths with 1 and their scalar products with 0. Computed with plain numbers, because
    numpy takes ten times as long for matrices this small.
    """
    (a, b, c), (d, e, f), (g, h, i) = columns
    if not all(abs(value) < 2 for value in (a, b, c, d, e, f, g, h, i)):
        return math.inf
    if a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0:
        return math.inf
    lengths = (a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i)
    cosines = (a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i)
    return max(*(abs(length - 1) for length in lengths), *map(abs, cosines))


@dataclass(frozen=True)
class Box2D:
    """An axis-aligned box on an image, in continuous pixels (centre of the first pixel = (0, 0)).

    Attributes:
        x_min, y_min, x_max, y_max: edges, pixels, x right, y down.
        score: detector confidence in 0..1; 1 for a drawn box.
        edge_sigma_px: expected error of x_min, y_min, x_max, y_max, pixels; None if unknown.
    """

    label: str
    x_min: float
    y_min: float
    x_max: float
    y_max: float
    score: float = 1.0
    edge_sigma_px: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        # plain numbers, because numpy takes ten times as long for so few values
        if not all(map(math.isfinite, self.xyxy)):
            raise ValueError(f"box edges must be finite, not {self.xyxy}")
        if self.x_max <= self.x_min or self.y_max <= self.y_min:
            raise ValueError(f"a box must have a positive width and height, not {self.xyxy}")

    @property
    def width_px(self) -> float:
        return self.x_max - self.x_min

    @property
    def height_px(self) -> float:
        return self.y_max - self.y_min

    @property
    def xyxy(self) -> tuple[float, float, float, float]:
        return (self.x_min, self.y_min, self.x_max, self.y_max)

    def shifted(self, x_px: int, y_px: int) -> Box2D:
        """The box moved right and down by whole pixels, such as from a region's pixels to those of the whole image."""
        edges = (self.x_min + x_px, self.y_min + y_px, self.x_max + x_px, self.y_max + y_px)
        return Box2D(self.label, *edges, self.score, self.edge_sigma_px)


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A fully oriented 3D box.

    Attributes:
        pose: matrix of `T_camera_box`, the pose of the box frame (origin at the centre; x length, y width, z height) in
            the camera frame, metres; read-only.
        size_m: full (length, width, height) along the box's own x, y, z; all positive; read-only.

    Raises:
        ValueError: a wrong shape, a size that is not positive, or a value that is not finite or beyond `FARTHEST_M`.
    """

    pose: Float64[np.ndarray, "4 4"]
    size_m: Float64[np.ndarray, "3"]

    def __post_init__(self) -> None:
        size = as_array("size_m", self.size_m, np.float64, (3,))
        pose = as_array("pose", self.pose, np.float64, (4, 4))
        # plain numbers, because numpy takes several times as long for so few values
        lengths: list[float] = size.tolist()
        values: list[float] = pose.ravel().tolist()
        if not all(map(math.isfinite, lengths)):
            raise ValueError("size_m must be finite")
        if min(lengths) <= 0:
            raise ValueError(f"box sizes must be positive, not {lengths}")
        if not all(map(math.isfinite, values)):
            raise ValueError("T_camera_box must be finite")
        if max(*lengths, *(abs(value) for value in values[3:12:4])) > FARTHEST_M:
            raise ValueError(f"a box must be within {FARTHEST_M:g} m; give metres")
        object.__setattr__(self, "size_m", size)
        object.__setattr__(self, "pose", pose)

    @classmethod
    def at(cls, T_camera_box: RigidTransform, size_m: np.ndarray) -> OrientedBox:
        """A box from its pose and size (3,).

        Raises:
            ValueError: as the constructor, or a stack of poses.
        """
        return cls(T_camera_box.as_matrix(), size_m)

    @classmethod
    def from_parts(cls, center_m: np.ndarray, rotation: np.ndarray, size_m: np.ndarray) -> OrientedBox:
        """A box from its centre (3,), rotation matrix (3, 3; columns = box axes in the camera frame) and size (3,).

        Raises:
            ValueError: a wrong shape, or a matrix that is not a rotation within 1e-3.
        """
        center = as_array("center_m", center_m, np.float64, (3,))
        matrix = as_array("rotation", rotation, np.float64, (3, 3))
        error = _distance_from_rotation(matrix.T.tolist())
        if not error <= 1e-3:
            # other matrices may overflow
            is_mirrored = bool((np.abs(matrix) < 2).all()) and np.linalg.det(matrix) < 0
            mirrored = "; its axes are left-handed (they mirror)" if is_mirrored else ""
            raise ValueError(f"rotation must be a proper rotation matrix (orthonormal, determinant +1){mirrored}")
        pose = np.zeros((4, 4))
        pose[:3, :3], pose[:3, 3], pose[3, 3] = matrix, center, 1.0
        # normalising takes longer than all else, so a matrix that is exact up to rounding skips it
        if error > ORTHONORMAL:
            pose = RigidTransform(pose).as_matrix()
        return cls(pose, np.asarray(size_m, np.float64))

    @cached_property
    def T_camera_box(self) -> RigidTransform:
        """The pose, made when it is asked for, since scipy takes as long for it as for the rest of the box."""
        # normalising the rotation again would change its last bits
        return RigidTransform(self.pose, normalize=False)

    @property
    def center_m(self) -> Float64[np.ndarray, "3"]:
        """Centre in the camera frame, metres."""
        return self.pose[:3, 3].copy()

    @property
    def rotation(self) -> Float64[np.ndarray, "3 3"]:
        """Columns are the box axes in the camera frame."""
        return self.pose.copy()[:3, :3]

    @property
    def volume_m3(self) -> float:
        return float(np.prod(self.size_m))

    def transformed(self, T_dst_camera: RigidTransform) -> OrientedBox:
        """The same box in another frame."""
        return OrientedBox.at(T_dst_camera * self.T_camera_box, self.size_m)
