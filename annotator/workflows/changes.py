"""What operators do to a frame."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.project import Change, Project, Receipt
from annotator.project.payloads import Payload


def apply_changes(project: Project, frame_id: int, payloads: Sequence[Payload], change: Change) -> Receipt:
    """Makes changes to one frame, all or none.

    Raises:
        StaleRevisionError: somebody has changed the frame since.
        NotFoundError: no such frame.
        ProjectError: a label or class that the frame or project does not have.
    """
    return project.log.append(frame_id, payloads, change)
