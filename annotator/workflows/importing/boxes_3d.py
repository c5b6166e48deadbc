"""Imports 3D boxes for the frames of a project: as labels of frames without any, or as proposals onto all."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import count
from typing import TypeVar

from annotator.project import NewLabel, Project, StoredFrame, WriteContext
from annotator.project.classes.values import ValueReader
from annotator.project.records import OWN
from annotator.project.sources import covered_by, source_tracks
from annotator.types import Frame, ReviewState, Source, Truth
from annotator.types.errors import ConfigError, StaleRevisionError
from annotator.types.label import Said
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.label_set import LabelSet, near, truths_of, uncollected
from annotator.workflows.importing.placing import NO_NAMES, PROGRAM, Importer, OwnClasses
from annotator.workflows.importing.report import Become, ImportReport, Note, SizeDoubts
from annotator.workflows.importing.values import give_values, of_covered

# Longest name of a source, characters.
MOST_NAME = 200
# Frames and boxes that are stored in one transaction: other writers wait for it.
MOST_FRAMES, MOST_BOXES = 100, 1000


def import_labels(
    project: Project,
    dataset: LabelSet,
    recording: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    names: Mapping[str, str] = NO_NAMES,
    importer: Importer = PROGRAM,
    fill: bool = False,
    beside: Collection[str] = (),
) -> ImportReport:
    """Imports the boxes of every frame without labels; each becomes an accepted label with the source imported.

    A box that a label of another camera covers, which shares the cloud of the frame, is not imported again.

    Args:
        recording: name of the recording of plain frame names, if several recordings have such frames.
        progress: called with (frames done, frames).
        names: the project's class of each class of the dataset; classes that are not listed keep their names.
        fill: give labels that frames have already, and these frames, the values of attributes that they lack. Finalised
            frames stay as they are.
        beside: classes of the dataset that an earlier import left out: their boxes are imported beside the labels that
            frames have, and no others.
    """
    reader = Reader(project, dataset, recording, names, ImportReport(Become.LABELS, project.config.classes))
    labels = _Labels(reader, importer, fill, beside)
    reader.read_all(labels.add, progress)
    return reader.report


def import_proposals(
    project: Project,
    dataset: LabelSet,
    source: str | None = None,
    *,
    recording: str | None = None,
    min_score: float | None = None,
    names: Mapping[str, str] = NO_NAMES,
    importer: Importer | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Imports the boxes of a dataset as open proposals of `source`, which replace its earlier ones on these frames.

    Args:
        source: name under which the boxes are known, such as that of a detector; None = that of the file or folder.
        min_score: lowest score, as in the file, of the boxes to import; boxes without a score are imported.
    """
    source = (dataset.path.resolve().stem if source is None else source).strip()
    if not 0 < len(source) <= MOST_NAME or source == OWN:
        raise ConfigError(
            f"{source!r} cannot name a source of boxes: use 1 to {MOST_NAME} characters, and not {OWN!r}, which means "
            "this project's own proposals"
        )
    report = ImportReport(Become.PROPOSALS, project.config.classes, source)
    reader = Reader(project, dataset, recording, names, report)
    proposals = _Proposals(reader, source, min_score, importer or Importer(source))
    reader.read_all(proposals.add, progress)
    proposals.store()
    if min_score is not None and report.boxes and reader.dataset.scores is None:
        report.add(Note.UNSCORED)
    return report


Labelled = TypeVar("Labelled", Truth, Said)


class Reader:
    """Reads a dataset frame by frame, its boxes as labels of the project's classes."""

    def __init__(
        self,
        project: Project,
        dataset: LabelSet,
        recording: str | None,
        names: Mapping[str, str],
        report: ImportReport,
    ) -> None:
        self.project, self.report = project, report
        self.dataset = dataset.in_project(project)
        self.frames = FrameSource(project)
        self.matched = self.dataset.placed(project, recording).require_clear(dataset.path)
        report.add_all(Note.UNMATCHED, self.matched.unmatched)
        if self.matched.renamed is not None:
            report.add(Note.RENAMED, of=str(self.matched.renamed))
        self._own = OwnClasses(project.config.classes, names)
        self.values = ValueReader(project.config.attributes)
        self._sizes = SizeDoubts()

    @uncollected()
    def read_all(self, add: Callable[[str, StoredFrame], None], progress: Callable[[int, int], None] | None) -> None:
        """Adds all frames; one that cannot be read is reported."""
        for number, (name, stored) in enumerate(self.matched.matched, 1):
            try:
                add(name, stored)
            except self.dataset.faults_of_frames as error:
                self.report.add(Note.UNREADABLE, of=f"{stored.key}: {error}")
            if progress is not None:
                progress(number, len(self.matched.matched))
        for what, number in self.values.left_out.items():
            self.report.add(Note.VALUE, number, what)
        if (doubt := self._sizes.problem()) is not None:
            self.report.add(Note.DOUBT, of=doubt)
        self.report.add(Note.UNSEEN, self.dataset.unseen())

    def label(self, truth: Truth, score: float | None, track_id: int | None) -> NewLabel:
        """Returns an object, whose class is the project's, as a label."""
        return NewLabel(
            truth.label,
            truth.box,
            score,
            track_id,
            box_kind=truth.box_kind,
            attributes=self.values.of_label(truth.label, truth.attributes),
            said=tuple(self.known(truth.said)),
            file_track_id=None if truth.track_id == track_id else truth.track_id,
        )

    def known(self, objects: Sequence[Labelled]) -> list[Labelled]:
        """Returns what is of the project's classes, with its names of these."""
        own = ((each, self._own.of(each.label)) for each in objects)
        return [each if label == each.label else replace(each, label=label) for each, label in own if label is not None]

    def count(self, truths: Sequence[Truth]) -> None:
        """Counts the sizes of boxes, and those of other classes."""
        for each in truths:
            label = self._own.of(each.label)
            self._sizes.add(label or each.label, each.box.size_m)
            if label is None:
                self.report.add(Note.OTHER_CLASS, of=each.label)


