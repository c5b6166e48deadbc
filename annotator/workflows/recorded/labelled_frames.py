"""Frames of a project with known 3D boxes, from the labels beside its recordings or from a dataset."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from annotator.project import Project, StoredFrame
from annotator.types import Frame, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import LabelSet
from annotator.workflows.importing.boxes_3d import match_frames, truths_of
from annotator.workflows.importing.class_names import renamed_class
from annotator.workflows.importing.frame_finder import Renamed
from annotator.workflows.importing.label_set import FoundInProject
from annotator.workflows.recorded.reading import (
    has_truth,
    is_labelled,
    label_file,
    load_truth,
    one_file_a_frame,
)
from annotator.workflows.recorded.whole_sets import require_units


@dataclass(frozen=True, eq=False)
class KnownLabels:
    """Labelled frames and their objects.

    Attributes:
        frames: the labelled frames, including those without objects, in the project's order.
        truths: returns the objects of a frame, boxes in the camera frame.
        unmatched: names of labelled frames that the project does not have.
        renamed: set if the dataset's only recording was matched to one of another name.
        one_file_a_frame: True if each frame has its own label file, so that a broken one affects only its frame.
        flat: number of 2D boxes left out because they have no 3D box.
        not_reviewed: returns the number of a frame's boxes left out because they are not accepted.
    """

    frames: tuple[StoredFrame, ...]
    truths: Callable[[StoredFrame, Frame], Sequence[Truth]]
    unmatched: tuple[str, ...] = ()
    renamed: Renamed | None = None
    one_file_a_frame: bool = False
    flat: int = 0
    not_reviewed: Callable[[StoredFrame], int] = lambda stored: 0

    def renamed_to(self, names: Mapping[str, str]) -> KnownLabels:
        """Returns the same labels with other classes; classes that `names` does not list keep their names."""

        def truths(stored: StoredFrame, frame: Frame) -> Sequence[Truth]:
            return [replace(each, label=renamed_class(each.label, names)) for each in self.truths(stored, frame)]

        return replace(self, truths=truths) if names else self


def labels_beside(project: Project, recordings: Collection[int] | None = None) -> KnownLabels:
    """Returns the labels beside the project's recordings, such as KITTI's `label_2`.

    Args:
        recordings: ids of the recordings to use; None = all.

    Raises:
        ConfigError: none of them has labels.
        RecordingError: one of them cannot be read.
        UnitError: the labels are in another unit than their format has.
    """
    source = FrameSource(project)
    selected = {r.id: r.name for r in project.recordings.all() if recordings is None or r.id in recordings}
    indices = {
        recording_id: {key: index for index, key in enumerate(source.recording(recording_id).keys)}
        for recording_id in selected
        if has_truth(source.recording(recording_id))
    }
    if not indices:
        names = ", ".join(selected.values()) or "there are none"
        raise ConfigError(f"no 3D boxes lie beside the recordings ({names}); name the file or folder that holds them")

    flat = sum(require_units(source.recording(recording_id)) for recording_id in indices)

    def has_labels(stored: StoredFrame) -> bool:
        recording = source.recording(stored.recording_id)
        if stored.key not in indices[stored.recording_id] or not is_labelled(recording, stored.key):
            return False
        file = label_file(recording, stored.key)
        return file is not None and file.is_file()

    def truths(stored: StoredFrame, frame: Frame) -> list[Truth]:
        recording = source.recording(stored.recording_id)
        return load_truth(recording, indices[stored.recording_id][stored.key], frame)

    separate = all(one_file_a_frame(source.recording(recording_id)) for recording_id in indices)
    frames = tuple(filter(has_labels, project.frames.of(sorted(indices))))
    return KnownLabels(frames, truths, one_file_a_frame=separate, flat=flat)


def labels_from(project: Project, dataset: LabelSet, recording: str | None = None) -> KnownLabels:
    """Returns the labels of a dataset for the frames that the project has.

    Args:
        recording: name of the recording that plain frame names belong to; needed if several have frames of that name.

    Raises:
        FormatError: the project has none of the labelled frames, or a name fits several.
        NotFoundError: no such recording.
    """
    dataset = dataset.in_project(project) if isinstance(dataset, FoundInProject) else dataset
    known = match_frames(project, dataset.path, dataset.frames, recording)
    present = {stored.id: (name, stored) for name, stored in known.matched if stored.index is not None}

    def truths(stored: StoredFrame, frame: Frame) -> Sequence[Truth]:
        return truths_of(dataset, present[stored.id][0], frame)

    def not_reviewed(stored: StoredFrame) -> int:
        return dataset.left_out_of(present[stored.id][0]).not_reviewed

    frames = tuple(stored for _, stored in present.values())
    flat = sum(dataset.left_out_of(name).flat for name, _ in present.values())
    return KnownLabels(frames, truths, known.unmatched, known.renamed, flat=flat, not_reviewed=not_reviewed)
