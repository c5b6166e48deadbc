"""What a file of boxes would give, before it is imported: no frame is read, and nothing is stored."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from annotator.project import Project
from annotator.types import Source
from annotator.types.amounts import amount
from annotator.workflows.importing.label_set import ScoreRange
from annotator.workflows.importing.pictures import FlatFormat, placed_pictures, read_pictures
from annotator.workflows.importing.placing import Matched
from annotator.workflows.importing.report import MOST_NAMES
from annotator.workflows.importing.table import BoxFormat, read_labels


@dataclass(frozen=True)
class Preview:
    """What a dataset of boxes has.

    Attributes:
        is_3d: False for 2D boxes.
        frames: number of its frames or images with a frame in the project.
        ambiguous: number of those that fit frames of several recordings: one of these must be chosen.
        boxes: number of boxes on `frames`, by class.
        scores: the lowest and the highest score of 3D boxes, if there are any.
        notes: sentences about what an import would leave out, replace or not change.
    """

    is_3d: bool
    frames: int
    ambiguous: int
    boxes: dict[str, int]
    scores: ScoreRange | None
    notes: tuple[str, ...]

    @property
    def found(self) -> str:
        """A sentence about what the dataset has for the project."""
        number = sum(self.boxes.values())
        if self.is_3d:
            return f"{amount(number, '3D box')} in {amount(self.frames, 'frame')} of this project."
        return f"{amount(number, 'box')} on {amount(self.frames, 'image')} of this project's frames."


def preview(project: Project, path: Path, format: FlatFormat | BoxFormat, recording: str | None) -> Preview:
    """Reads a dataset and matches it with the project's frames.

    Args:
        recording: name of the only recording to search; None = all.

    Raises:
        FormatError: not in this format, an image occurs twice, or no frame is in the project.
        NotFoundError: no such recording.
        RecordingError: a recording has been moved.
    """
    if isinstance(format, FlatFormat):
        return _of_pictures(project, path, format, recording)
    dataset = read_labels(format, path).in_project(project)
    placed = dataset.placed(project, recording)
    names = [name for name, _ in placed.matched] + [name for name, *_ in placed.ambiguous]
    labelled, notes = project.labels.frames(), []
    finalised = sum(stored.finalised for _, stored in placed.matched)
    if worked_on := sum(stored.id in labelled and not stored.finalised for _, stored in placed.matched):
        frames = amount(worked_on, "of these frames has", "of these frames have")
        notes.append(f"{frames} labels or proposals, and can only take proposals.")
    if finalised:
        frames = amount(finalised, "of these frames is", "of these frames are")
        notes.append(f"{frames} finalised, and left unchanged.")
    boxes = Counter(label for name in names for label in dataset.classes(name))
    return _preview(True, placed, boxes, dataset.scores, notes)


def _of_pictures(project: Project, path: Path, format: FlatFormat, recording: str | None) -> Preview:
    dataset = read_pictures(format, path)
    placed = placed_pictures(project, dataset, dataset.pictures, recording)
    pictures = [picture for picture, _ in placed.matched] + [picture for picture, *_ in placed.ambiguous]
    drawn = {one.frame_id for one in project.boxes.on_images() if one.boxes and one.source is not Source.IMPORTED}
    replaced = sum(stored.id in drawn and not stored.finalised for _, stored in placed.matched)
    notes = [f"The import replaces the boxes drawn on {amount(replaced, 'image')}."] if replaced else []
    boxes = Counter(label for picture in pictures for label in picture.labels)
    return _preview(False, placed, boxes, None, notes)


def _preview(
    is_3d: bool, placed: Matched[object], boxes: Counter[str], scores: ScoreRange | None, notes: list[str]
) -> Preview:
    thing = "frame" if is_3d else "image"
    if (renamed := placed.renamed) is not None:
        notes.append(f"The file names a recording {renamed.named}, taken for {', '.join(renamed.taken_for)}.")
    if placed.unmatched:
        names = ", ".join(placed.unmatched[:MOST_NAMES])
        left_out = amount(len(placed.unmatched), thing)
        notes.append(f"Left out: {left_out} without a frame of the same name, such as {names}.")
    frames = len(placed.matched) + len(placed.ambiguous)
    return Preview(is_3d, frames, len(placed.ambiguous), dict(sorted(boxes.items())), scores, tuple(notes))
