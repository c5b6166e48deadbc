"""Which frames of a project have known 3D boxes, and which: those beside its recordings, or from a dataset."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from annotator.project import Project, StoredFrame
from annotator.types import Frame, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.frames import FrameSource
from annotator.workflows.importing import LabelSet
from annotator.workflows.importing.boxes_3d import match_frames, truths_of
from annotator.workflows.importing.frame_finder import Renamed
from annotator.workflows.truth import has_truth, label_file, load_truth, one_file_a_frame


@dataclass(frozen=True, eq=False)
class KnownLabels:
    """Labelled frames, and their objects.

    Attributes:
        frames: that are labelled, also those without an object, in the project's order.
        truths: gives the objects of one of them, boxes in the camera frame.
        unmatched: names of labelled frames that the project does not have.
        renamed: the dataset's only recording, where it was taken for one of another name.
        one_file_a_frame: a broken label file spoils its own frame alone.
        not_reviewed: counts the boxes of a frame that are not among its objects, because nobody has accepted them.
    """

    frames: tuple[StoredFrame, ...]
    truths: Callable[[StoredFrame, Frame], Sequence[Truth]]
    unmatched: tuple[str, ...] = ()
    renamed: Renamed | None = None
    one_file_a_frame: bool = False
    not_reviewed: Callable[[StoredFrame], int] = lambda stored: 0


def labels_beside(project: Project, recordings: Collection[int] | None = None) -> KnownLabels:
    """The labels that lie beside the project's recordings, such as KITTI's `label_2`.

    Args:
        recordings: ids of those that are asked for; None = all.

    Raises:
        ConfigError: none of them brings labels.
        RecordingError: one of them cannot be read.
    """
    source = FrameSource(project)
    asked = {r.id: r.name for r in project.recordings.all() if recordings is None or r.id in recordings}
    places = {
        number: {key: place for place, key in enumerate(source.recording(number).keys)}
        for number in asked
        if has_truth(source.recording(number))
    }
    if not places:
        names = ", ".join(asked.values()) or "there are none"
        raise ConfigError(f"no 3D boxes lie beside the recordings ({names}); name the file or folder that holds them")

    def is_labelled(stored: StoredFrame) -> bool:
        file = label_file(source.recording(stored.recording_id), stored.key)
        return stored.key in places[stored.recording_id] and file is not None and file.is_file()

    def truths(stored: StoredFrame, frame: Frame) -> list[Truth]:
        recording = source.recording(stored.recording_id)
        return load_truth(recording, places[stored.recording_id][stored.key], frame)

    apart = all(one_file_a_frame(source.recording(number)) for number in places)
    frames = tuple(filter(is_labelled, project.frames.of(sorted(places))))
    return KnownLabels(frames, truths, one_file_a_frame=apart)


def labels_from(project: Project, found: LabelSet, recording: str | None = None) -> KnownLabels:
    """The labels of a dataset, for the frames that the project has.

    Args:
        recording: name of the recording that plain frame names belong to, where several have frames of that name.

    Raises:
        FormatError: none of the labelled frames is one of the project's, or a name fits several.
        NotFoundError: no such recording.
    """
    known = match_frames(project, found.path, found.frames, recording)
    present = {stored.id: (name, stored) for name, stored in known.matched if stored.index is not None}

    def truths(stored: StoredFrame, frame: Frame) -> Sequence[Truth]:
        return truths_of(found, present[stored.id][0], frame)

    def not_reviewed(stored: StoredFrame) -> int:
        return found.left_behind(present[stored.id][0]).not_reviewed

    frames = tuple(stored for _, stored in present.values())
    return KnownLabels(frames, truths, known.unmatched, known.renamed, not_reviewed=not_reviewed)