class _Labels:
    """Stores boxes as labels."""

    def __init__(self, reader: Reader, importer: Importer, fill: bool, beside: Collection[str]) -> None:
        self._reader, self._importer, self._fill, self._beside = reader, importer, fill, beside
        self._project, self._dataset, self._report = reader.project, reader.dataset, reader.report
        self._attributes = {each.name for each in reader.project.config.attributes}

    def add(self, name: str, stored: StoredFrame) -> None:
        """Stores the labels and values of a frame without labels, or the values that a labelled one lacks."""
        labelled = not self._beside and any(each.is_own for each in self._project.labels.of_moment(stored.id))
        is_labelled = stored.finalised or labelled
        if is_labelled:
            self._report.add(Note.ALREADY)
            if stored.finalised or not self._fill or not self._has_values(name):
                return
        truths = truths_of(self._dataset, name, self._reader.frames.read(stored))
        if is_labelled:
            boxes = self._labels(truths)
            self._report.add(Note.FILLED, self._give(name, stored, boxes))
        else:
            self._create(name, stored, truths)

    def _create(self, name: str, stored: StoredFrame, truths: Sequence[Truth]) -> None:
        report = self._report
        if self._beside:
            truths = [each for each in truths if each.label in self._beside]
        self._reader.count(truths)
        every, repeated = with_tracks_once(self._labels(truths))
        author, action = self._importer.author, self._importer.action
        new = create_if_unlabelled(self._project, stored.id, every, author, action, beside=bool(self._beside))
        if new is None:
            report.add(Note.ALREADY)
            return
        self._give(name, stored)
        report.frames += 1
        report.add(Note.OTHER_CAMERA, len(every) - len(new))
        report.boxes.update(label.label for label in new)
        left_out = self._dataset.left_out_of(name)
        report.add(Note.NOT_REVIEWED, left_out.not_reviewed)
        report.add(Note.SCORE, left_out.scores)
        report.add(Note.FLAT, left_out.flat)
        report.add(Note.TRACK, repeated)

    def _labels(self, truths: Sequence[Truth]) -> list[NewLabel]:
        return [self._reader.label(each, each.score, each.track_id) for each in self._reader.known(truths)]

    def _has_values(self, name: str) -> bool:
        """Whether a frame of the dataset has values of the project's attributes; no frame is read."""
        every = (self._dataset.values_of(name), *self._dataset.values_of_boxes(name))
        return any(self._attributes & values.keys() for values in every)

    def _give(self, name: str, stored: StoredFrame, boxes: Sequence[NewLabel] = ()) -> int:
        """Gives a frame its values, and the labels that these boxes show theirs; returns how many."""
        of_frame = self._reader.values.of_frame(self._dataset.values_of(name))
        if not of_frame and not any(each.attributes for each in boxes):
            return 0
        return give_values(
            self._project, stored.id, of_frame, lambda labels: of_covered(boxes, labels), self._importer
        )[0]


def with_tracks_once(new: Sequence[NewLabel], taken: Iterable[int | None] = ()) -> tuple[list[NewLabel], int]:
    """Returns a frame's labels, the first box of each track with its id, the others without; and how many these are.

    Args:
        taken: tracks that have a box already.
    """
    taken, kept = {*taken} - {None}, list[NewLabel]()
    for label in new:
        kept.append(replace(label, track_id=None, file_track_id=None) if label.track_id in taken else label)
        taken |= {label.track_id} - {None}
    return kept, sum(before is not after for before, after in zip(new, kept, strict=True))


