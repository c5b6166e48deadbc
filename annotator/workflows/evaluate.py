"""Evaluates detections in files, or the boxes of a project.

By a benchmark's protocol, or against the truth beside the project's recordings.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from operator import attrgetter
from pathlib import Path

import numpy as np

from annotator.evaluation.boxes import SUNRGBD_THRESHOLDS, BoxTable, evaluate_oriented
from annotator.evaluation.kitti import NEIGHBOURS, OFFICIAL, RELAXED, KittiRows, evaluate_kitti
from annotator.evaluation.report import Report, kitti_report, oriented_report, sunrgbd_report
from annotator.files import TABLE_BYTES, read_text_file
from annotator.formats.box_files import read_upright_boxes
from annotator.formats.frame_names import LabelledFrame
from annotator.formats.kitti_folders import label_place, read_kitti_folder
from annotator.formats.kitti_rows import KittiLabel, kitti_row
from annotator.formats.rcv import MANIFEST, labelled_frames
from annotator.formats.reading import faults, holds_texts
from annotator.project import REVIEWED, Project, StoredFrame
from annotator.text import normal
from annotator.types import Label, OrientedBox, Proposal, ReviewState, Source, Truth
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import amount
from annotator.workflows.frame_source import FrameSource, seen_labels
from annotator.workflows.recorded.own_labels import AUTHOR
from annotator.workflows.recorded.reading import has_truth, is_labelled, load_truth, rows_of_truth, true_kitti_rows

# Used for boxes without a score.
DEFAULT_SCORE = 1.0
SCORE_PROJECT = (
    "to score boxes of another format, add their recording to a project, and its boxes with `annotator add` or "
    "`annotator import`; then `annotator evaluate --project PROJECT`"
)


class Protocol(StrEnum):
    """The evaluation protocol: KITTI's devkit, VoteNet's SUN RGB-D evaluation, or fully oriented boxes."""

    KITTI = "kitti"
    SUNRGBD = "sunrgbd"
    ORIENTED = "oriented"


ScoredBox = tuple[str, OrientedBox, float]
"""Class, box and score."""


class Measured(StrEnum):
    """The boxes to evaluate.

    LABELS: the current labels, except rejected ones.
    PROPOSALS: the proposals of the last automatic pass over each frame, before any review.
    """

    LABELS = "labels"
    PROPOSALS = "proposals"


class Against(StrEnum):
    """The boxes taken as true.

    TRUTH: the boxes beside the recordings.
    REVIEWED: accepted and edited labels, in frames without unreviewed proposals.
    """

    TRUTH = "truth"
    REVIEWED = "reviewed"


@dataclass(frozen=True)
class Options:
    """Options of an evaluation; the first two also of files.

    Attributes:
        frames: names of the frames to evaluate; None = all. KITTI: file names without suffix. SUN RGB-D: images.
            Oriented, and all of projects: `RECORDING/KEY`.
        relaxed: KITTI's relaxed IoU thresholds in bird's-eye view and 3D (0.5 for Car, 0.25 for the others).
        measured, against: the boxes to compare.
        recordings: ids; None = all.
    """

    frames: Collection[str] | None = None
    relaxed: bool = False
    measured: Measured = Measured.LABELS
    against: Against = Against.TRUTH
    recordings: tuple[int, ...] | None = None


def read_frame_names(path: Path) -> list[str]:
    """Reads frame names from a file with one name per line, such as KITTI's `ImageSets/val.txt`."""
    with faults(path):
        lines = read_text_file(path, TABLE_BYTES).split("\n")
    names = [normal(line.strip()) for line in lines if line.strip()]
    if not names:
        raise FormatError(path, "contains no frame name")
    return names


def evaluate_files(detections: Path, truth: Path, protocol: Protocol, options: Options | None = None) -> Report:
    """Evaluates detections against truth, both in the protocol's format.

    Args:
        detections, truth: kitti = folders or zip archives with one text file per frame, or datasets with
            training/label_2; sunrgbd = CSV files of boxes; oriented = `rcv` datasets.
    """
    options = options or Options()
    if protocol is Protocol.KITTI:
        return kitti_of(*_kitti_files(detections, truth, options), options.relaxed)
    return _of_boxes(protocol, *frame_tables(*_frames_of_files(detections, truth, protocol, options)))


