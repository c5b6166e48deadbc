"""Imports 3D boxes for the frames of a project."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace

import numpy as np

from annotator.project import FramePart, NewLabel, Project, StoredFrame, WriteContext
from annotator.project.classes.completing import ValueReader
from annotator.project.event_types import FrameAttributesSet
from annotator.project.records import OWN
from annotator.project.sources.bring import SourceTracks
from annotator.types import Frame, Source, Truth
from annotator.types.errors import ConfigError, FormatError, FrameError, StaleRevisionError
from annotator.types.label import AttributeValue, Said
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.label_set import (
    FoundInProject,
    HasFrameValues,
    HasUnseen,
    LabelSet,
    ProposalSet,
    ScoreRange,
)
from annotator.workflows.importing.placing import (
    NO_NAMES,
    PROGRAM,
    Importer,
    Renamed,
    match_frames,
    renamed_class,
)
from annotator.workflows.importing.report import SizeDoubts
from annotator.workflows.importing.values import give_missing_values

# No sensor sees so far.
FARTHEST_BOX_M = 10_000.0


@dataclass
class ImportedLabels:
    """The result of an import.

    Attributes:
        frames: number of frames that got labels, or are empty in the dataset.
        labels: number of labels by class.
        other_classes: boxes left out because the project has no such class, by class.
        already: number of frames left unchanged because they have labels or are finalised.
        unmatched: names of labelled frames that the project does not have.
        unreadable: frames that cannot be read, as `key: reason`.
        not_reviewed: number of boxes on `frames` left out because they are not accepted in the dataset.
        unseen: number of boxes left out because they are outside the images of all frames that were read.
        scores: number of scores on `frames` left out because they are not confidences in 0..1.
        flat: number of 2D boxes on `frames` left out because they have no 3D box.
        tracks: number of track ids on `frames` left out because an earlier box of the frame has the same one.
        values: values of attributes left out, with the reason, because the project's attributes cannot hold them.
        filled: number of values that labels and frames among `already` got.
        doubt: what the sizes of the boxes show if they hardly are in metres, or in the order length, width, height.
        renamed: the dataset's only recording, if it was matched with one of another name.
    """

    frames: int = 0
    labels: Counter[str] = field(default_factory=Counter)
    other_classes: Counter[str] = field(default_factory=Counter)
    already: int = 0
    unmatched: tuple[str, ...] = ()
    unreadable: list[str] = field(default_factory=list)
    not_reviewed: int = 0
    unseen: int = 0
    scores: int = 0
    flat: int = 0
    tracks: int = 0
    values: Counter[str] = field(default_factory=Counter)
    filled: int = 0
    doubt: str | None = None
    renamed: Renamed | None = None


def import_labels(
    project: Project,
    dataset: LabelSet,
    recording: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    names: Mapping[str, str] = NO_NAMES,
    importer: Importer = PROGRAM,
    fill: bool = False,
) -> ImportedLabels:
    """Imports the boxes of every frame without labels; each becomes an accepted label with the source imported.

    Args:
        recording: name of the recording of plain frame names, if several recordings have such frames.
        progress: called with (frames done, frames).
        names: the project's class of each class of the dataset; classes that are not listed keep their names.
        fill: give labels that frames have already, and these frames, the values of attributes that they lack. Finalised
            frames stay as they are.

    Raises:
        FormatError: none of the labelled frames is in the project, or a name fits several.
        NotFoundError: no such recording.
        RecordingError: a recording has been moved.
    """
    dataset = dataset.in_project(project) if isinstance(dataset, FoundInProject) else dataset
    frames = match_frames(project, dataset.path, dataset.frames, recording)
    source, done = FrameSource(project), ImportedLabels(unmatched=frames.unmatched, renamed=frames.renamed)
    reader = _Importer(project, dataset, names, importer, done)
    for number, (name, stored) in enumerate(frames.matched, 1):
        is_labelled = stored.finalised or bool(project.labels.of_frame(stored.id))
        if is_labelled:
            done.already += 1
        if not is_labelled or (fill and not stored.finalised and reader.has_values(name)):
            try:
                truths = truths_of(dataset, name, source.read(stored))
            except FrameError as error:
                done.unreadable.append(f"{stored.key}: {error}")
            else:
                (reader.fill if is_labelled else reader.add)(name, stored, truths)
        if progress is not None:
            progress(number, len(frames.matched))
    done.values = reader.left_out
    done.doubt = reader.sizes.problem()
    done.unseen = dataset.unseen() if isinstance(dataset, HasUnseen) else 0
    return done


class _Importer:
    def __init__(
        self, project: Project, dataset: LabelSet, names: Mapping[str, str], importer: Importer, done: ImportedLabels
    ) -> None:
        self._project, self._dataset, self._names = project, dataset, names
        self._importer, self._done = importer, done
        config = project.config
        self._classes = set(config.classes)
        self._attributes = {each.name for each in config.attributes}
        self._reader = ValueReader(config.attributes)
        self.sizes = SizeDoubts()

    @property
    def left_out(self) -> Counter[str]:
        """Values that the project cannot hold."""
        return self._reader.left_out

    def has_values(self, name: str) -> bool:
        """Whether a frame of the dataset has values of the project's attributes; no frame is read."""
        of_frame = self._dataset.values_of(name) if isinstance(self._dataset, HasFrameValues) else {}
        return any(self._attributes & values.keys() for values in (of_frame, *self._dataset.values_of_boxes(name)))

    def add(self, name: str, stored: StoredFrame, truths: Sequence[Truth]) -> None:
        """Stores the labels and values of a frame without labels."""
        done = self._done
        named = [(t, renamed_class(t.label, self._names)) for t in truths]
        for truth, label in named:
            self.sizes.add(label, truth.box.size_m)
        done.other_classes.update(t.label for t, label in named if label not in self._classes)
        new, repeated = with_tracks_once(self._labels(truths))
        if create_if_unlabelled(self._project, stored.id, new, self._importer.author, self._importer.action):
            self._give_frame(name, stored)
            done.frames += 1
            done.labels.update(label.label for label in new)
            left_out = self._dataset.left_out_of(name)
            done.not_reviewed += left_out.not_reviewed
            done.scores += left_out.scores
            done.flat += left_out.flat
            done.tracks += repeated
        else:
            done.already += 1

    def fill(self, name: str, stored: StoredFrame, truths: Sequence[Truth]) -> None:
        """Stores the values that a frame and its labels lack."""
        given = self._labels(truths)
        importer = self._importer
        self._done.filled += give_missing_values(self._project, stored.id, given, importer.author, importer.action)
        self._done.filled += self._give_frame(name, stored)

    def _labels(self, truths: Sequence[Truth]) -> list[NewLabel]:
        named = [(t, renamed_class(t.label, self._names)) for t in truths]
        return [
            NewLabel(
                label,
                t.box,
                t.score,
                t.track_id,
                box_kind=t.box_kind,
                attributes=self._reader.of_label(label, t.attributes),
                said=_known(t.said, self._names, self._classes),
            )
            for t, label in named
            if label in self._classes
        ]

    def _give_frame(self, name: str, stored: StoredFrame) -> int:
        if not isinstance(self._dataset, HasFrameValues):
            return 0
        values = self._reader.of_frame(self._dataset.values_of(name))
        return _set_values(self._project, stored.id, values, self._importer) if values else 0


