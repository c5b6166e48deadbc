"""The check of one dataset, frame by frame, and then of all its frames together.

Frames are read one at a time, and one that cannot be read stops nothing. What grows with the dataset are the sizes of
its labels, for their medians.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.formats.rcv.export import MANIFEST
from annotator.types import Frame
from annotator.types.errors import AnnotatorError, FormatError
from annotator.workflows.checking import rules
from annotator.workflows.checking.alignment import FRAMES, Alignment
from annotator.workflows.checking.box_rules import heading_jumps, odd_size_message, usual_sizes
from annotator.workflows.checking.camera_rules import camera_rules, cloud_rules
from annotator.workflows.checking.findings import Findings
from annotator.workflows.checking.label_files import FoundLabel
from annotator.workflows.checking.label_rules import (
    Breach,
    is_in_this_world,
    rules_among_labels,
    rules_in_frame,
    rules_of_labels,
)
from annotator.workflows.checking.rules import Rule
from annotator.workflows.checking.sources import RecordingSource, Source
from annotator.workflows.checking.strays import stray_names
from annotator.workflows.truth import has_masks, load_mask

CALIBRATION_FOLDERS, CALIBRATION_NAMES = ("calib", "extrinsics"), ("calib", "camera_", "intrinsics")
# From so many boxes on, a fault of more than half of them is the dataset's.
LEAST_BOXES = 6

Progress = Callable[[int, int], None]


class DatasetFacts(BaseModel):
    """A dataset that was checked."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: str
    format: str
    frames: int
    labels: int


class _Sized(NamedTuple):
    """What is kept of a label until all are known."""

    label: str
    size_m: np.ndarray
    file: Path
    line: int | None
    frame: str