def _of_boxes(protocol: Protocol, detected: BoxTable, true: BoxTable) -> Report:
    if protocol is Protocol.SUNRGBD:
        return sunrgbd_report(evaluate_oriented(detected, true, SUNRGBD_THRESHOLDS))
    return oriented_report(evaluate_oriented(detected, true))


Rows = list[Sequence[KittiLabel]]
"""KITTI's rows by frame."""


def _kitti_files(detections: Path, truth: Path, options: Options) -> tuple[Rows, Rows]:
    detections, truth = label_place(detections), label_place(truth)
    for path in (detections, truth):
        if path.exists() and not holds_texts(path):
            raise FormatError(
                path, f"is no folder of KITTI's text files, one for each frame, and no zip of one; {SCORE_PROJECT}"
            )
    detected, true = read_kitti_folder(detections, scored=True), read_kitti_folder(truth, scored=False)
    names = sorted(detected) if options.frames is None else list(dict.fromkeys(options.frames))
    _require(names, true, truth, "with the truth")
    _require(names, detected, detections, "with detections; write an empty file for a frame without detections")
    if options.frames is None and len(true) > len(detected):
        other = next(name for name in true if name not in detected)
        raise ConfigError(
            f"{detections}: has {amount(len(detected), 'frame')}, {truth} has {len(true)}; e.g. {other}.txt is "
            "missing. Write an empty file for each frame without detections, "
            "or name the frames of your split with --frame-list"
        )
    return [detected[name] for name in names], [true[name] for name in names]


def kitti_of(
    detected: Sequence[Sequence[KittiLabel]], true: Sequence[Sequence[KittiLabel]], relaxed: bool = False
) -> Report:
    """Evaluates rows by frame with KITTI's protocol."""
    result = evaluate_kitti(kitti_rows(detected), kitti_rows(true), RELAXED if relaxed else OFFICIAL)
    if not result:
        raise ConfigError(
            f"no detection, of {sum(map(len, detected))} in all, is of a class that KITTI evaluates "
            f"({', '.join(NEIGHBOURS)})"
        )
    return kitti_report(result)


def _require(names: Iterable[str], files: Mapping[str, object], path: Path, what: str) -> None:
    missing = [name for name in names if name not in files]
    if missing:
        raise ConfigError(
            f"{path}: has no file {missing[0]}.txt {what} ({amount(len(missing), 'frame')} without a file)"
        )


# from `truncated` to `rotation_y`
NUMBERS = attrgetter(*(field.name for field in fields(KittiLabel)[1:15]))


def kitti_rows(frames: Sequence[Sequence[KittiLabel]]) -> KittiRows:
    """Returns rows by frame as columns; frames are numbered from 0."""
    rows = [row for each in frames for row in each]
    numbers = [(*NUMBERS(row), _score(row.score)) for row in rows]
    frame = np.repeat(np.arange(len(frames)), list(map(len, frames)))
    labels = np.array([row.label for row in rows], np.str_)
    return KittiRows.from_table(frame, labels, np.array(numbers, np.float64).reshape(-1, 15))


Frames = Mapping[str, LabelledFrame]


