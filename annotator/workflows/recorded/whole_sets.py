"""Looks at all labels beside a recording together, before any of them is used.

Frames are read one by one, but only all boxes together show that their numbers are in another unit than their format
has (`annotator.formats.units`).
"""

from __future__ import annotations

from annotator.recordings import Recording
from annotator.types.errors import AnnotatorError, UnitError
from annotator.workflows.importing.table import BoxFormat, read_labels
from annotator.workflows.recorded.reading import label_file, one_file_a_frame

# The readers of other formats read all frames at once.
FORMATS = {
    "kitti_object": BoxFormat.KITTI,
    "kitti_tracking": BoxFormat.KITTI,
    "rgbd_folder": BoxFormat.BOXES,
    "cloud_folder": BoxFormat.LABELCLOUD,
    "argoverse2": BoxFormat.ARGOVERSE2,
}


def require_units(recording: Recording) -> int:
    """Looks at the labels of all frames; returns how many 2D boxes without a 3D box are among them.

    Other faults are found when the frames are read, and may affect only one of them.

    Raises:
        UnitError: their numbers are in another unit than their format has.
    """
    file = label_file(recording, recording.keys[0])
    if file is None or recording.format not in FORMATS:
        return 0
    try:
        labels = read_labels(FORMATS[recording.format], file.parent if one_file_a_frame(recording) else file)
        return sum(labels.left_out_of(name).flat for name in labels.frames)
    except UnitError:
        raise
    except AnnotatorError:
        return 0
