"""The true boxes of our frames as KITTI's evaluation wants them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from annotator.formats.kitti import DONT_CARE, KittiLabel
from annotator.formats.kitti_results import read_kitti_file
from annotator.formats.kitti_row import kitti_row
from annotator.geometry.occlusion import Sight
from annotator.recordings import Recording
from annotator.types import Frame, OrientedBox
from annotator.workflows.truth import label_file, load_truth

# The one format whose labels say how hard an object is to see, and where nobody labelled.
OWN_ROWS = "kitti_object"


def true_kitti_rows(recording: Recording, index: int, frame: Frame) -> Sequence[KittiLabel]:
    """The true rows of a frame: KITTI's own where there are some, with DontCare areas; else made from the boxes.

    Raises:
        RecordingError, FormatError: as `load_truth`.
    """
    file = label_file(recording, frame.key)
    if recording.format == OWN_ROWS and file is not None:
        return read_kitti_file(file, scored=False)
    return rows_of_truth(((truth.label, truth.box) for truth in load_truth(recording, index, frame)), frame)


def dont_care_rows(recording: Recording, key: str) -> list[KittiLabel]:
    """The areas of a frame where nobody labelled, as far as its recording says so.

    Raises:
        FormatError: its label file is broken.
    """
    file = label_file(recording, key) if recording.format == OWN_ROWS else None
    return [] if file is None else [row for row in read_kitti_file(file, scored=False) if row.label == DONT_CARE]


def rows_of_truth(boxes: Iterable[tuple[str, OrientedBox]], frame: Frame) -> list[KittiLabel]:
    """True boxes (class and box, camera frame) as rows; how much of each is hidden follows from the frame's cloud."""
    sight = Sight(frame.cloud.xyz_m)
    return [kitti_row(label, box, None, frame, sight) for label, box in boxes]
