"""How much of a box is hidden: the share of its lines of sight that end at something nearer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from annotator.geometry.oriented_box import box_corners
from annotator.types import OrientedBox

# Corners nearer than this have no place on the image plane, metres: such boxes are tried against every ray.
NEAREST_M = 0.05


@dataclass(frozen=True)
class Hidden:
    """What the measured lines of sight say about a box.

    Attributes:
        rays: how many lead to the box (through measured points; those end before it, in it or behind it).
        nearer: how many of them end before it.
    """

    rays: int
    nearer: int

    @property
    def share(self) -> float:
        """The hidden share, 0..1; NaN without any ray."""
        return self.nearer / self.rays if self.rays else float("nan")


class Sight:
    """The lines of sight from a camera to the points that it sees, computed once for all boxes of a frame."""

    def __init__(self, xyz_m: Float[np.ndarray, "n 3"]) -> None:
        """Takes the points in the camera frame, metres; those behind the camera are passed over."""
        self._xyz_m = xyz_m[xyz_m[:, 2] > NEAREST_M].astype(np.float32)
        self._plane = self._xyz_m[:, :2] / self._xyz_m[:, 2:]

    def hidden(self, box: OrientedBox, margin_m: float = 0.0) -> Hidden:
        """How many rays lead to a box, and how many end before it (the slab test of Kay and Kajiya, 1986).

        Args:
            box: camera frame.
            margin_m: points nearer to the box's front than this, along their ray, count as its own, metres.
        """
        xyz = self._xyz_m[self._near(box)]
        R = box.rotation.astype(np.float32)
        # in the box's frame: the camera, and each ray, whose point is at 1
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
        """The rays within the bounds of the box on the image plane; all, where it reaches behind the camera."""
        corners = box_corners(box)
        if (corners[:, 2] <= NEAREST_M).any():
            return np.ones(len(self._xyz_m), np.bool_)
        seen = corners[:, :2] / corners[:, 2:]
        return np.asarray(((self._plane >= seen.min(axis=0)) & (self._plane <= seen.max(axis=0))).all(axis=1))
