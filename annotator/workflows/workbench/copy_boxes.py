"""Proposes the reviewed boxes of one frame in another one: right for objects at rest, a start for moving ones."""

from __future__ import annotations

from annotator.project import REVIEWED, Origin, Project, Receipt, WriteContext
from annotator.project.overview import neighbours, read_page
from annotator.types.errors import ConfigError
from annotator.workflows.tracks.propose_boxes import NewProposal, proposal_events, why_left_out


def copy_boxes(project: Project, frame_id: int, source_id: int | None, context: WriteContext) -> Receipt:
    """Proposes the reviewed boxes of a frame, as they are, with their track ids and values, as one action.

    A box is left out if the frame has a reviewed box of the same track, or one of its class at its place. Unreviewed
    proposals of the same objects are replaced.

    Args:
        source_id: the frame to copy from; None = the previous one of the recording.

    Raises:
        StaleRevisionError: the frame was changed in the meantime.
        NotFoundError: no such frame.
        ConfigError: the frame is finalised, there is no previous frame, it is the same frame, or it has no box to copy.
    """
    page = read_page(project, frame_id)
    frame = page.frame
    if frame.finalised:
        raise ConfigError(f"frame {frame.key} is finalised; reopen it first")
    if source_id is None:
        source_id = neighbours(project, frame)[0]
        if source_id is None:
            raise ConfigError(f"frame {frame.key} is the first of its recording; there is no previous frame to copy")
    if source_id == frame_id:
        raise ConfigError(f"frame {frame.key} cannot be copied into itself")
    source = project.frames.get(source_id)
    boxes = [label for label in project.labels.of_frame(source_id) if label.state in REVIEWED]
    copies = [
        NewProposal(
            label.label,
            label.box,
            label.track_id,
            box_kind=label.box_kind,
            attributes=label.attributes,
            origin=Origin.COPIED,
        )
        for label in boxes
    ]
    # the operator asks for them, also where a wrong box was rejected
    payloads = proposal_events(project, frame, copies, where_rejected=True)
    if not payloads:
        whys = dict.fromkeys(why_left_out(copy, page.labels) for copy in copies)
        raise ConfigError(
            f"nothing was copied from frame {source.key}: {'; '.join(whys) or 'it has no reviewed boxes'}"
        )
    return project.log.append(frame_id, payloads, context)