def _known(said: Sequence[Said], names: Mapping[str, str], classes: Collection[str]) -> tuple[Said, ...]:
    """Returns what sources said, in the project's classes; nothing of other classes."""
    named = (replace(each, label=renamed_class(each.label, names)) for each in said)
    return tuple(each for each in named if each.label in classes)


def _set_values(project: Project, frame_id: int, values: Mapping[str, AttributeValue], importer: Importer) -> int:
    """Gives a frame the values that it lacks; returns how many."""
    while True:
        present = project.frames.attributes_of(frame_id)
        missing = dict(values) | present
        if len(missing) == len(present):
            return 0
        revision = project.frames.get(frame_id).revision
        with suppress(StaleRevisionError):
            context = WriteContext(revision, importer.author, Source.IMPORTED)
            part = FramePart(frame_id, [FrameAttributesSet(attributes=missing)], context)
            project.log.append_to_frames([part], importer.action)
            return len(missing) - len(present)


def truths_of(dataset: LabelSet, name: str, frame: Frame) -> Sequence[Truth]:
    """Returns the objects of a frame of a dataset, boxes in the camera frame. Raises FormatError: as `within_range`."""
    with within_range(dataset, name):
        return near(dataset.truths(name, frame))


def near(truths: Sequence[Truth]) -> Sequence[Truth]:
    """Returns objects that may be seen by their camera.

    Raises:
        ValueError: the box of one is too far away: its format has boxes relative to the camera, or to another place.
    """
    for truth in truths:
        away_m = float(np.linalg.norm(truth.box.center_m))
        if away_m > FARTHEST_BOX_M:
            raise ValueError(
                f"a box of {truth.label} is {away_m / 1000:,.0f} km from the camera: its coordinates are a map's, "
                "but this format's, or the recording's, are not"
            )
    return truths


@contextmanager
def within_range(dataset: LabelSet, name: str) -> Iterator[None]:
    """While the boxes of a frame are read.

    Raises:
        FormatError: the transform to the camera frame moves a box out of range; or as `LabelSet.truths`.
    """
    try:
        yield
    except ValueError as error:
        raise FormatError(dataset.path, f"{name}: {error}; correct its boxes or its calibration") from error