def _frames_of_files(detections: Path, truth: Path, protocol: Protocol, options: Options) -> tuple[Frames, Frames]:
    """Returns the frames to evaluate, of detections and truth."""
    paths = (detections, truth)
    for path in paths:
        if protocol is Protocol.ORIENTED and path.exists() and not (path / MANIFEST).is_file():
            raise FormatError(path, f"is no dataset in the format rcv, which has a {MANIFEST}; {SCORE_PROJECT}")
        if protocol is Protocol.SUNRGBD and (path.is_dir() or path.suffix == ".json"):
            raise FormatError(
                path, f"is no CSV file of boxes, one for all images (image,class,cx,...); {SCORE_PROJECT}"
            )
    if protocol is Protocol.ORIENTED:
        frames = labelled_frames(detections), labelled_frames(truth)
    else:
        frames = read_upright_boxes(detections, scored=True), read_upright_boxes(truth)
    detected, true = ({normal(name): frame for name, frame in each.items()} for each in frames)
    first = f"first frames: {next(iter(detected), 'none')}, {next(iter(true), 'none')}"
    if detected and not detected.keys() & true.keys():
        raise ConfigError(
            f"{paths[0]} and {paths[1]} have no frame in common ({first}); frames must have the same names in both"
        )
    # images without boxes do not occur in the files
    if options.frames is not None and not {*options.frames} & {*detected, *true}:
        wanted = min(options.frames, default="none")
        raise ConfigError(f"none of the names to evaluate (first: {wanted}) is in {paths[1]} ({first})")
    if options.frames is not None:
        detected, true = ({k: v for k, v in each.items() if k in options.frames} for each in (detected, true))
    if not any(frame.truths for frame in true.values()):
        raise ConfigError(f"{paths[1]}: has no true boxes in the frames to evaluate")
    return detected, true


def frame_tables(detected: Frames, true: Frames) -> tuple[BoxTable, BoxTable]:
    """Returns the boxes of detections and truth as columns, without rejected ones."""
    nothing = LabelledFrame(())
    names = list(dict.fromkeys([*detected, *true]))
    found, wanted = ([_scored_boxes(each.get(name, nothing)) for name in names] for each in (detected, true))
    return box_table(found), box_table(wanted)


def _scored_boxes(frame: LabelledFrame) -> list[ScoredBox]:
    states = frame.states or [None] * len(frame.truths)
    known = zip(frame.truths, states, strict=True)
    return [scored_box(truth) for truth, state in known if state is not ReviewState.REJECTED]


def box_table(frames: Sequence[Sequence[ScoredBox]]) -> BoxTable:
    """Returns boxes by frame as columns; frames are numbered from 0."""
    return BoxTable.of((number, *box) for number, frame in enumerate(frames) for box in frame)


def evaluate_project(project: Project, protocol: Protocol, options: Options | None = None) -> Report:
    """Evaluates boxes of a project.

    LABELS uses frames that have labels, are finalised, or had an automatic pass. PROPOSALS uses only frames that had an
    automatic pass. A note in the report counts labels imported from the recordings themselves, since these are compared
    with themselves.
    """
    options = options or Options()
    if (options.measured, options.against) == (Measured.LABELS, Against.REVIEWED):
        raise ConfigError("labels cannot be measured against reviewed labels, which are the same; measure proposals")
    source, is_kitti = _Source(project, options), protocol is Protocol.KITTI
    compared = [(source.kitti if is_kitti else source.boxes)(stored) for stored in source.frames()]
    if not any(true for _, true in compared):
        raise ConfigError(f"there are no true boxes in the {amount(len(compared), 'frame')} to evaluate")
    detected, true = zip(*compared, strict=True)
    if is_kitti:
        report = kitti_of(detected, true, options.relaxed)
    else:
        report = _of_boxes(protocol, box_table(detected), box_table(true))
    return replace(report, notes=source.notes())


