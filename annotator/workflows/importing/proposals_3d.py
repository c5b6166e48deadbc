"""Imports 3D boxes of other software as proposals, onto frames with labels as well."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from annotator.project import NewLabel, Project, StoredFrame
from annotator.project.classes.completing import ValueReader
from annotator.project.log.records import OWN
from annotator.project.sources import SourceTracks
from annotator.types import Frame, Truth
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.boxes_3d import Importer, match_frames, near, with_tracks_once, within_range
from annotator.workflows.importing.class_names import NO_NAMES, renamed_class
from annotator.workflows.importing.frame_finder import Renamed
from annotator.workflows.importing.label_set import FoundInProject, HasUnseen, ProposalSet, ScoreRange
from annotator.workflows.importing.size_doubts import SizeDoubts

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
    reader = _Importer(project, dataset, source, scores, min_score, names, importer, done)
    for number, (name, stored) in enumerate(frames.matched, 1):
        reader.add(name, stored)
        if progress is not None:
            progress(number, len(frames.matched))
    reader.store()
    done.doubt = reader.sizes.problem()
    done.unseen = dataset.unseen() if isinstance(dataset, HasUnseen) else 0
    return done


class _Importer:
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