def with_tracks_once(new: Sequence[NewLabel]) -> tuple[list[NewLabel], int]:
    """Returns a frame's labels, the first box of each track with its id, the others without; and how many these are."""
    taken, kept = set[int | None](), list[NewLabel]()
    for label in new:
        kept.append(replace(label, track_id=None, file_track_id=None) if label.track_id in taken else label)
        taken |= {label.track_id} - {None}
    return kept, sum(before is not after for before, after in zip(new, kept, strict=True))


def create_if_unlabelled(
    project: Project, frame_id: int, new: Sequence[NewLabel], author: str, action: str | None = None
) -> bool:
    """Stores imported labels; returns False if the frame has labels or is finalised, even by a concurrent edit.

    A finalised frame without labels is confirmed as empty.
    """
    while True:
        stored = project.frames.get(frame_id)
        if stored.finalised or project.labels.of_frame(frame_id):
            return False
        if not new:
            return True
        # retried if the frame was changed since it was read
        with suppress(StaleRevisionError):
            project.labels.create(frame_id, new, WriteContext(stored.revision, author, Source.IMPORTED), action)
            return True


# Longest name of a source, characters.
MOST_NAME = 200
# Frames and boxes that are stored in one transaction: other writers wait for it.
MOST_FRAMES, MOST_BOXES = 50, 500


@dataclass
class ImportedProposals:
    """The result of an import of proposals.

    Attributes:
        source: name under which the boxes are known.
        frames: number of frames that the source now has a say in.
        proposals: number of proposed boxes, by class.
        merged: number of these that other sources see as well, or our own proposals.
        conflicts: values of boxes that another source sees as well, and gives another value: that of the surer box is
            shown.
        covered: boxes that reviewed labels cover already.
        unsure: boxes with a score below the minimum.
        rejected: boxes left out because somebody has rejected them.
        other_classes: boxes left out because the project has no such class, by class of the file.
        finalised: number of frames left unchanged because they are finalised.
        unmatched, unreadable, renamed, tracks, values, unseen, flat, doubt: as in `ImportedLabels`.
        scored: whether any box of the dataset has a score.
        scaled: the range of the scores if they are not confidences; it was scaled to 0..1.
    """

    source: str
    frames: int = 0
    proposals: Counter[str] = field(default_factory=Counter)
    merged: int = 0
    conflicts: int = 0
    covered: int = 0
    unsure: int = 0
    rejected: int = 0
    other_classes: Counter[str] = field(default_factory=Counter)
    finalised: int = 0
    unmatched: tuple[str, ...] = ()
    unreadable: list[str] = field(default_factory=list)
    renamed: Renamed | None = None
    scored: bool = False
    scaled: ScoreRange | None = None
    tracks: int = 0
    values: Counter[str] = field(default_factory=Counter)
    unseen: int = 0
    flat: int = 0
    doubt: str | None = None


