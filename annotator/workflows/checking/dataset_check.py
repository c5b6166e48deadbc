"""`annotator check PATH`: checks the datasets at a path, frame by frame, and then all frames of each together.

Frames are read one at a time; after an unreadable frame the check continues. Labels are kept in memory until the end,
because only then is the usual size of their class known.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from annotator.formats.rcv import MANIFEST
from annotator.formats.reading import Angles
from annotator.geometry.oriented_box import contains
from annotator.recordings.poses import survey_poses
from annotator.types import Frame, OrientedBox, ReviewState
from annotator.types.bases import Strict
from annotator.types.errors import AnnotatorError, FormatError, UnclearError, UnitError, UnitKind
from annotator.types.messages import amount, folded
from annotator.workflows.checking import findings as rules
from annotator.workflows.checking import label_rules
from annotator.workflows.checking.alignment import FRAMES, Alignment
from annotator.workflows.checking.findings import Finding, Findings, Rule, Severity
from annotator.workflows.checking.sources import OtherSoftwareDataset, Source, find_sources, stray_names
from annotator.workflows.checking.still_world import StillWorld
from annotator.workflows.importing.report import SizeDoubts
from annotator.workflows.recorded import reading

RULE_OF = {
    UnitKind.ANGLE: rules.ANGLE_UNIT,
    UnitKind.LENGTH: rules.LENGTH_UNIT,
    UnitKind.QUATERNION: rules.QUATERNION_ORDER,
}
# Two boxes without points are seldom both mirror images of objects by chance.
LEAST_MIRRORED = 2
# The axes of the camera frame that may be mirrored; a box mirrored in the third one is behind the camera.
MIRRORED = {0: "left and right", 1: "up and down"}


def rule_of(error: AnnotatorError) -> Rule:
    """Returns the rule that a label file breaks which cannot be read."""
    return RULE_OF[error.kind] if isinstance(error, UnitError) else rules.BROKEN_LABEL


def report_sizes(sizes: SizeDoubts, findings: Findings, path: Path) -> None:
    if (problem := sizes.lengths.problem()) is not None:
        findings.add(rules.LENGTH_UNIT, path, problem)
    elif (problem := sizes.orders.problem()) is not None:
        findings.add(rules.SIZE_ORDER, path, problem)


def mirrored(box: OrientedBox, axis: int) -> OrientedBox:
    """Returns the mirror image of a box in the plane through the origin across an axis of its frame."""
    flip = np.ones(3)
    flip[axis] = -1
    # a box is its own mirror image along its width, which keeps the rotation proper
    return OrientedBox.from_parts(flip * box.center_m, flip[:, None] * box.rotation * [1.0, -1.0, 1.0], box.size_m)


CALIBRATION_FOLDERS, CALIBRATION_NAMES = ("calib", "extrinsics"), ("calib", "camera_", "intrinsics")
# With at least this many boxes, a fault of more than half of them is reported for the dataset.
LEAST_BOXES = 6

Progress = Callable[[int, int], None]


class DatasetFacts(Strict):
    path: str
    format: str
    frames: int
    labels: int


@dataclass
class DatasetCheck:
    """Checks one dataset; fields without a default are the arguments, the others are its state."""

    source: Source
    findings: Findings
    found: list[tuple[str, reading.FoundLabel]] = field(default_factory=list)
    alignment: Alignment = field(default_factory=Alignment)
    wrong_files: int = 0
    with_row: int = 0
    seen: int = 0
    flat: int = 0
    faults: Counter[Rule] = field(default_factory=Counter)
    before: tuple[tuple[str, int], Sequence[reading.FoundLabel]] | None = None
    time_ns: int | None = None
    mirrored: Counter[int] = field(default_factory=Counter)

    def run(self, progress: Progress | None) -> DatasetFacts:
        """Checks everything and adds what is wrong to `findings`.

        Args:
            progress: called with (frames checked, frames).
        """
        recording, source = self.source.recording, self.source
        keys, has_labels = recording.keys, source.has_labels
        still = StillWorld(recording)
        chosen = set(np.linspace(0, len(keys) - 1, min(len(keys), FRAMES)).astype(int).tolist())
        for index, key in enumerate(keys):
            frame = self._read(index, key)
            if frame is not None:
                self._frame(index, key, frame)
                still.add(index, frame)
                if index in chosen and source.has_pictures:
                    self.alignment.add(frame)
            if has_labels:
                self._labels(index, key, frame)
            if progress is not None:
                progress(index + 1, len(keys))
        try:
            for file, line, name in stray_names(recording):
                self.findings.add(rules.STRAY_FILE, file, f"there is no frame {name}", line=line, frame=name)
        except FormatError as error:  # a list that is not text
            self.findings.add_error(rules.UNREADABLE_FILE, error, recording.path)
        self._poses(still)
        self._whole_dataset()
        return DatasetFacts(path=str(recording.path), format=recording.format, frames=len(keys), labels=len(self.found))

    def _poses(self, still: StillWorld) -> None:
        path = self.source.recording.path
        report = survey_poses(self.source.recording)
        for rule, messages in (
            () if report is None else ((rules.POSE_GAP, report.gaps), (rules.POSE_JUMP, report.jumps))
        ):
            for message in messages:
                self.findings.add(rule, path, message)
        if (problem := still.problem()) is not None:
            self.findings.add(rules.STILL_WORLD_MOVES, path, problem)

    def _read(self, index: int, key: str) -> Frame | None:
        try:
            return self.source.recording.frame(index)
        except AnnotatorError as error:
            file = getattr(error, "path", self.source.recording.path)
            rule = rules.UNCLEAR_FILE if isinstance(error, UnclearError) else _rule_of_file(file)
            self.findings.add_error(rule, error, self.source.recording.path, frame=key)
        except Exception as error:
            # a bug of a reader in one frame must not stop the check of the others
            message = f"frame {key}: {type(error).__name__}: {error}; this is a bug of annotator's reader"
            self.findings.add(rules.UNREADABLE_FILE, self.source.recording.path, message, frame=key)
        return None

    def _frame(self, index: int, key: str, frame: Frame) -> None:
        file, recording = self.source.calibration(index), self.source.recording
        of_cloud = label_rules.cloud_rules(frame, of_depth_camera=recording.format == "sunrgbd_extracted")
        for rule, message in (*label_rules.camera_rules(frame.camera), *of_cloud):
            self.findings.add(rule, file, message, frame=key)
        try:
            if reading.has_masks(recording):
                reading.load_mask(recording, frame)
        except AnnotatorError as error:
            self.findings.add_error(rules.UNREADABLE_MASK, error, file, frame=key)
        if recording.is_sequence and frame.timestamp_ns is not None:
            if self.time_ns is not None and frame.timestamp_ns <= self.time_ns:
                earlier_s = (self.time_ns - frame.timestamp_ns) / 1e9
                message = f"frame {key} is {earlier_s:.3f} s earlier than the previous frame"
                self.findings.add(rules.TIME_BACKWARDS, recording.path, message, frame=key)
            self.time_ns = frame.timestamp_ns

    def _labels(self, index: int, key: str, frame: Frame | None) -> None:
        recording = self.source.recording
        file = reading.label_file(recording, key)
        if file is None or not file.exists():
            missing = recording.path if file is None else file
            self.findings.add(rules.MISSING_LABELS, missing, f"frame {key} has no label file", frame=key)
            self.wrong_files += 1
            return
        labels = (
            reading.found_labels(recording, index, frame)
            if reading.is_labelled(recording, key)
            else reading.FrameLabels()
        )
        for error, of in (*((each, None) for each in labels.of_file), *((each, key) for each in labels.faults)):
            self.findings.add_error(rule_of(error), error, recording.path, frame=of)
        # in two steps: the geometry of the second cannot handle implausible boxes
        self._add_all(key, labels.objects, label_rules.rules_of_labels(labels.objects))
        objects = [each for each in labels.objects if label_rules.is_plausible(each)]
        valid = [each for each in objects if each.state is not ReviewState.REJECTED]
        self._add_all(key, valid, label_rules.rules_among_labels(valid))
        if frame is not None:
            self.seen += len(objects)
            self.with_row += sum(each.row is not None for each in objects)
            in_frame = list(label_rules.rules_in_frame(frame, objects))
            empty = [objects[number].truth.box for rule, number, _ in in_frame if rule is rules.EMPTY_BOX]
            for axis, box in product(MIRRORED, empty):
                held = np.count_nonzero(contains(mirrored(box, axis), frame.cloud.xyz_m))
                self.mirrored[axis] += int(held >= label_rules.LEAST_POINTS)
            self._add_all(key, objects, in_frame)
            self._add_all(key, valid, self._since_before(index, valid))
        self.flat += sum(row.is_flat for row in labels.rows)
        self.found += [(key, each) for each in labels.objects]
        self.wrong_files += bool(labels.faults)

    def _add_all(self, key: str, labels: Sequence[reading.FoundLabel], breaches: Iterable[label_rules.Breach]) -> None:
        for rule, number, message in breaches:
            self.faults[rule] += 1
            self.findings.add(rule, labels[number].file, message, line=labels[number].line, frame=key)

    def _since_before(self, index: int, labels: Sequence[reading.FoundLabel]) -> Iterator[label_rules.Breach]:
        place = None
        with suppress(AnnotatorError):  # a broken file was reported when the frame was read
            place = self.source.place(index)
        before, self.before = self.before, None if place is None else (place, labels)
        if before is None or place is None or before[0] != (place[0], place[1] - 1):
            return
        truths, earlier = [each.truth for each in labels], [each.truth for each in before[1]]
        if self.source.recording.is_sequence or self.source.recording.format == "rcv":
            for number, message in label_rules.heading_jumps(
                truths, earlier, tracked_only=not self.source.recording.is_sequence
            ):
                yield rules.HEADING_JUMP, number, message
        classes = {truth.track_id: truth.label for truth in earlier}
        for number, truth in enumerate(truths):
            earlier_class = classes.get(truth.track_id, truth.label)
            if truth.track_id is not None and earlier_class != truth.label:
                message = f"track {truth.track_id} is a {truth.label} but was a {earlier_class} in the previous frame"
                yield rules.TRACK_CLASS, number, message

    def _whole_dataset(self) -> None:
        usual = label_rules.usual_sizes((each.truth.label, each.truth.box.size_m) for _, each in self.found)
        for key, each in self.found:
            self._add_all(key, [each], ((rules.ODD_SIZE, *odd) for odd in label_rules.odd_sizes([each.truth], usual)))
        path = self.source.recording.path
        self._units(path)
        for rule, message in self._together():
            self.findings.add(rule, path, message)
        dataset = self.source.dataset
        declared = None if dataset is None else dataset.manifest.counts.objects
        if declared is not None and declared != len(self.found) and not self.wrong_files:
            message = f"declares {amount(declared, 'object')}, but has {len(self.found)}"
            self.findings.add(rules.MANIFEST_MISMATCH, path / MANIFEST, message)
        problem = self.alignment.problem()
        if problem is not None:
            self.findings.add(rules.CALIBRATION_OFF, self.source.calibration(0), problem)

    def _together(self) -> Iterator[tuple[Rule, str]]:
        """Yields what all labels together show."""
        axis, number = max(self.mirrored.items(), key=lambda each: each[1], default=(0, 0))
        if number >= LEAST_MIRRORED and number * 2 > self.seen:
            hold = f"{number} of {amount(self.seen, 'box')} hold no points, but their mirror images do"
            how = f"with {MIRRORED[axis]} exchanged; the labels' axes are probably left-handed"
            yield rules.MIRRORED_BOXES, f"{hold}, {how}"
        if self.flat:
            flat = amount(self.flat, "row has", "rows have")
            yield rules.FLAT_LABEL, f"{flat} a 2D box and no 3D box, and are not used as labels"
        for names in _spellings({each.truth.label for _, each in self.found}):
            yield rules.CLASS_SPELLING, f"{' and '.join(names)} look like one class"
        empty, off_image = self.faults[rules.EMPTY_BOX], self.faults[rules.IMAGE_BOX_OFF]
        if self.seen >= LEAST_BOXES and empty * 2 > self.seen:
            advice = "check that labels, clouds and calibration belong together"
            yield rules.BOXES_OFF_CLOUD, f"{empty} of {self.seen} boxes contain no point; {advice}"
        if self.with_row >= LEAST_BOXES and off_image * 2 > self.with_row:
            off = f"{off_image} of {self.with_row} 2D boxes do not match their 3D boxes"
            yield rules.BOXES_OFF_IMAGE, f"{off}; check that the calibration is the right one"

    def _units(self, path: Path) -> None:
        """Adds what the numbers of all boxes together show."""
        angles, sizes = Angles(), SizeDoubts()
        for _, each in self.found:
            if each.row is not None:
                angles.radians(each.row.rotation_y, each.file, each.line)
            sizes.add(each.truth.label, each.truth.box.size_m)
        try:
            angles.require()
        except UnitError as error:
            self.findings.add_error(rules.ANGLE_UNIT, error, path)
        report_sizes(sizes, self.findings, path)


def _rule_of_file(file: Path) -> Rule:
    """Returns the rule that an unreadable file of a frame breaks."""
    if not file.exists():
        return rules.MISSING_FILE
    if file.parent.name in CALIBRATION_FOLDERS or file.name.startswith(CALIBRATION_NAMES):
        return rules.UNREADABLE_CALIBRATION
    return rules.UNREADABLE_FILE


def _spellings(names: set[str]) -> Iterator[list[str]]:
    """Returns the groups of class names that differ only in case, spaces, `-` or `_`."""
    groups: dict[str, list[str]] = {}
    for name in sorted(names):
        groups.setdefault(folded(name), []).append(name)
    return (group for group in groups.values() if len(group) > 1)


class DatasetReport(Strict):
    """The findings by file and line, and the number of each severity, and of each rule that was breached."""

    datasets: tuple[DatasetFacts, ...]
    findings: tuple[Finding, ...]
    counts: dict[Severity, int]
    by_rule: dict[str, int]


def check_datasets(path: Path, progress: Progress | None = None) -> DatasetReport:
    """Checks every dataset at or below a path.

    Args:
        progress: called with (frames checked, frames of this dataset).
    """
    findings, facts = Findings(), list[DatasetFacts]()
    for source in find_sources(path):
        if isinstance(source, Source):
            facts.append(DatasetCheck(source, findings).run(progress))
        elif isinstance(source, OtherSoftwareDataset):
            facts += _read_other_software(source, findings)
        else:
            findings.add_error(rules.UNREADABLE_DATASET, source[1], source[0])
    found = findings.all()
    counts = dict.fromkeys(Severity, 0) | Counter(each.severity for each in found)
    by_rule = dict(sorted(Counter(each.rule for each in found).items()))
    return DatasetReport(datasets=tuple(facts), findings=found, counts=counts, by_rule=by_rule)


def _read_other_software(dataset: OtherSoftwareDataset, findings: Findings) -> list[DatasetFacts]:
    """Reads a dataset of other software; returns no facts if a part of it cannot be read."""
    frames = labels = faults = 0
    sizes = SizeDoubts()

    def on_fault(fault: FormatError) -> None:
        nonlocal faults
        findings.add_error(rule_of(fault), fault, dataset.path)
        faults += 1

    for boxes in dataset.frames(on_fault):
        frames, labels = frames + 1, labels + len(boxes)
        for label, size_m in boxes:
            if size_m is not None:
                sizes.add(label, size_m)
    if faults:
        return []
    report_sizes(sizes, findings, dataset.path)
    findings.add(
        rules.UNCHECKED_DATASET,
        dataset.path,
        f"{dataset.layout.title}: read, but their boxes are not compared with clouds and images",
    )
    return [DatasetFacts(path=str(dataset.path), format=dataset.layout.title, frames=frames, labels=labels)]
