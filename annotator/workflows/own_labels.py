"""The 3D labels that a recording brings, as imported labels of a project."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from annotator.project import NewLabel, Project
from annotator.types.errors import FormatError, FrameError
from annotator.workflows.frames import FrameSource
from annotator.workflows.importing.boxes_3d import create_where_none
from annotator.workflows.truth import has_truth, load_truth, one_file_a_frame

# Tells them from boxes of other datasets, whose author is "import".
AUTHOR = "recording"


@dataclass
class OwnLabels:
    """What was taken over.

    Attributes:
        labels: by class.
        other_classes: left out because the project has no such class, by class.
        unreadable: frames whose labels could not be read, as `key: reason`.
    """

    labels: Counter[str] = field(default_factory=Counter)
    other_classes: Counter[str] = field(default_factory=Counter)
    unreadable: list[str] = field(default_factory=list)


def brings_labels(project: Project, recording_id: int) -> bool:
    """True for a recording with true boxes of its own.

    Raises:
        NotFoundError: no such recording.
        RecordingError: it cannot be read.
    """
    return has_truth(FrameSource(project).recording(recording_id))


def import_own_labels(
    project: Project, recording_id: int, progress: Callable[[int, int], None] | None = None
) -> OwnLabels:
    """Takes over the true boxes of a recording, for every frame that has no label yet.

    A frame that cannot be read is told and left out, and so is one whose own label file is broken; a broken file that
    holds the labels of all frames is an error. Others may work meanwhile: what somebody has labelled or finalised by
    the time that a frame has its turn is left alone.

    Args:
        progress: called with (frames looked at, frames).

    Raises:
        FormatError: the one label file of all frames is broken.
    """
    source, found = FrameSource(project), OwnLabels()
    recording = source.recording(recording_id)
    if not has_truth(recording):
        return found
    excused = (FrameError, FormatError) if one_file_a_frame(recording) else (FrameError,)
    classes = set(project.config.classes)
    places = {key: index for index, key in enumerate(recording.keys)}
    frames = [frame for frame in project.frames.of([recording_id]) if frame.key in places]
    for number, stored in enumerate(frames, 1):
        if not stored.finalised and not project.labels.of_frame(stored.id):
            try:
                truths = load_truth(recording, places[stored.key], source.read(stored))
            except excused as error:
                found.unreadable.append(f"{stored.key}: {error}")
                truths = []
            found.other_classes.update(t.label for t in truths if t.label not in classes)
            new = [NewLabel(t.label, t.box, track_id=t.track_id) for t in truths if t.label in classes]
            if new and create_where_none(project, stored.id, new, AUTHOR):
                found.labels.update(label.label for label in new)
        if progress is not None:
            progress(number, len(frames))
    return found
