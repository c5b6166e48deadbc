"""What operators do to a frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from annotator.project import Change, Project, Receipt
from annotator.project.overview import read_page
from annotator.project.payloads import ImageBoxesSet, LabelChange, Payload
from annotator.workflows.labelling import label_config
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.remeasure import remeasured
from annotator.workflows.view_followers import changes_kind, image_follower, view_followers


def apply_changes(
    project: Project,
    frame_id: int,
    payloads: Sequence[Payload],
    change: Change,
    open_frame: Callable[[], OpenFrame],
) -> Receipt:
    """Makes changes to one frame and what follows from them, as one action: all or none.

    Args:
        open_frame: gives the frame itself; called where finished objects are measured anew.

    Raises:
        StaleRevisionError: somebody has changed the frame since.
        NotFoundError: no such frame.
        FrameError: objects are to be measured anew, and the frame cannot be read.
        ProjectError: a label or class that the frame or project does not have.
    """
    return project.log.append(frame_id, [*payloads, *_following(project, frame_id, payloads, open_frame)], change)


def _following(
    project: Project, frame_id: int, payloads: Sequence[Payload], open_frame: Callable[[], OpenFrame]
) -> list[Payload]:
    if not any(isinstance(entry, ImageBoxesSet | LabelChange) for entry in payloads):
        return []
    # of a page that is read too late or too early, the revision is refused
    page = read_page(project, frame_id)
    on_image = next((entry for entry in reversed(payloads) if isinstance(entry, ImageBoxesSet)), None)
    found: list[Payload] = []
    if on_image is None:
        on_image = image_follower(page, payloads)
        if on_image is None:
            return found
        found.append(on_image)
    found += view_followers(page, on_image)
    if changes_kind(page, on_image):
        opened = open_frame()
        found += remeasured(page, opened, label_config(project, opened.frame), on_image)
    return found
