"""Where the colour camera stands beside rectified camera 0, as the calibrations beside KITTI's label files say it.

P2 = K [I | t]: a point of camera 0, moved by t, is the same point in the colour camera's frame (KITTI object devkit,
readme.txt). In KITTI itself t is some 6 cm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from annotator.formats.bounded import MOST
from annotator.formats.text_folder import text_rows
from annotator.types.errors import FormatError

LABELS, CALIBRATIONS = "label_2", "calib"
# Nobody mounts cameras farther apart on one vehicle, metres.
MOST_SHIFT_M = 100.0


def calibration_beside(label_file: Path) -> Path | None:
    """`calib/STEM.txt` beside the folder `label_2` of a label file, where it is there."""
    if label_file.parent.name != LABELS:
        return None
    file = label_file.parent.parent / CALIBRATIONS / label_file.name
    return file if file.is_file() else None


def read_shift(path: Path) -> Float64[np.ndarray, "3"]:
    """t of a calibration file, metres.

    Raises:
        FormatError: it cannot be read, or P2 is missing, damaged, or of no camera that belongs to camera 0.
    """
    for line, (head, *words) in text_rows(path):
        if head.rstrip(":") != "P2":
            continue
        try:
            P2 = np.array([float(word) for word in words]).reshape(3, 4)
            if not (np.abs(P2) <= MOST).all():
                raise ValueError
            shift = np.linalg.solve(P2[:, :3], P2[:, 3])
        except (ValueError, np.linalg.LinAlgError) as error:
            raise FormatError(path, "P2 needs twelve numbers, those of a camera", line) from error
        if not (np.abs(shift) <= MOST_SHIFT_M).all():
            raise FormatError(path, f"P2 moves the camera by more than {MOST_SHIFT_M:g} m", line)
        return shift
    raise FormatError(path, "has no P2")
