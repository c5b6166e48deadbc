"""Stores an operator's changes to a frame, together with the changes they imply."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from annotator.project import Project, Receipt, WriteContext
from annotator.project.event_types import ImageBoxesSet, LabelChange, Payload
from annotator.project.overview import FramePage, read_page
from annotator.workflows.views.write_pictures import changes_kind, image_follower, view_followers
from annotator.workflows.workbench.drawing_steps import label_config
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.remeasure import remeasured


def apply_changes(
    project: Project,
    frame_id: int,
    payloads: Sequence[Payload],
    context: WriteContext,
    open_frame: Callable[[], OpenFrame],
    known: FramePage | None = None,
) -> Receipt:
    """Stores changes to one frame and the changes they imply, as one action: all or none.

    Args:
        open_frame: returns the frame; called only if finished objects must be remeasured.
        known: an earlier page of the frame, which need not be read again if it is still the present one.

    Raises:
        StaleRevisionError: the frame was changed in the meantime.
        NotFoundError: no such frame.
        FrameError: objects must be remeasured, but the frame cannot be read.
        ProjectError: unknown label or class.
    """
    return project.log.append(frame_id, [*payloads, *_implied(project, frame_id, payloads, open_frame, known)], context)


def _implied(
    project: Project,
    frame_id: int,
    payloads: Sequence[Payload],
    open_frame: Callable[[], OpenFrame],
    known: FramePage | None,
) -> list[Payload]:
    if not any(isinstance(entry, ImageBoxesSet | LabelChange) for entry in payloads):
        return []
    # if another change comes between this read and the append, the append refuses the stale revision
    page = read_page(project, frame_id, known)
    on_image = next((entry for entry in reversed(payloads) if isinstance(entry, ImageBoxesSet)), None)
    implied: list[Payload] = []
    if on_image is None:
        on_image = image_follower(page, payloads)
        if on_image is None:
            return implied
        implied.append(on_image)
    implied += view_followers(page, on_image)
    if changes_kind(page, on_image):
        opened = open_frame()
        implied += remeasured(page, opened, label_config(project, opened.frame), on_image)
    return implied
