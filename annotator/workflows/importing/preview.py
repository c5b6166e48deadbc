"""What a file of 2D boxes would give, before it is imported."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from annotator.project import Project
from annotator.workflows.importing.frame_finder import FrameFinder
from annotator.workflows.importing.image_boxes import frames_of, no_frame
from annotator.workflows.importing.picture_labels import FlatFormat, read_pictures


@dataclass(frozen=True)
class Preview:
    """What a dataset of 2D boxes has.

    Attributes:
        images: number of its images.
        unmatched: names of those without a frame in the project.
        ambiguous: number of those that fit frames of several recordings.
        boxes: number of boxes on the others, by class name.
    """

    images: int
    unmatched: tuple[str, ...]
    ambiguous: int
    boxes: dict[str, int]


def preview(project: Project, path: Path, format: FlatFormat, recording: str | None) -> Preview:
    """Reads a dataset and matches its images with the project's frames; nothing is stored, and no frame is read.

    Args:
        recording: name of the only recording to search; None = all.

    Raises:
        FormatError: not in this format, or no image has a frame in the project.
        NotFoundError: no such recording.
    """
    dataset = read_pictures(format, path)
    frames = FrameFinder(project, recording, {origin.recording for origin in dataset.origins.values()})
    boxes, unmatched, ambiguous = Counter[str](), list[str](), 0
    for picture in dataset.pictures:
        _, fitting = frames_of(dataset, picture, frames)
        if fitting:
            boxes.update(picture.labels)
            ambiguous += len(fitting) > 1
        else:
            unmatched.append(picture.file_name)
    if len(unmatched) == len(dataset.pictures):
        raise no_frame(path)
    return Preview(len(dataset.pictures), tuple(unmatched), ambiguous, dict(sorted(boxes.items())))
