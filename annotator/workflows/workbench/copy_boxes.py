"""Proposes the reviewed boxes of one frame in another one: right for objects at rest, a start for moving ones."""

from __future__ import annotations

from annotator.project import REVIEWED, Project, Receipt, WriteContext
from annotator.project.overview import neighbours
from annotator.types.errors import ConfigError
from annotator.workflows.tracks.propose_boxes import NewProposal, proposal_events


def copy_boxes(project: Project, frame_id: int, source_id: int | None, context: WriteContext) -> Receipt:
    """Proposes the reviewed boxes of a frame, as they are, with their track ids and values, as one action.

    A box is left out if the frame has a reviewed box of the same track, or one of its class at its place. Unreviewed
    proposals of the same objects are replaced.

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
    copies = [
        NewProposal(label.label, label.box, label.track_id, box_kind=label.box_kind, attributes=label.attributes)
        for label in boxes
    ]
    # the operator asks for them, also where a wrong box was rejected
    payloads = proposal_events(project, frame, copies, where_rejected=True)
    if not payloads:
        why = "has no reviewed boxes" if not boxes else "has only boxes that this frame has already"
        raise ConfigError(f"frame {source.key} {why}; nothing was copied")
    return project.log.append(frame_id, payloads, context)