class _Source:
    """The frames of a project to compare, each with the boxes to evaluate and the true boxes."""

    def __init__(self, project: Project, options: Options) -> None:
        self._project, self._options, self._frames = project, options, FrameSource(project)
        self._labels_seen = self._unchanged = 0
        self._recordings = {recording.id: recording.name for recording in project.recordings.all()}
        self._names = None if options.frames is None else set(options.frames)
        if self._names is not None and (missing := sorted(self._names - set(map(self._name, project.frames.of())))):
            raise ConfigError(
                f"project {project.config.name} has no frame {missing[0]} (unknown: {len(missing)} of "
                f"{amount(len(self._names), 'name')}); names are RECORDING/KEY"
            )

    def _name(self, frame: StoredFrame) -> str:
        return f"{self._recordings[frame.recording_id]}/{frame.key}"

    def notes(self) -> tuple[str, ...]:
        """Returns notes for the report, once all frames are compared."""
        if self._options.against is not Against.TRUTH or not self._unchanged:
            return ()
        return (
            f"imported from the recordings themselves, and so compared with themselves: {self._unchanged} of "
            f"{amount(self._labels_seen, 'label')}; measure proposals (--measured proposals), or add recordings with "
            "--no-labels",
        )

    def frames(self) -> Iterator[StoredFrame]:
        """Yields the frames to compare, in order."""
        chosen = self._with_truth() if self._options.against is Against.TRUTH else self._options.recordings
        for stored in self._project.frames.of(chosen):
            if (self._names is None or self._name(stored) in self._names) and self._is_compared(stored):
                yield stored

    def boxes(self, stored: StoredFrame) -> tuple[list[ScoredBox], list[ScoredBox]]:
        """Returns the boxes to evaluate and the true boxes of one frame."""
        return self._measured(stored), self._true(stored)

    def kitti(self, stored: StoredFrame) -> tuple[Sequence[KittiLabel], Sequence[KittiLabel]]:
        """Returns the boxes to evaluate and the true boxes of one frame as KITTI's rows."""
        frame = self._frames.read(stored)
        measured = [kitti_row(*scored, frame) for scored in self._measured(stored)]
        if self._options.against is Against.REVIEWED:
            return measured, rows_of_truth(((label, box) for label, box, _ in self._true(stored)), frame)
        recording = self._frames.recording(stored.recording_id)
        return measured, true_kitti_rows(recording, recording.indices[stored.key], frame)

    def _with_truth(self) -> tuple[int, ...]:
        """Returns the chosen recordings, which must all have truth; without a choice, all that have truth."""
        known, chosen = self._recordings, self._options.recordings
        with_truth = tuple(i for i in (known if chosen is None else chosen) if has_truth(self._frames.recording(i)))
        lacking = [known[i] for i in chosen or () if i not in with_truth]
        if lacking or not with_truth:
            names = ", ".join(lacking) or "any recording"
            raise ConfigError(
                f"there are no true boxes beside {names}; measure against reviewed labels (--against reviewed)"
            )
        return with_truth

    def _is_compared(self, stored: StoredFrame) -> bool:
        labels = [each.label for each in self._project.labels.of_moment(stored.id) if each.is_own]
        worked_on = bool(labels) or stored.finalised
        if self._options.against is Against.TRUTH:
            recording = self._frames.recording(stored.recording_id)
            has_true = stored.index is not None and is_labelled(recording, stored.key)
        else:
            has_true = worked_on and all(label.state is not ReviewState.PROPOSED for label in labels)
        is_measured = self._options.measured is Measured.LABELS and worked_on
        return has_true and (is_measured or self._project.proposals.latest(stored.id) is not None)

    def _measured(self, stored: StoredFrame) -> list[ScoredBox]:
        if self._options.measured is Measured.LABELS:
            labels = self._labels(stored, (*REVIEWED, ReviewState.PROPOSED))
            self._labels_seen += len(labels)
            self._unchanged += sum(label.source is Source.IMPORTED and label.author == AUTHOR for label in labels)
            return list(map(scored_box, labels))
        return list(self._project.proposals.latest(stored.id) or ())

    def _true(self, stored: StoredFrame) -> list[ScoredBox]:
        if self._options.against is Against.REVIEWED:
            return list(map(scored_box, self._labels(stored, REVIEWED)))
        recording = self._frames.recording(stored.recording_id)
        truths = load_truth(recording, recording.indices[stored.key], self._frames.read(stored))
        return [(truth.label, truth.box, DEFAULT_SCORE) for truth in truths]

    def _labels(self, stored: StoredFrame, states: Collection[ReviewState]) -> list[Label]:
        return [label for label in seen_labels(self._project, self._frames, stored) if label.state in states]


def scored_box(label: Truth | Proposal) -> ScoredBox:
    return label.label, label.box, _score(label.score)


def _score(score: float | None) -> float:
    return DEFAULT_SCORE if score is None else score