@dataclass
class DatasetCheck:
    """Checks one dataset; the fields without a default are what it needs, the others what it must remember."""

    source: Source
    findings: Findings
    sizes: list[_Sized] = field(default_factory=list)
    alignment: Alignment = field(default_factory=Alignment)
    wrong_files: int = 0
    with_row: int = 0
    seen: int = 0
    faults: Counter[Rule] = field(default_factory=Counter)
    before: tuple[tuple[str, int], Sequence[FoundLabel]] | None = None
    time_ns: int | None = None

    def run(self, progress: Progress | None) -> DatasetFacts:
        """Looks at everything; what is wrong goes to `findings`.

        Args:
            progress: called with (frames looked at, frames).
        """
        keys = self.source.keys
        chosen = set(np.linspace(0, len(keys) - 1, min(len(keys), FRAMES)).astype(int).tolist())
        for index, key in enumerate(keys):
            frame = self._read(index, key)
            if frame is not None:
                self._camera(index, key, frame)
                self._time(index, key, frame)
                if index in chosen and self.source.has_pictures:
                    self.alignment.add(frame)
            self._labels(index, key, frame)
            if progress is not None:
                progress(index + 1, len(keys))
        self._whole_files()
        self._whole_dataset()
        return DatasetFacts(
            path=str(self.source.path), format=self.source.format, frames=len(keys), labels=len(self.sizes)
        )

    def _read(self, index: int, key: str) -> Frame | None:
        try:
            return self.source.read(index)
        except AnnotatorError as error:
            file = getattr(error, "path", self.source.path)
            self.findings.add_error(_rule_of_file(file), error, self.source.path, frame=key)
        except Exception as error:
            # whatever is in one file, the others are still looked at
            message = f"frame {key}: {type(error).__name__}: {error}; this is a fault of annotator's reader"
            self.findings.add(rules.UNREADABLE_FILE, self.source.path, message, frame=key)
        return None

    def _camera(self, index: int, key: str, frame: Frame) -> None:
        file = self.source.calibration(index)
        for rule, message in camera_rules(frame.camera):
            self.findings.add(rule, file, message, frame=key)
        for rule, message in cloud_rules(frame, of_depth_camera=self.source.format == "sunrgbd_extracted"):
            self.findings.add(rule, file, message, frame=key)
        if isinstance(self.source, RecordingSource):
            try:
                if has_masks(self.source.recording):
                    load_mask(self.source.recording, frame)
            except AnnotatorError as error:
                self.findings.add_error(rules.UNREADABLE_MASK, error, file, frame=key)

    def _time(self, index: int, key: str, frame: Frame) -> None:
        if not self.source.in_time_order or frame.timestamp_ns is None:
            return
        if self.time_ns is not None and frame.timestamp_ns <= self.time_ns:
            message = f"frame {key} is {(self.time_ns - frame.timestamp_ns) / 1e9:.3f} s earlier than the one before"
            self.findings.add(rules.TIME_BACKWARDS, self.source.path, message, frame=key)
        self.time_ns = frame.timestamp_ns

    def _labels(self, index: int, key: str, frame: Frame | None) -> None:
        files = self.source.labels
        if files is None:
            return
        found = files.of(index, key, frame)
        if found.missing is not None:
            self.findings.add(rules.MISSING_LABELS, found.missing, f"frame {key} has no label file", frame=key)
        for error in found.problems:
            self.findings.add_error(rules.BROKEN_LABEL, error, self.source.path, frame=key)
        # two rounds: boxes that are no boxes would break the geometry of the second
        self._note(key, found.objects, rules_of_labels(found.objects))
        objects = [each for each in found.objects if is_in_this_world(each)]
        kept = [each for each in objects if not each.rejected]
        self._note(key, kept, rules_among_labels(kept))
        if frame is not None:
            self.seen += len(objects)
            self.with_row += sum(each.row is not None for each in objects)
            self._note(key, objects, rules_in_frame(frame, objects))
            self._note(key, kept, self._since_before(index, kept))
        self.sizes += [_Sized(e.truth.label, e.truth.box.size_m, e.file, e.line, key) for e in found.objects]
        self.wrong_files += bool(found.problems) or found.missing is not None

    def _note(self, key: str, labels: Sequence[FoundLabel], breaches: Iterable[Breach]) -> None:
        for rule, number, message in breaches:
            self.faults[rule] += 1
            self.findings.add(rule, labels[number].file, message, line=labels[number].line, frame=key)

    def _since_before(self, index: int, labels: Sequence[FoundLabel]) -> Iterator[Breach]:
        place = None
        with suppress(AnnotatorError):  # a frame's file that is broken was told
            place = self.source.place(index)
        before, self.before = self.before, None if place is None else (place, labels)
        if before is None or place is None or before[0] != (place[0], place[1] - 1):
            return
        truths, earlier = [each.truth for each in labels], [each.truth for each in before[1]]
        if self.source.in_time_order or self.source.format == "rcv":
            for number, message in heading_jumps(truths, earlier, tracked_only=not self.source.in_time_order):
                yield rules.HEADING_JUMP, number, message
        classes = {truth.track_id: truth.label for truth in earlier}
        for number, truth in enumerate(truths):
            known = classes.get(truth.track_id, truth.label)
            if truth.track_id is not None and known != truth.label:
                yield rules.TRACK_CLASS, number, f"track {truth.track_id} is a {truth.label} now and was a {known}"

    def _whole_files(self) -> None:
        files = self.source.labels
        for error in files.problems() if files is not None else ():
            self.findings.add_error(rules.BROKEN_LABEL, error, self.source.path)
        of_labels = files.strays() if files is not None else iter(())
        of_recording = stray_names(self.source.recording) if isinstance(self.source, RecordingSource) else iter(())
        for strays in (of_labels, of_recording):
            try:
                for file, line, name in strays:
                    self.findings.add(rules.STRAY_FILE, file, f"there is no frame {name}", line=line, frame=name)
            except FormatError as error:  # a list that is no text
                self.findings.add_error(rules.UNREADABLE_FILE, error, self.source.path)

    def _whole_dataset(self) -> None:
        usual = usual_sizes((each.label, each.size_m) for each in self.sizes)
        for each in self.sizes:
            if each.label in usual and usual[each.label].odd(each.size_m):
                message = odd_size_message(each.label, each.size_m, usual[each.label])
                self.findings.add(rules.ODD_SIZE, each.file, message, line=each.line, frame=each.frame)
        path = self.source.path
        for names in _spellings({each.label for each in self.sizes}):
            self.findings.add(rules.CLASS_SPELLING, path, f"{' and '.join(names)} look like one class")
        for rule, kind, among, message in (
            (
                rules.BOXES_OFF_CLOUD,
                rules.EMPTY_BOX,
                self.seen,
                "boxes hold no point; do labels, clouds and calibration belong together?",
            ),
            (
                rules.BOXES_OFF_IMAGE,
                rules.IMAGE_BOX_OFF,
                self.with_row,
                "2D boxes are off their 3D boxes; is it the right calibration?",
            ),
        ):
            if among >= LEAST_BOXES and self.faults[kind] * 2 > among:
                self.findings.add(rule, path, f"{self.faults[kind]} of {among} {message}")
        announced = self.source.announced
        if announced is not None and announced != len(self.sizes) and not self.wrong_files:
            message = f"says that there are {announced} objects, and there are {len(self.sizes)}"
            self.findings.add(rules.MANIFEST_MISMATCH, path / MANIFEST, message)
        problem = self.alignment.problem()
        if problem is not None:
            self.findings.add(rules.CALIBRATION_OFF, self.source.calibration(0), problem)


def _rule_of_file(file: Path) -> Rule:
    """What it means that a file of a frame cannot be read."""
    if not file.exists():
        return rules.MISSING_FILE
    if file.parent.name in CALIBRATION_FOLDERS or file.name.startswith(CALIBRATION_NAMES):
        return rules.UNREADABLE_CALIBRATION
    return rules.UNREADABLE_FILE


def _spellings(names: set[str]) -> Iterator[list[str]]:
    """Groups of class names that are one word, written in different ways."""
    groups: dict[str, list[str]] = {}
    for name in sorted(names):
        groups.setdefault("".join(c for c in name.casefold() if c not in " -_"), []).append(name)
    return (group for group in groups.values() if len(group) > 1)
