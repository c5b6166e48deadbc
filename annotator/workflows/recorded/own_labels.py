"""Imports the 3D labels beside a recording into its project."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

from annotator.project import NewLabel, Project, StoredFrame
from annotator.project.classes.completing import ValueReader
from annotator.project.sources.covering import covered_by
from annotator.recordings import Recording
from annotator.recordings.look_around import LookAround
from annotator.types import Frame, Truth
from annotator.types.errors import AnnotatorError, ConfigError, FormatError, FrameError, UnitError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import LabelSet
from annotator.workflows.importing.boxes_3d import create_if_unlabelled, truths_of, with_tracks_once
from annotator.workflows.importing.label_set import FoundInProject
from annotator.workflows.importing.placing import Renamed, match_frames, renamed_class
from annotator.workflows.importing.report import SizeDoubts
from annotator.workflows.importing.table import BoxFormat, read_labels
from annotator.workflows.recorded.reading import has_truth, is_labelled, label_file, load_truth, one_file_a_frame
from annotator.workflows.rigs import Rigs

# The readers of other formats read all frames at once.
FORMATS = {
    "kitti_object": BoxFormat.KITTI,
    "kitti_tracking": BoxFormat.KITTI,
    "rgbd_folder": BoxFormat.BOXES,
    "cloud_folder": BoxFormat.LABELCLOUD,
    "argoverse2": BoxFormat.ARGOVERSE2,
}


def require_units(recording: Recording) -> int:
    """Looks at the labels of all frames; returns how many 2D boxes without a 3D box are among them.

    Other faults are found when the frames are read, and may affect only one of them.

    Raises:
        UnitError: their numbers are in another unit than their format has.
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


# Boxes imported from other datasets have the author "import".
AUTHOR = "recording"


@dataclass
class OwnLabels:
    """Counts of the imported labels.

    Attributes:
        labels: imported labels, by class.
        other_classes: labels left out because the project does not have their class, by class.
        tracks: as in `ImportedLabels`.
        of_other_cameras: boxes left to other cameras of the rig, which have them already or see them better.
        values: values of attributes left out, with the reason, because the project's attributes cannot hold them.
        unreadable: frames that could not be read or whose labels could not be read, as `key: reason`.
        doubt: what the sizes of the boxes show if they hardly are in metres, or in the order length, width, height.
        flat: 2D boxes without a 3D box among the labels of the recording; they are left out.
        are_partial: the recording has virtual cameras, and labels only of what its own camera sees: none is imported,
            since frames would be taken as labelled where nobody looked.
    """

    labels: Counter[str] = field(default_factory=Counter)
    other_classes: Counter[str] = field(default_factory=Counter)
    tracks: int = 0
    of_other_cameras: int = 0
    unreadable: list[str] = field(default_factory=list)
    doubt: str | None = None
    flat: int = 0
    are_partial: bool = False
    values: Counter[str] = field(default_factory=Counter)


def has_own_labels(project: Project, recording_id: int) -> bool:
    """Returns True if there are true boxes beside the recording.

    Raises:
        NotFoundError: no such recording.
        RecordingError: it cannot be read.
    """
    return has_truth(FrameSource(project).recording(recording_id))


def import_own_labels(
    project: Project,
    recording_id: int,
    progress: Callable[[int, int], None] | None = None,
    together: Collection[int] = (),
) -> OwnLabels:
    """Imports the true boxes beside a recording, for every frame without labels.

    A box that another camera of the rig has already is not imported again.

    Unreadable frames, and frames whose own label file is broken, are left out and reported. Frames that are labelled or
    finalised during the import are not changed.

    Args:
        progress: called with (frames done, frames).
        together: ids of recordings whose boxes are imported by the same operation. Of the cameras of a rig among them,
            the one that sees the middle of a box best gets it.

    Raises:
        FormatError: the label file is broken and holds the labels of all frames.
        UnitError: the labels are in another unit than their format has.
    """
    source, counts = FrameSource(project), OwnLabels()
    rigs = Rigs(project, source)
    recording = source.recording(recording_id)
    if not has_truth(recording):
        counts.are_partial = isinstance(recording, LookAround) and has_truth(recording.base)
        return counts
    counts.flat = require_units(recording)
    skipped_errors = (FrameError, FormatError) if one_file_a_frame(recording) else (FrameError,)
    config, sizes = project.config, SizeDoubts()
    classes, reader = set(config.classes), ValueReader(config.attributes)
    indices = {key: index for index, key in enumerate(recording.keys)}
    frames = [
        frame
        for frame in project.frames.of([recording_id])
        if frame.index is not None and frame.key in indices and is_labelled(recording, frame.key)
    ]
    for number, stored in enumerate(frames, 1):
        if not stored.finalised and not project.labels.of_frame(stored.id):
            try:
                truths = load_truth(recording, indices[stored.key], source.read(stored))
            except skipped_errors as error:
                counts.unreadable.append(f"{stored.key}: {error}")
                truths = []
            for truth in truths:
                sizes.add(truth.label, truth.box.size_m)
            counts.other_classes.update(t.label for t in truths if t.label not in classes)
            new = [
                NewLabel(t.label, t.box, track_id=t.track_id, attributes=reader.of_label(t.label, t.attributes))
                for t in truths
                if t.label in classes
            ]
            if new:
                here = _of_this_camera(project, rigs, stored, new, together)
                counts.of_other_cameras += len(new) - len(here)
                new = here
            new, repeated = with_tracks_once(new)
            if new and create_if_unlabelled(project, stored.id, new, AUTHOR):
                counts.labels.update(label.label for label in new)
                counts.tracks += repeated
        if progress is not None:
            progress(number, len(frames))
    counts.values, counts.doubt = reader.left_out, sizes.problem()
    return counts


def _of_this_camera(
    project: Project, rigs: Rigs, frame: StoredFrame, labels: list[NewLabel], together: Collection[int]
) -> list[NewLabel]:
    """Returns the labels that no other camera of the rig has, or will get because it sees them better."""
    waiting = [
        sibling
        for sibling in rigs.siblings(frame)
        if sibling.frame.recording_id in together
        and not sibling.frame.finalised
        and not project.labels.of_frame(sibling.frame.id)
    ]
    covers = covered_by(labels, [other.label for other in rigs.others(frame)])
    return [
        label
        for label, cover in zip(labels, covers, strict=True)
        if cover is None and not rigs.is_better_seen(label.box, waiting)
    ]


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
