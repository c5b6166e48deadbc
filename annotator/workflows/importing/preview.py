"""What a file of boxes would give, before it is imported."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from annotator.project import Project, StoredFrame
from annotator.types import Source
from annotator.workflows.importing.label_set import FoundInProject, ScoreRange
from annotator.workflows.importing.pictures import FlatFormat, frames_of, no_frame, read_pictures, same_frame
from annotator.workflows.importing.placing import FrameFinder, Renamed, found_frames, none_of
from annotator.workflows.importing.table import BoxFormat, read_labels


@dataclass(frozen=True)
class Preview:
    """What a dataset of 2D boxes has.

    Attributes:
        images: number of its images.
        unmatched: names of those without a frame in the project.
        ambiguous: number of those that fit frames of several recordings.
        boxes: number of boxes on the others, by class name.
        replaced: number of images with boxes drawn in the project, which the import replaces.
        renamed: the dataset's only recording, if it was matched with one of another name.
    """

    images: int
    unmatched: tuple[str, ...]
    ambiguous: int
    boxes: dict[str, int]
    replaced: int
    renamed: Renamed | None


@dataclass(frozen=True)
class Preview3D(Preview):
    """What a dataset of 3D boxes has; its images are frames, and `replaced` is 0.

    Attributes:
        labelled: number of the frames that an import as labels leaves unchanged: those with labels in any state, also
            proposed or rejected ones, and finalised ones.
        finalised: number of the frames that an import as proposals leaves unchanged.
        scores: the lowest and the highest score, if there are any.
    """

    labelled: int
    finalised: int
    scores: ScoreRange | None


def preview_3d(project: Project, path: Path, format: BoxFormat, recording: str | None) -> Preview3D:
    """Reads 3D boxes and matches them with the project's frames; nothing is stored, and no frame is read.

    Args:
        recording: name of the only recording to search; None = all.

    Raises:
        FormatError: not in this format, or no frame is in the project.
        NotFoundError, RecordingError: as `import_labels`.
    """
    dataset = read_labels(format, path)
    dataset = dataset.in_project(project) if isinstance(dataset, FoundInProject) else dataset
    found, finder = found_frames(project, dataset.frames, recording)
    unmatched = tuple(name for name, frames in found.items() if not frames)
    if len(unmatched) == len(found):
        raise none_of(path, dataset.frames)
    boxes = Counter(label for name, frames in found.items() if frames for label in dataset.classes(name))
    labelled = project.labels.frames()
    matched = [frames[0] for frames in found.values() if len(frames) == 1]
    return Preview3D(
        len(found),
        unmatched,
        sum(len(frames) > 1 for frames in found.values()),
        dict(sorted(boxes.items())),
        0,
        finder.renamed(frames[0] for name, frames in found.items() if frames and name != frames[0].key),
        sum(frame.finalised or frame.id in labelled for frame in matched),
        sum(frame.finalised for frame in matched),
        dataset.scores,
    )


def preview(project: Project, path: Path, format: FlatFormat, recording: str | None) -> Preview:
    """Reads a dataset and matches its images with the project's frames; nothing is stored, and no frame is read.

    Args:
        recording: name of the only recording to search; None = all.

    Raises:
        FormatError: not in this format, an image occurs twice, or no image has a frame in the project.
        NotFoundError: no such recording.
    """
    dataset = read_pictures(format, path)
    frames = FrameFinder(project, recording, {origin.recording for origin in dataset.origins.values()})
    boxes, unmatched, ambiguous = Counter[str](), list[str](), 0
    matched: dict[int, tuple[str, StoredFrame]] = {}
    named: list[StoredFrame] = []
    for picture in dataset.pictures:
        key, fitting = frames_of(dataset, picture, frames)
        if not fitting:
            unmatched.append(picture.file_name)
            continue
        boxes.update(picture.labels)
        named += fitting if picture.stem in dataset.origins else []
        if len(fitting) > 1:
            ambiguous += 1
            continue
        (frame,) = fitting
        if frame.id in matched:
            raise same_frame(path, matched[frame.id][0], picture.file_name, key)
        matched[frame.id] = (picture.file_name, frame)
    if len(unmatched) == len(dataset.pictures):
        raise no_frame(path)
    drawn = {one.frame_id for one in project.boxes.on_images() if one.boxes and one.source is not Source.IMPORTED}
    replaced = sum(frame.id in drawn and not frame.finalised for _, frame in matched.values())
    return Preview(
        len(dataset.pictures),
        tuple(unmatched),
        ambiguous,
        dict(sorted(boxes.items())),
        replaced,
        frames.renamed(named),
    )
