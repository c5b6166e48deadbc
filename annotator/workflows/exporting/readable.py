"""Finds the frames of an export that can be read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from annotator.formats.losses import Losses, Lost
from annotator.project import Project
from annotator.types.errors import FrameError
from annotator.workflows.exporting.choose import Chosen
from annotator.workflows.exporting.choose_pictures import ChosenPictures
from annotator.workflows.frame_source import FrameSource


def readable_frames(
    project: Project, chosen: Sequence[Chosen], losses: Losses, progress: Callable[[int, int], None] | None = None
) -> tuple[list[Chosen], tuple[str, ...]]:
    """Returns the frames that can be read, and the others as `RECORDING/KEY: reason`.

    Every frame is read once in advance, because writers name and number frames before they read them. Pseudo-views of
    an unreadable frame are still exported, because the project stores them.

    Args:
        losses: counts the frames that are left out.
        progress: called with (frames read, frames to read).

    Raises:
        FrameError: no frame can be read; the error of the first one.
        RecordingError: a recording has been moved.
    """
    source, left_out = FrameSource(project), []
    readable: list[Chosen] = []
    first: FrameError | None = None
    for number, each in enumerate(chosen, 1):
        views_alone = isinstance(each, ChosenPictures) and not each.image
        try:
            if not views_alone:
                source.read(each.stored)
        except FrameError as error:
            first = first or error
            left_out.append(f"{each.recording}/{each.stored.key}: {error}")
            if isinstance(each, ChosenPictures) and each.views:
                readable.append(replace(each, image=False))
        else:
            readable.append(each)
        if progress is not None:
            progress(number, len(chosen))
    if first is not None and not readable:
        raise first
    losses.add(Lost.UNREADABLE, len(left_out))
    return readable, tuple(left_out)
