"""Which of the frames that leave can be read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from annotator.formats.losses import Losses, Lost
from annotator.project import Project
from annotator.types.errors import FrameError
from annotator.workflows.exporting.choose import Chosen
from annotator.workflows.exporting.choose_pictures import ChosenPictures
from annotator.workflows.frames import FrameSource


def readable_frames(
    project: Project, chosen: Sequence[Chosen], losses: Losses, progress: Callable[[int, int], None] | None = None
) -> tuple[list[Chosen], tuple[str, ...]]:
    """The frames that can be read, and the others as `RECORDING/KEY: reason`.

    Every frame is read once and thrown away: writers name and count what they are given, so it must be known before.
    A frame whose pseudo-views leave keeps these, they are the project's own.

    Args:
        losses: told of what is left out.
        progress: called with (frames read, frames to read).

    Raises:
        FrameError: not one of them can be read; the first one's.
        RecordingError: a recording is not where it was.
    """
    source, left_out = FrameSource(project), []
    kept: list[Chosen] = []
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
                kept.append(replace(each, image=False))
        else:
            kept.append(each)
        if progress is not None:
            progress(number, len(chosen))
    if first is not None and not kept:
        raise first
    losses.add(Lost.UNREADABLE, len(left_out))
    return kept, tuple(left_out)
