"""Copies reviewed boxes from one frame to another: exact for objects at rest, a start for moving ones."""

from __future__ import annotations

from annotator.geometry.iou import iou_3d_matrix
from annotator.project import REVIEWED, NewLabel, Origin, Project, Receipt, WriteContext
from annotator.project.overview import neighbours
from annotator.types import Label
from annotator.types.errors import ConfigError

# 3D IoU from which two boxes of the same class are taken for the same object.
SAME_OBJECT_IOU = 0.3


def copy_boxes(project: Project, frame_id: int, source_id: int | None, context: WriteContext) -> Receipt:
    """Copies the reviewed boxes of a frame, with their track ids, as one action.

    A box is left out if the frame already has a reviewed box of the same track, or one of the same class that overlaps
    it. Proposed and rejected boxes of the frame are ignored.

    Args:
        source_id: the frame to copy from; None = the previous one of the recording.

    Raises:
        StaleRevisionError: the frame was changed in the meantime.
        NotFoundError: no such frame.
        ConfigError: there is no previous frame, it is the same frame, or it has no box to copy.
    """
    frame = project.frames.get(frame_id)
    if source_id is None:
        source_id = neighbours(project, frame)[0]
        if source_id is None:
            raise ConfigError(f"frame {frame.key} is the first of its recording; there is no previous frame to copy")
    if source_id == frame_id:
        raise ConfigError(f"frame {frame.key} cannot be copied into itself")
    source = project.frames.get(source_id)
    boxes = [label for label in project.labels.of_frame(source_id) if label.state in REVIEWED]
    present = [label for label in project.labels.of_frame(frame_id) if label.state in REVIEWED]
    new = [label for label in boxes if not _is_present(label, present)]
    if not new:
        why = "has no reviewed boxes" if not boxes else "has only boxes that this frame has already"
        raise ConfigError(f"frame {source.key} {why}; nothing was copied")
    copies = [
        NewLabel(
            label.label,
            label.box,
            track_id=label.track_id,
            origin=Origin.COPIED,
            box_kind=label.box_kind,
            attributes=label.attributes,
        )
        for label in new
    ]
    return project.labels.create(frame_id, copies, context).receipt


def _is_present(label: Label, present: list[Label]) -> bool:
    if label.track_id is not None and any(other.track_id == label.track_id for other in present):
        return True
    same_class = [other.box for other in present if other.label == label.label]
    return bool(same_class) and float(iou_3d_matrix([label.box], same_class).max()) >= SAME_OBJECT_IOU
