"""The true boxes of our frames as KITTI's evaluation wants them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

from annotator.formats.kitti import DONT_CARE, KittiLabel, read_tracking_areas
from annotator.formats.kitti_results import read_kitti_file
from annotator.formats.kitti_row import kitti_row
from annotator.geometry.occlusion import Sight
from annotator.recordings import Recording
from annotator.types import Frame, OrientedBox
from annotator.workflows.truth import file_version, frame_number, label_file, load_truth

# The one format whose labels say how hard an object is to see as KITTI's evaluation asks for it.
OWN_ROWS = "kitti_object"
# Its labels, too, say where nobody labelled.
TRACKING = "kitti_tracking"


def true_kitti_rows(recording: Recording, index: int, frame: Frame) -> Sequence[KittiLabel]:
    """The true rows of a frame: KITTI's own where there are some, with DontCare areas; else made from the boxes.

    Raises:
        RecordingError, FormatError: as `load_truth`.
    """
    file = label_file(recording, frame.key)
    if recording.format == OWN_ROWS and file is not None:
        return read_kitti_file(file, scored=False)
    made = rows_of_truth(((truth.label, truth.box) for truth in load_truth(recording, index, frame)), frame)
    return [*made, *dont_care_rows(recording, frame.key)]


def dont_care_rows(recording: Recording, key: str) -> list[KittiLabel]:
    """The areas of a frame where nobody labelled, as far as its recording says so; none without a file of labels.

    Raises:
        FormatError: its label file is broken.
    """
    file = label_file(recording, key) if recording.format in (OWN_ROWS, TRACKING) else None
    # a folder of labels need not have one of every frame
    if file is None or not file.is_file():
        return []
    if recording.format == TRACKING:
        return list(_areas(file, *file_version(file)).get(frame_number(file, key), ()))
    return [row for row in read_kitti_file(file, scored=False) if row.label == DONT_CARE]


def rows_of_truth(boxes: Iterable[tuple[str, OrientedBox]], frame: Frame) -> list[KittiLabel]:
    """True boxes (class and box, camera frame) as rows; how much of each is hidden follows from the frame's cloud."""
    sight = Sight(frame.cloud.xyz_m)
    return [kitti_row(label, box, None, frame, sight) for label, box in boxes]


@lru_cache(maxsize=4)
def _areas(path: Path, changed_ns: int, size: int) -> dict[int, list[KittiLabel]]:
    """The areas of a whole recording, kept: its file would be parsed again for every frame otherwise."""
    return read_tracking_areas(path)
