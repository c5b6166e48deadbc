"""How good the boxes of a project are, by the yardstick of a benchmark."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from annotator.evaluation.oriented_protocol import evaluate_oriented
from annotator.evaluation.report import Report, oriented_report, sunrgbd_report
from annotator.evaluation.sunrgbd import evaluate_sunrgbd
from annotator.formats.kitti import KittiLabel
from annotator.formats.kitti_row import kitti_row
from annotator.project import REVIEWED, Project, StoredFrame
from annotator.types import Label, ReviewState, Source
from annotator.types.errors import ConfigError
from annotator.workflows.evaluate import SURE, Named, Options, Protocol, box_table, kitti_of
from annotator.workflows.frames import FrameSource
from annotator.workflows.kitti_view import rows_of_truth, true_kitti_rows
from annotator.workflows.own_labels import AUTHOR
from annotator.workflows.truth import has_truth, load_truth


class Measured(StrEnum):
    """What is measured.

    LABELS: all boxes as they are now, but for rejected ones.
    PROPOSALS: what the last automatic pass over each frame proposed, before anybody reviewed it.
    """

    LABELS = "labels"
    PROPOSALS = "proposals"


class Against(StrEnum):
    """What it is measured against.

    TRUTH: the boxes that the recordings bring.
    REVIEWED: accepted and edited labels, in frames where nothing is left to review.
    """

    TRUTH = "truth"
    REVIEWED = "reviewed"


@dataclass(frozen=True)
class Choice:
    """What is compared, in which recordings (ids; None = all)."""

    measured: Measured = Measured.LABELS
    against: Against = Against.TRUTH
    recordings: tuple[int, ...] | None = None


def evaluate_project(
    project: Project, protocol: Protocol, choice: Choice | None = None, options: Options | None = None
) -> Report:
    """Evaluates boxes of a project, frame by frame as `Choice` says.

    Only frames count that somebody or some pass has worked on: with a label, finalised, or (PROPOSALS: and) with an
    automatic pass. Against the truth, and for KITTI's 2D boxes, every such frame is read. Labels that are the
    recordings' own boxes, as they were imported, are told in a note: they are compared with themselves.

    Args:
        options: its frames are named `RECORDING/KEY`.

    Raises:
        ConfigError: the choice leaves nothing to compare, or compares labels with themselves.
        RecordingError: a recording cannot be read.
        FormatError: its labels are broken.
    """
    choice, options = choice or Choice(), options or Options()
    if (choice.measured, choice.against) == (Measured.LABELS, Against.REVIEWED):
        raise ConfigError("labels cannot be measured against reviewed labels, which they are; measure proposals")
    source = _Source(project, choice, options)
    report = _kitti(source, options.relaxed) if protocol is Protocol.KITTI else _boxes(source, protocol)
    return replace(report, notes=source.notes())


def _boxes(source: _Source, protocol: Protocol) -> Report:
    compared = list(source.compared())
    found, there = (box_table(side) for side in zip(*compared, strict=True)) if compared else (box_table([]),) * 2
    if len(there) == 0:
        raise ConfigError(f"there is no true box in the {len(compared)} frames to evaluate")
    if protocol is Protocol.SUNRGBD:
        return sunrgbd_report(evaluate_sunrgbd(found, there))
    return oriented_report(evaluate_oriented(found, there))


def _kitti(source: _Source, relaxed: bool) -> Report:
    rows = [source.kitti(stored) for stored in source.frames()]
    if not any(there for _, there in rows):
        raise ConfigError(f"there is no true box in the {len(rows)} frames to evaluate")
    return kitti_of([found for found, _ in rows], [there for _, there in rows], relaxed)


class _Source:
    """The frames of a project that are compared, and both sides of each."""

    def __init__(self, project: Project, choice: Choice, options: Options) -> None:
        self._project = project
        self._choice = choice
        self._names = None if options.frames is None else set(options.frames)
        self._frames = FrameSource(project)
        self._labels_seen = 0
        self._unchanged = 0
        self._require_names()

    def _require_names(self) -> None:
        """Names that fit nothing would leave nothing to compare, or another project's frames out."""
        if self._names is None:
            return
        of_id = {recording.id: recording.name for recording in self._project.recordings.all()}
        known = {f"{of_id[frame.recording_id]}/{frame.key}" for frame in self._project.frames.of()}
        if missing := sorted(self._names - known):
            raise ConfigError(
                f"project {self._project.config.name} has no frame {missing[0]} ({len(missing)} of the "
                f"{len(self._names)} names are none of its frames); names are RECORDING/KEY"
            )

    def notes(self) -> tuple[str, ...]:
        """What must be known of the numbers, once all frames are compared."""
        if self._choice.against is not Against.TRUTH or not self._unchanged:
            return ()
        return (
            f"{self._unchanged} of the {self._labels_seen} labels are the recordings' own boxes, as they were "
            "imported, and were compared with themselves; measure proposals (--measured proposals), or add recordings "
            "with --no-labels",
        )

    def frames(self) -> Iterator[StoredFrame]:
        """Those that are compared, in order."""
        known = {recording.id: recording.name for recording in self._project.recordings.all()}
        chosen = self._with_truth(known) if self._choice.against is Against.TRUTH else self._choice.recordings
        for stored in self._project.frames.of(chosen):
            name = f"{known[stored.recording_id]}/{stored.key}"
            if (self._names is None or name in self._names) and self._is_compared(stored):
                yield stored

    def compared(self) -> Iterator[tuple[list[Named], list[Named]]]:
        """What was found in each frame, and what is there."""
        for stored in self.frames():
            yield self._found(stored), self._there(stored)

    def kitti(self, stored: StoredFrame) -> tuple[Sequence[KittiLabel], Sequence[KittiLabel]]:
        """The same of one frame, as KITTI's rows."""
        frame = self._frames.read(stored)
        found = [kitti_row(*named, frame) for named in self._found(stored)]
        if self._choice.against is Against.REVIEWED:
            return found, rows_of_truth(((label, box) for label, box, _ in self._there(stored)), frame)
        recording = self._frames.recording(stored.recording_id)
        return found, true_kitti_rows(recording, recording.keys.index(stored.key), frame)

    def _with_truth(self, known: Mapping[int, str]) -> tuple[int, ...]:
        """The chosen recordings, which must have truth; else all those that have some."""
        asked = self._choice.recordings
        having = tuple(i for i in (known if asked is None else asked) if has_truth(self._frames.recording(i)))
        lacking = [known[i] for i in asked or () if i not in having]
        if lacking or not having:
            names = ", ".join(lacking) or "no recording"
            verb = "brings no" if lacking else "brings"
            raise ConfigError(f"{names} {verb} true boxes; measure against what was reviewed (--against reviewed)")
        return having

    def _is_compared(self, stored: StoredFrame) -> bool:
        labels = self._project.labels.of_frame(stored.id)
        worked_on = bool(labels) or stored.finalised
        if self._choice.against is Against.TRUTH and stored.index is None:
            return False
        if self._choice.against is Against.REVIEWED and not (
            worked_on and all(label.state is not ReviewState.PROPOSED for label in labels)
        ):
            return False
        if self._choice.measured is Measured.LABELS and worked_on:
            return True
        return self._project.proposals.latest(stored.id) is not None

    def _found(self, stored: StoredFrame) -> list[Named]:
        if self._choice.measured is Measured.LABELS:
            labels = [label for label in self._labels(stored) if label.state is not ReviewState.REJECTED]
            self._labels_seen += len(labels)
            self._unchanged += sum(label.source is Source.IMPORTED and label.author == AUTHOR for label in labels)
            return [_named(label) for label in labels]
        latest = self._project.proposals.latest(stored.id)
        proposals = [entry.proposal for entry in latest.objects] if latest is not None else []
        return [(proposal.label, proposal.box, proposal.score) for proposal in proposals]

    def _there(self, stored: StoredFrame) -> list[Named]:
        if self._choice.against is Against.REVIEWED:
            return [_named(label) for label in self._labels(stored) if label.state in REVIEWED]
        recording = self._frames.recording(stored.recording_id)
        truths = load_truth(recording, recording.keys.index(stored.key), self._frames.read(stored))
        return [(truth.label, truth.box, SURE) for truth in truths]

    def _labels(self, stored: StoredFrame) -> tuple[Label, ...]:
        return self._project.labels.of_frame(stored.id)


def _named(label: Label) -> Named:
    return label.label, label.box, SURE if label.score is None else label.score
