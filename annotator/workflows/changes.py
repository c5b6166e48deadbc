"""What operators do to a frame."""

from __future__ import annotations

from collections.abc import Sequence

from annotator.project import Change, Project, Receipt
from annotator.project.overview import read_page
from annotator.project.payloads import ImageBoxesSet, Payload
from annotator.workflows.view_followers import view_followers


def apply_changes(project: Project, frame_id: int, payloads: Sequence[Payload], change: Change) -> Receipt:
    """Makes changes to one frame and what follows from them, as one action: all or none.

    Raises:
        StaleRevisionError: somebody has changed the frame since.
        NotFoundError: no such frame.
        ProjectError: a label or class that the frame or project does not have.
    """
    on_image = next((entry for entry in reversed(payloads) if isinstance(entry, ImageBoxesSet)), None)
    # of a page that is read too late or too early, the revision is refused
    following = [] if on_image is None else view_followers(read_page(project, frame_id), on_image)
    return project.log.append(frame_id, [*payloads, *following], change)
