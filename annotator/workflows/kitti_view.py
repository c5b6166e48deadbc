"""Boxes of our frames as KITTI would write them, for its evaluation."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.formats.kitti import KittiLabel
from annotator.formats.kitti_derived import derived_box, heading, observation_angle
from annotator.formats.kitti_results import read_kitti_file
from annotator.recordings import Recording
from annotator.types import Frame, OrientedBox
from annotator.workflows.truth import label_file, load_truth

# The one format whose labels say how hard an object is to see, and where nobody labelled.
OWN_ROWS = "kitti_object"
NOT_IN_THE_PICTURE = (0.0, 0.0, 0.0, 0.0)


def kitti_row(label: str, box: OrientedBox, score: float, frame: Frame) -> KittiLabel:
    """A box (camera frame) as a row: upright, with the 2D box of its projection; nothing hides it, as far as it says.

    KITTI has no pitch and no roll: the heading is that of the length on the ground. A box that is not in the picture
    has a 2D box without extent, which KITTI's evaluation passes over.
    """
    T = frame.T_camera_label
    box = box if T is None else box.transformed(T.inv())
    derived = derived_box(frame.camera, box, T)
    x, y, z = box.center_m.tolist()
    length, width, height = box.size_m.tolist()
    rotation_y = heading(box)
    edges, truncated = (NOT_IN_THE_PICTURE, 1.0) if derived is None else (derived.clipped, derived.truncated)
    alpha, bottom = observation_angle(rotation_y, x, z), y + height / 2
    return KittiLabel(label, truncated, 0, alpha, *edges, height, width, length, x, bottom, z, rotation_y, score)


def true_kitti_rows(recording: Recording, index: int, frame: Frame) -> Sequence[KittiLabel]:
    """The true rows of a frame: KITTI's own where there are some, with DontCare areas; else made from the boxes.

    Raises:
        RecordingError, FormatError: as `load_truth`.
    """
    file = label_file(recording, frame.key)
    if recording.format == OWN_ROWS and file is not None:
        return read_kitti_file(file, scored=False)
    return [kitti_row(truth.label, truth.box, 1.0, frame) for truth in load_truth(recording, index, frame)]
