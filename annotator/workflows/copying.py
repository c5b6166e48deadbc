"""Boxes of one frame put into another: of people who sit, cars that stand, and a start for those that move."""

from __future__ import annotations

from annotator.geometry.iou import iou_3d_matrix
from annotator.project import REVIEWED, Change, NewLabel, Origin, Project, Receipt
from annotator.project.overview import neighbours
from annotator.types import Label
from annotator.types.errors import ConfigError

# A box that overlaps a box of the same class in the other frame by so much is there already (exact 3D IoU).
THERE_ALREADY_IOU = 0.3


def copy_boxes(project: Project, frame_id: int, source_id: int | None, change: Change) -> Receipt:
    """Copies the reviewed boxes of a frame, with their track ids, as one action.

    Boxes that the frame has already (a reviewed one, or one of the same track) are left out; a rejected or proposed
    one is in nobody's way.

    Args:
        source_id: the frame to copy from; None = the one before in the recording.

    Raises:
        StaleRevisionError: somebody has changed the frame since.
        NotFoundError: no such frame.
        ConfigError: there is no frame before, it is the same frame, or it has nothing to copy.
    """
    frame = project.frames.get(frame_id)
    if source_id is None:
        source_id = neighbours(project, frame)[0]
        if source_id is None:
            raise ConfigError(f"frame {frame.key} is the first of its recording; there is none before to copy from")
    if source_id == frame_id:
        raise ConfigError(f"frame {frame.key} cannot be copied into itself")
    source = project.frames.get(source_id)
    boxes = [label for label in project.labels.of_frame(source_id) if label.state in REVIEWED]
    here = [label for label in project.labels.of_frame(frame_id) if label.state in REVIEWED]
    new = [label for label in boxes if not _is_there(label, here)]
    if not new:
        why = "has no reviewed boxes" if not boxes else "has no boxes that this frame does not have already"
        raise ConfigError(f"frame {source.key} {why}; nothing was copied")
    copies = [NewLabel(label.label, label.box, track_id=label.track_id, origin=Origin.COPIED) for label in new]
    return project.labels.create(frame_id, copies, change).receipt


def _is_there(label: Label, here: list[Label]) -> bool:
    if label.track_id is not None and any(other.track_id == label.track_id for other in here):
        return True
    same = [other.box for other in here if other.label == label.label]
    return bool(same) and float(iou_3d_matrix([label.box], same).max()) >= THERE_ALREADY_IOU
