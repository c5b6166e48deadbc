"""Imports the 3D labels beside a recording into its project."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from annotator.project import NewLabel, Project, StoredFrame
from annotator.project.classes.completing import ValueReader
from annotator.project.sources import covered_by
from annotator.recordings.look_around import LookAround
from annotator.types.errors import FormatError, FrameError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.boxes_3d import create_if_unlabelled, with_tracks_once
from annotator.workflows.importing.size_doubts import SizeDoubts
from annotator.workflows.recorded.reading import has_truth, is_labelled, load_truth, one_file_a_frame
from annotator.workflows.recorded.whole_sets import require_units
from annotator.workflows.rigs import Rigs

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
