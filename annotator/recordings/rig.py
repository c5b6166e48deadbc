"""What recordings of several cameras, and of LiDARs, can say beside their frames.

A *rig* is a set of recordings of one path that differ only in their option `camera`. They share a clock and clouds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.transforms import right_handed_axes
from annotator.recordings.recording import Recording
from annotator.types import Camera


@runtime_checkable
class RigCamera(Recording, Protocol):
    """A recording of one camera of a rig."""

    @property
    def camera(self) -> str:
        """The camera's name."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """The names of all cameras of the rig."""

    def intrinsics(self, i: int) -> Camera:
        """Returns the camera of frame `i`, without reading its image.

        Raises:
            FrameError: it cannot be read.
            IndexError: there is no such frame.
        """

    def moment(self, i: int) -> str:
        """Returns the name of the cloud of frame `i`: frames of the rig's cameras with the same one belong together.

        Raises:
            IndexError: there is no such frame.
        """

    def T_rig_camera(self, i: int) -> RigidTransform:
        """Returns the pose of frame `i`'s camera in a frame that is the same for all frames of a moment.

        Raises:
            FrameError: the pose cannot be read.
            IndexError: there is no such frame.
        """


@runtime_checkable
class Scenes(Recording, Protocol):
    """A recording of one scene of a dataset."""

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of all scenes of the dataset."""

    @property
    def scene(self) -> str:
        """The scene's name."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A whole scan of a LiDAR, also where no camera looks.

    Attributes:
        xyz_m: the valid points in the scan's own frame.
        rgb: colours, or None.
        reflectance: 0..1, or None.
        R_level_scan: turns the scan's frame to x ahead, y left, z against gravity.
        place_m: the place in the scan's frame from which virtual cameras look.
        T_scan_label: from the frame of the recording's label files, as `Frame.T_camera_label`.
        knows_up: False if gravity is unknown, so that the scan's own axes are used.
        timestamp_ns: None if unknown.
        T_world_scan: pose of the scan's frame, as `Frame.T_world_camera`.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None
    reflectance: Float32[np.ndarray, "n"] | None
    R_level_scan: Rotation
    place_m: Float64[np.ndarray, "3"]
    T_scan_label: RigidTransform
    knows_up: bool = True
    timestamp_ns: int | None = None
    T_world_scan: RigidTransform | None = None


@runtime_checkable
class Scanned(Recording, Protocol):
    """A recording of a LiDAR."""

    def scan(self, i: int) -> Scan:
        """Reads the scan of frame `i`.

        Raises:
            FrameError: it cannot be read.
            IndexError: there is no such frame.
        """


def level_turn(up: Float64[np.ndarray, "3"], ahead: Float64[np.ndarray, "3"]) -> Rotation:
    """Returns the turn to x ahead (made horizontal), y left, z up.

    Args:
        up: unit vector against gravity.
        ahead: another direction.
    """
    z, x, y = right_handed_axes(up, ahead).T
    return Rotation.from_matrix(np.stack([x, y, z]))
