"""Occlusion of a box: the share of the lines of sight towards the box that end in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from annotator.geometry.oriented_box import box_corners
from annotator.types import OrientedBox

# Boxes with a corner closer to the image plane than this, metres, are tested against all rays.
NEAREST_M = 0.05


@dataclass(frozen=True)
class Hidden:
    """The measured lines of sight towards a box.

    Attributes:
        rays: number of measured points whose ray meets the box; they lie in front of it, inside it or behind it.
        nearer: number of these points that lie in front of the box.
    """

    rays: int
    nearer: int

    @property
    def share(self) -> float:
        """The hidden share, 0..1; NaN without rays."""
        return self.nearer / self.rays if self.rays else float("nan")


class Sight:
    """The lines of sight from a camera to its measured points, computed once for all boxes of a frame."""

    def __init__(self, xyz_m: Float[np.ndarray, "n 3"]) -> None:
        """
        Args:
            xyz_m: points in the camera frame, metres; those behind the camera are ignored.
        """
        self._xyz_m = xyz_m[xyz_m[:, 2] > NEAREST_M].astype(np.float32)
        self._plane = self._xyz_m[:, :2] / self._xyz_m[:, 2:]

    def hidden(self, box: OrientedBox, margin_m: float = 0.0) -> Hidden:
        """Counts the rays towards a box, and those that end in front of it (slab test of Kay and Kajiya, 1986).

        Args:
            box: camera frame.
            margin_m: points within this distance of the box's front, along their ray, count as part of it, metres.
        """
        xyz = self._xyz_m[self._near(box)]
        R = box.rotation.astype(np.float32)
        # camera and rays in the box's axes; along each ray, the measured point has the parameter 1
        eye = (-box.center_m.astype(np.float32)) @ R
        along = xyz @ R
        half = (0.5 * box.size_m).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (-half - eye) / along, (half - eye) / along
        enters, leaves = np.fmin(a, b).max(axis=1), np.fmax(a, b).min(axis=1)
        meets = (enters <= leaves) & (leaves > 0)
        length_m = np.linalg.norm(xyz, axis=1)
        before = meets & ((enters - 1.0) * length_m > margin_m)
        return Hidden(int(meets.sum()), int(before.sum()))

    def _near(self, box: OrientedBox) -> np.ndarray:
        """The rays within the box's bounds on the image plane; all rays if it extends behind the camera."""
        corners = box_corners(box)
        if (corners[:, 2] <= NEAREST_M).any():
            return np.ones(len(self._xyz_m), np.bool_)
        projected = corners[:, :2] / corners[:, 2:]
        return np.asarray(((self._plane >= projected.min(axis=0)) & (self._plane <= projected.max(axis=0))).all(axis=1))