def create_if_unlabelled(
    project: Project,
    frame_id: int,
    new: Sequence[NewLabel],
    author: str,
    action: str | None = None,
    *,
    beside: bool = False,
) -> Sequence[NewLabel] | None:
    """Stores imported labels, without those that labels of other cameras of the moment cover; returns the others.

    None if the frame has labels, unless they are to be stored `beside` these, or is finalised, even by a concurrent
    edit. A finalised frame without labels is confirmed as empty.
    """
    while True:
        stored = project.frames.get(frame_id)
        of_moment = project.labels.of_moment(frame_id)
        if stored.finalised or (not beside and any(each.is_own for each in of_moment)):
            return None
        there = [each.label for each in of_moment]
        taken = [label.track_id for label in there if label.state is not ReviewState.REJECTED]
        left = [label for label, cover in zip(new, covered_by(new, there), strict=True) if cover is None]
        chosen = with_tracks_once(left, taken)[0]
        if not chosen:
            return chosen
        # retried if the frame was changed since it was read
        with suppress(StaleRevisionError):
            project.labels.create(frame_id, chosen, WriteContext(stored.revision, author, Source.IMPORTED), action)
            return chosen


class _Proposals:
    """Stores boxes as proposals of a source."""

    def __init__(self, reader: Reader, source: str, min_score: float | None, importer: Importer) -> None:
        self._reader, self._source, self._min_score, self._importer = reader, source, min_score, importer
        self._project, self._dataset, self._report = reader.project, reader.dataset, reader.report
        self._scores = self._dataset.scores
        if self._scores is not None and not self._scores.are_confidences:
            self._report.add(Note.SCALED, of=f"{self._scores.low:g} to {self._scores.high:g}")
        self._tracks: dict[int, _Tracks] = {}
        self._waiting: dict[int, list[NewLabel]] = {}

    def add(self, name: str, stored: StoredFrame) -> None:
        """Reads the proposals of one frame, and stores them with those of other frames."""
        if stored.finalised:
            self._report.add(Note.FINALISED)
            return

        def read() -> Frame:
            return self._reader.frames.read(stored)

        truths = near(self._dataset, name, lambda: self._dataset.suggested(name, read))
        left_out = self._dataset.left_out_of(name)
        self._report.add(Note.REJECTED, left_out.rejected)
        self._report.add(Note.FLAT, left_out.flat)
        self._waiting[stored.id] = self._chosen(truths, stored.recording_id)
        if len(self._waiting) >= MOST_FRAMES or sum(map(len, self._waiting.values())) >= MOST_BOXES:
            self.store()

    def store(self) -> None:
        """Stores what has been read."""
        importer, report = self._importer, self._report
        stored = self._project.proposals.bring(self._source, self._waiting, importer.author, importer.action)
        report.add(Note.FINALISED, len(self._waiting) - len(stored))
        for frame_id, brought in stored.items():
            report.frames += 1
            new = zip(self._waiting[frame_id], brought.is_open, strict=True)
            report.boxes.update(label.label for label, is_open in new if is_open)
            report.add(Note.MERGED, brought.merged)
            report.add(Note.CONFLICT, brought.conflicts)
            report.add(Note.COVERED, brought.is_open.count(False))
        self._waiting = {}

    def _chosen(self, truths: Sequence[Truth], recording_id: int) -> list[NewLabel]:
        sure = [each for each in truths if not self._is_unsure(each)]
        self._report.add(Note.UNSURE, len(truths) - len(sure))
        self._reader.count(sure)
        labels, repeated = with_tracks_once(
            [
                self._reader.label(
                    each,
                    None if self._scores is None else self._scores.confidence(each.score),
                    self._track(recording_id, each.track_id),
                )
                for each in self._reader.known(sure)
            ]
        )
        self._report.add(Note.TRACK, repeated)
        return labels

    def _is_unsure(self, truth: Truth) -> bool:
        return self._min_score is not None and truth.score is not None and truth.score < self._min_score

    def _track(self, recording_id: int, track_id: int | None) -> int | None:
        if track_id is None:
            return None
        if recording_id not in self._tracks:
            self._tracks[recording_id] = _Tracks(*source_tracks(self._project.store, recording_id, self._source))
        return self._tracks[recording_id].of(track_id)


class _Tracks:
    """Track ids of a source in a recording: as in its file, unless other labels or tracks of the file use them.

    A later file of the source gets the same ids for the same tracks.
    """

    def __init__(self, used: set[int], given: dict[int, int]) -> None:
        self._used, self._given = used, given
        self._numbers = count(max(used, default=0) + 1)

    def of(self, track_id: int) -> int:
        if track_id not in self._given:
            free = (number for number in self._numbers if number not in self._used)
            given = next(free) if track_id in self._used else track_id
            self._given[track_id] = given
            self._used.add(given)
        return self._given[track_id]
