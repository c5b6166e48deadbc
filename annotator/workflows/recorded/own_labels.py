"""The 3D labels beside a project's recordings, such as KITTI's `label_2`, as a dataset that is imported."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

from annotator.formats.frame_names import LabelledFrame
from annotator.formats.table import BoxFormat
from annotator.project import Project, StoredFrame
from annotator.recordings import Recording
from annotator.recordings.look_around import LookAround
from annotator.types import Frame, Truth
from annotator.types.errors import AnnotatorError, ConfigError, FormatError, FrameError, UnitError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.boxes_3d import import_labels
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.importing.placing import NO_NAMES, Importer, MatchedFrames
from annotator.workflows.importing.readers import read_labels
from annotator.workflows.importing.report import Become, ImportReport, Note
from annotator.workflows.recorded.reading import has_truth, is_labelled, label_file, load_truth, one_file_a_frame

# Boxes imported from other datasets have the author "import".
AUTHOR = "recording"
# Frames are read one by one, but only all boxes together show that their numbers are in another unit than their format
# has (`annotator.formats.reading`). The readers of other formats read all frames at once.
FORMATS = {
    "kitti_object": BoxFormat.KITTI,
    "kitti_tracking": BoxFormat.KITTI,
    "rgbd_folder": BoxFormat.BOXES,
    "cloud_folder": BoxFormat.LABELCLOUD,
    "argoverse2": BoxFormat.ARGOVERSE2,
}


class RecordedLabels(LabelSet):
    """The labels beside recordings of a project.

    Attributes:
        flat: number of 2D boxes without a 3D box among them.
    """

    def __init__(self, project: Project, recordings: Collection[int] | None = None, with_files: bool = False) -> None:
        """
        Args:
            recordings: ids of the recordings to use; None = all.
            with_files: only the frames whose label file exists.
        """
        source = FrameSource(project)
        selected = {r.id: r.name for r in project.recordings.all() if recordings is None or r.id in recordings}
        opened = {number: source.recording(number) for number in selected}
        self._opened = {number: recording for number, recording in opened.items() if has_truth(recording)}
        if not self._opened:
            names = ", ".join(selected.values()) or "there are none"
            raise ConfigError(
                f"no 3D boxes lie beside the recordings ({names}); name the file or folder that holds them"
            )
        super().__init__(next(iter(self._opened.values())).path, {})
        self.flat = sum(map(_require_units, self._opened.values()))
        if all(map(one_file_a_frame, self._opened.values())):
            self.faults_of_frames = (FrameError, FormatError)
        self._stored: dict[str, StoredFrame] = {}
        for stored in project.frames.of(sorted(self._opened)):
            recording = self._opened[stored.recording_id]
            is_there = stored.index is not None and stored.key in recording.indices
            if not is_there or not is_labelled(recording, stored.key):
                continue
            file = label_file(recording, stored.key) if with_files else None
            if not with_files or (file is not None and file.is_file()):
                self._stored[f"{selected[stored.recording_id]}/{stored.key}"] = stored

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self._stored)

    def placed(self, project: Project, recording: str | None = None) -> MatchedFrames:
        return MatchedFrames(tuple(self._stored.items()), (), None)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        """As `LabelSet.truths`, without scores: the labels of a recording are true."""
        stored = self._stored[name]
        recording = self._opened[stored.recording_id]
        truths = load_truth(recording, recording.indices[stored.key], frame)
        return [each if each.score is None else replace(each, score=None) for each in truths]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        return self.truths(name, read())

    def _frame(self, name: str) -> LabelledFrame:
        """Nothing is known before the frame is read."""
        return LabelledFrame(())


def _require_units(recording: Recording) -> int:
    """Looks at the labels of all frames; returns how many 2D boxes without a 3D box are among them.

    Other faults are found when the frames are read, and may affect only one of them.
    """
    file = label_file(recording, recording.keys[0])
    if file is None or recording.format not in FORMATS:
        return 0
    try:
        labels = read_labels(FORMATS[recording.format], file.parent if one_file_a_frame(recording) else file)
        return sum(labels.left_out_of(name).flat for name in labels.frames)
    except UnitError:
        raise
    except AnnotatorError:
        return 0


def has_own_labels(project: Project, recording_id: int) -> bool:
    """Returns True if there are true boxes beside the recording."""
    return has_truth(FrameSource(project).recording(recording_id))


def import_own_labels(
    project: Project,
    recording_id: int,
    progress: Callable[[int, int], None] | None = None,
    names: Mapping[str, str] = NO_NAMES,
) -> ImportReport:
    """Imports the true boxes beside a recording, for every frame without labels.

    Of a recording with virtual cameras whose labels are only of what its own camera sees, none is imported: frames
    would count as labelled where nobody looked.

    Args:
        progress: called with (frames done, frames).
        names: the project's class of each class that an earlier import left out: only these boxes are imported, also
            for frames with labels.
    """
    recording = FrameSource(project).recording(recording_id)
    if not has_truth(recording):
        report = ImportReport(Become.LABELS, project.config.classes)
        report.add(Note.PARTIAL, isinstance(recording, LookAround) and has_truth(recording.base))
        return report
    labels = RecordedLabels(project, [recording_id])
    report = import_labels(project, labels, None, progress, names, Importer(AUTHOR), beside=names)
    report.add(Note.FLAT, labels.flat)
    # labels of an earlier import of the recording
    report.notes.pop(Note.ALREADY, None)
    return report