def import_proposals(
    project: Project,
    dataset: ProposalSet,
    source: str | None = None,
    *,
    recording: str | None = None,
    min_score: float | None = None,
    names: Mapping[str, str] = NO_NAMES,
    importer: Importer | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportedProposals:
    """Imports the boxes of a dataset as open proposals of `source`, which replace its earlier ones on these frames.

    Args:
        source: name under which the boxes are known, such as that of a detector; None = that of the file or folder.
        recording: name of the recording of plain frame names, if several recordings have such frames.
        min_score: lowest score, as in the file, of the boxes to import; boxes without a score are imported.
        names: the project's class of each class of the file; classes that are not listed keep their names.
        importer: who imports; None = the source itself.
        progress: called with (frames done, frames).

    Raises:
        FormatError, NotFoundError, RecordingError: as `import_labels`.
        ConfigError: the source's name is empty, longer than `MOST_NAME`, or means annotator itself.
    """
    source = (dataset.path.resolve().stem if source is None else source).strip()
    if not 0 < len(source) <= MOST_NAME or source == OWN:
        raise ConfigError(
            f"{source!r} cannot name a source of boxes: use 1 to {MOST_NAME} characters, and not {OWN!r}, which means "
            "this project's own proposals"
        )
    dataset = dataset.in_project(project) if isinstance(dataset, FoundInProject) else dataset
    frames = match_frames(project, dataset.path, dataset.frames, recording)
    scores = dataset.scores
    done = ImportedProposals(source, unmatched=frames.unmatched, renamed=frames.renamed)
    done.scored = scores is not None
    done.scaled = None if scores is None or scores.are_confidences else scores
    reader = _Proposer(project, dataset, source, scores, min_score, names, importer, done)
    for number, (name, stored) in enumerate(frames.matched, 1):
        reader.add(name, stored)
        if progress is not None:
            progress(number, len(frames.matched))
    reader.store()
    done.doubt = reader.sizes.problem()
    done.unseen = dataset.unseen() if isinstance(dataset, HasUnseen) else 0
    return done


class _Proposer:
    def __init__(
        self,
        project: Project,
        dataset: ProposalSet,
        source: str,
        scores: ScoreRange | None,
        min_score: float | None,
        names: Mapping[str, str],
        importer: Importer | None,
        done: ImportedProposals,
    ) -> None:
        self._project, self._dataset, self._source, self._scores = project, dataset, source, scores
        self._min_score, self._names, self._done = min_score, names, done
        self._author, self._action = (source, None) if importer is None else (importer.author, importer.action)
        self._classes = set(project.config.classes)
        self._frames = FrameSource(project)
        self._values = ValueReader(project.config.attributes)
        done.values = self._values.left_out
        self._tracks: dict[int, _Tracks] = {}
        self._waiting: dict[int, list[NewLabel]] = {}
        self.sizes = SizeDoubts()

    def add(self, name: str, stored: StoredFrame) -> None:
        """Reads the proposals of one frame, and stores them with those of other frames."""
        if stored.finalised:
            self._done.finalised += 1
            return

        def read() -> Frame:
            return self._frames.read(stored)

        try:
            with within_range(self._dataset, name):
                truths = near(self._dataset.suggested(name, read))
        except FrameError as error:
            self._done.unreadable.append(f"{stored.key}: {error}")
            return
        left_out = self._dataset.left_out_of(name)
        self._done.rejected += left_out.rejected
        self._done.flat += left_out.flat
        self._waiting[stored.id] = self._chosen(truths, stored.recording_id)
        if len(self._waiting) >= MOST_FRAMES or sum(map(len, self._waiting.values())) >= MOST_BOXES:
            self.store()

    def store(self) -> None:
        """Stores what has been read."""
        stored = self._project.proposals.bring(self._source, self._waiting, self._author, self._action)
        self._done.finalised += len(self._waiting) - len(stored)
        for frame_id, brought in stored.items():
            self._done.frames += 1
            new = zip(self._waiting[frame_id], brought.is_open, strict=True)
            self._done.proposals.update(label.label for label, is_open in new if is_open)
            self._done.merged += brought.merged
            self._done.conflicts += brought.conflicts
            self._done.covered += brought.is_open.count(False)
        self._waiting = {}

    def _chosen(self, truths: Sequence[Truth], recording_id: int) -> list[NewLabel]:
        sure = [each for each in truths if not self._is_unsure(each)]
        self._done.unsure += len(truths) - len(sure)
        named = [replace(each, label=renamed_class(each.label, self._names)) for each in sure]
        for each in named:
            self.sizes.add(each.label, each.box.size_m)
        known = [pair for pair in zip(sure, named, strict=True) if pair[1].label in self._classes]
        self._done.other_classes.update(
            before.label for before, after in zip(sure, named, strict=True) if after.label not in self._classes
        )
        labels = [self._label(each, self._track(recording_id, each.track_id)) for _, each in known]
        labels, repeated = with_tracks_once(labels)
        self._done.tracks += repeated
        return labels

    def _label(self, truth: Truth, track_id: int | None) -> NewLabel:
        return NewLabel(
            truth.label,
            truth.box,
            None if self._scores is None else self._scores.confidence(truth.score),
            track_id,
            box_kind=truth.box_kind,
            attributes=self._values.of_label(truth.label, truth.attributes),
            file_track_id=None if truth.track_id == track_id else truth.track_id,
        )

    def _is_unsure(self, truth: Truth) -> bool:
        return self._min_score is not None and truth.score is not None and truth.score < self._min_score

    def _track(self, recording_id: int, track_id: int | None) -> int | None:
        if track_id is None:
            return None
        if recording_id not in self._tracks:
            self._tracks[recording_id] = _Tracks(self._project.proposals.source_tracks(recording_id, self._source))
        return self._tracks[recording_id].of(track_id)


class _Tracks:
    """Track ids of a source in a recording: as in its file, unless other labels or tracks of the file use them.

    A later file of the source gets the same ids for the same tracks.
    """

    def __init__(self, known: SourceTracks) -> None:
        self._used = set(known.used)
        self._next = max(known.used, default=0) + 1
        self._given = dict(known.given)

    def of(self, track_id: int) -> int:
        if track_id not in self._given:
            given = self._unused() if track_id in self._used else track_id
            self._given[track_id] = given
            self._used.add(given)
        return self._given[track_id]

    def _unused(self) -> int:
        while self._next in self._used:
            self._next += 1
        return self._next
