"""The true boxes of a project's frames as rows for KITTI's evaluation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

from annotator.formats.kitti_objects import read_kitti_file
from annotator.formats.kitti_rows import DONT_CARE, KittiLabel, kitti_row, read_tracking_areas
from annotator.geometry.occlusion import Sight
from annotator.recordings import Recording
from annotator.types import Frame, OrientedBox
from annotator.workflows.recorded.reading import file_version, frame_number, label_file, load_truth

# The only format whose labels have the difficulty fields of KITTI's evaluation.
OBJECT = "kitti_object"
# The labels of this format have DontCare areas, too.
TRACKING = "kitti_tracking"


def true_kitti_rows(recording: Recording, index: int, frame: Frame) -> Sequence[KittiLabel]:
    """Returns the true rows of a frame with DontCare areas: KITTI's own rows if there are any, else made from boxes.

    Raises:
        RecordingError, FormatError: as `load_truth`.
    """
    file = label_file(recording, frame.key)
    if recording.format == OBJECT and file is not None:
        return read_kitti_file(file, scored=False)
    rows = rows_of_truth(((truth.label, truth.box) for truth in load_truth(recording, index, frame)), frame)
    return [*rows, *dont_care_rows(recording, frame.key)]


def dont_care_rows(recording: Recording, key: str) -> list[KittiLabel]:
    """Returns the DontCare (unlabelled) areas of a frame; none if it has no label file.

    Raises:
        FormatError: its label file is broken.
    """
    file = label_file(recording, key) if recording.format in (OBJECT, TRACKING) else None
    # a label folder may lack files of some frames
    if file is None or not file.is_file():
        return []
    if recording.format == TRACKING:
        return list(_areas(file, *file_version(file)).get(frame_number(file, key), ()))
    return [row for row in read_kitti_file(file, scored=False) if row.label == DONT_CARE]


def rows_of_truth(boxes: Iterable[tuple[str, OrientedBox]], frame: Frame) -> list[KittiLabel]:
    """Returns true boxes (class and box, camera frame) as rows; occlusion is computed from the frame's cloud."""
    sight = Sight(frame.cloud.xyz_m)
    return [kitti_row(label, box, None, frame, sight) for label, box in boxes]


@lru_cache(maxsize=4)
def _areas(path: Path, changed_ns: int, size: int) -> dict[int, list[KittiLabel]]:
    """Reads the areas of a whole recording; cached, so that the file is not parsed again for every frame."""
    return read_tracking_areas(path)
