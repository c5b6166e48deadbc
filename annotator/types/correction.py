"""A correction of a recording's calibration: where its clouds lie relative to its images, in space and time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

MOST_TURN_RAD, MOST_SHIFT_M, MOST_OFFSET_S = np.pi, 1e4, 3600.0


@dataclass(frozen=True)
class Correction:
    """Moves a recording's clouds relative to its images.

    Attributes:
        turn_rad: rotation vector, about the camera's x, y, z axes; applied first.
        shift_m: translation, along the camera's axes.
        time_offset_s: the clouds' clock minus the images': a frame's cloud is shown with the image that is nearest in
            time to the cloud's time minus this.
    """

    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        for name, values, most in (
            ("turn_rad", self.turn_rad, MOST_TURN_RAD),
            ("shift_m", self.shift_m, MOST_SHIFT_M),
            ("time_offset_s", (self.time_offset_s,), MOST_OFFSET_S),
        ):
            if not all(abs(value) <= most for value in values):
                raise ValueError(f"{name} must be finite and at most {most:g}")

    @property
    def moves(self) -> bool:
        """True if the clouds are turned or shifted."""
        return any(self.turn_rad) or any(self.shift_m)

    @property
    def T_camera_recorded(self) -> RigidTransform:
        """From the camera frame as the recording's files give it to the corrected one."""
        return RigidTransform.from_components(np.array(self.shift_m), Rotation.from_rotvec(np.array(self.turn_rad)))


NO_CORRECTION = Correction()
