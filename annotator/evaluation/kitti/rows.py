"""The rows of KITTI's label or result files of all frames, as columns."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float64, Int64, Shaped


@dataclass(frozen=True, eq=False)
class KittiRows:
    """Columns as in the files (KITTI's units and coordinates: pixels, metres, radians, rectified camera 0).

    The rows of a frame are adjacent and in the order of their file, since the first of two equally good boxes counts.

    Attributes:
        frame: number of the frame, the same for detections and truth.
        label: KITTI's `type`, not case-sensitive.
        truncated, occluded: of true rows.
        alpha: observation angle; -10 if unknown.
        edges: 2D box: left, top, right, bottom.
        size: of the 3D box: height, width, length; not positive if unknown.
        bottom: centre of the bottom face: x, y, z.
        rotation_y: about the camera's y axis.
        score: of detections; any number, higher means more confident.
    """

    frame: Int64[np.ndarray, "n"]
    label: Shaped[np.ndarray, "n"]
    truncated: Float64[np.ndarray, "n"]
    occluded: Float64[np.ndarray, "n"]
    alpha: Float64[np.ndarray, "n"]
    edges: Float64[np.ndarray, "n 4"]
    size: Float64[np.ndarray, "n 3"]
    bottom: Float64[np.ndarray, "n 3"]
    rotation_y: Float64[np.ndarray, "n"]
    score: Float64[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rows: Shaped[np.ndarray, "k"]) -> KittiRows:
        """The rows selected by indices or a mask."""
        return KittiRows(*(getattr(self, column.name)[rows] for column in fields(self)))

    def by_frame(self) -> KittiRows:
        """The rows stably sorted by frame."""
        return self if (np.diff(self.frame) >= 0).all() else self.take(np.argsort(self.frame, kind="stable"))

    def is_of(self, *labels: str) -> Shaped[np.ndarray, "n"]:
        """A mask of the rows of these classes."""
        return np.isin(np.char.lower(self.label), [label.lower() for label in labels])

    @property
    def height_px(self) -> Float64[np.ndarray, "n"]:
        """Height of the 2D box."""
        return self.edges[:, 3] - self.edges[:, 1]

    @classmethod
    def from_table(
        cls, frame: Int64[np.ndarray, "n"], label: Shaped[np.ndarray, "n"], numbers: Float64[np.ndarray, "n 15"]
    ) -> KittiRows:
        """From the numeric columns in the order of the files: truncated to rotation_y, and the score."""
        truncated, occluded, alpha = numbers[:, :3].T
        edges, size, bottom = numbers[:, 3:7], numbers[:, 7:10], numbers[:, 10:13]
        return cls(frame, label, truncated, occluded, alpha, edges, size, bottom, numbers[:, 13], numbers[:, 14])
