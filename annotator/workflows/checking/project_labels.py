"""Checks the labels of a project: warnings for the operator, never errors.

- size: a side of the box differs from the median of its class (or of its track) by more than the usual factor
  (`checking.label_rules.UsualSize`; length and width may be swapped); needs enough reviewed boxes;
- empty: fewer than `LEAST_POINTS` points of the cloud lie in the box;
- heading: a box has turned by more than 60 degrees since the previous frame of a sequence (matched by track, else the
  nearest box of its class within its own length), or by more than 120 since the last box of its track; or its track
  moves against it in the world (`label_rules.moves_backwards`), where the recording has poses;
- duplicate: two boxes of one class overlap by `OVERLAP_IOU` or more (exact 3D IoU);
- track: a track has two boxes in one frame, or boxes of two classes; or it jumps in the world (`label_rules.jumps`);
- class: the project does not have the label's class;
- attribute: a required value is missing, a value does not fit its attribute, the project does not have its attribute,
  or a track has different values of one of its attributes. Values of a frame are checked, too; they must be complete
  once it has labels or is finalised.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from enum import StrEnum

import numpy as np
from pydantic import TypeAdapter, ValidationError

from annotator.files import TABLE_BYTES, read_file, write_atomic
from annotator.geometry.oriented_box import contains
from annotator.project import MOST_BESIDE, REVIEWED, Project, StoredFrame, StoredLabel
from annotator.project.classes.attributes import Attribute, AttributeOf, value_text
from annotator.types import Label, OrientedBox, ReviewState
from annotator.types.bases import Strict
from annotator.types.errors import FrameError, RecordingError
from annotator.types.label import AttributeValue
from annotator.types.messages import alternatives
from annotator.workflows.checking import label_rules
from annotator.workflows.checking.label_rules import BoxBreach
from annotator.workflows.frame_source import FrameSource, why_gone
from annotator.workflows.tracks.timeline import Motion

# Within the project: data that can be recomputed.
CACHE = "cache/points_inside.json"
_COUNTS = TypeAdapter(dict[str, int])


CHECKED_STATES = (*REVIEWED, ReviewState.PROPOSED)


class PointCounts:
    """Counts points, with a cache on disk, since reading the frames of a project takes minutes.

    Attributes:
        unreadable: frames that could not be read, as `key: reason`.
        unknown: number of frames left out because the time budget, seconds, was used up.
    """

    def __init__(self, project: Project, budget_s: float) -> None:
        self._source, self._path, self._left_s = FrameSource(project), project.path / CACHE, budget_s
        self._cached = self._load()
        self._new: dict[str, int] = {}
        self.unreadable: list[str] = []
        self.unknown = 0

    def __call__(self, frame: StoredFrame, boxes: Sequence[OrientedBox]) -> list[int]:
        """Returns the number of points of a frame in each box; none if it cannot be read or the time is used up."""
        contents = [hashlib.sha256(box.pose.tobytes() + box.size_m.tobytes()).hexdigest()[:16] for box in boxes]
        keys = [f"{frame.id}:{content}" for content in contents]
        if not self._cached.keys() >= set(keys):
            if self._left_s <= 0:
                self.unknown += 1
                return []
            begin = time.perf_counter()
            try:
                xyz_m = self._source.read(frame).cloud.xyz_m
            except (FrameError, RecordingError) as error:
                self.unreadable.append(f"{frame.key}: {error}")
                return []
            finally:
                self._left_s -= time.perf_counter() - begin
            counts = (int(np.count_nonzero(contains(box, xyz_m))) for box in boxes)
            counted = dict(zip(keys, counts, strict=True))
            self._new |= counted
            self._cached |= counted
        return [self._cached[key] for key in keys]

    def save(self) -> None:
        """Saves the new counts. A cache that cannot be written is ignored: points are then counted again."""
        if self._new:
            with suppress(OSError):
                self._path.parent.mkdir(exist_ok=True)
                write_atomic(self._path, _COUNTS.dump_json(self._load() | self._new))

    def _load(self) -> dict[str, int]:
        try:
            return _COUNTS.validate_json(read_file(self._path, TABLE_BYTES))
        except (OSError, ValidationError):
            # missing or damaged: counted again
            return {}


class Kind(StrEnum):
    SIZE = "size"
    EMPTY = "empty"
    HEADING = "heading"
    DUPLICATE = "duplicate"
    TRACK = "track"
    CLASS = "class"
    ATTRIBUTE = "attribute"


class WarningRow(Strict):
    """One warning: `frame` is an id, `recording` a name; without `uid`, it is about the frame as a whole.

    `number` is that of the frame on the page, from 1; None if its recording no longer has it.
    """

    kind: Kind
    frame: int
    number: int | None
    key: str
    recording: str
    uid: str | None
    message: str


class CheckReport(Strict):
    """All warnings.

    Attributes:
        labels: number of labels checked.
        unreadable: recordings that are missing, and frames whose points could not be counted, as `key: reason`.
        uncounted: frames whose points were not counted because the time was used up; the next check continues.
    """

    warnings: tuple[WarningRow, ...]
    labels: int
    unreadable: tuple[str, ...]
    uncounted: int


def check_project(project: Project, budget_s: float = math.inf) -> CheckReport:
    """Checks frames, and labels that are not rejected, frame by frame; points are counted in the recordings.

    Args:
        budget_s: time for reading frames, seconds.
    """
    count_points = PointCounts(project, budget_s)
    frames = {frame.id: frame for frame in project.frames.of()}
    recordings = {recording.id: recording for recording in project.recordings.all()}
    by_frame: dict[int, list[Label]] = defaultdict(list)
    stored = project.labels.select(states=CHECKED_STATES)
    for entry in stored:
        by_frame[entry.frame_id].append(entry.label)
    usual = label_rules.usual_sizes((e.label.label, e.label.box.size_m) for e in stored if e.label.state in REVIEWED)
    tracks = _Tracks(stored, frames)
    classes, attributes, of_frames = project.config.classes, project.config.attributes, project.frames.attributes()
    before = _previous_frames(frames.values(), {r.id for r in recordings.values() if r.is_sequence})
    last = defaultdict[int, dict[int, tuple[StoredFrame, Label]]](dict)  # of each recording's tracks
    motions = {id: Motion(project, id) for id in recordings}
    of_motion, warnings = _odd_motions(motions, stored, frames), list[WarningRow]()
    numbers = Counter[int]()
    for frame in frames.values():
        numbers[frame.recording_id] += 1
        labels, values = by_frame.get(frame.id, []), of_frames.get(frame.id, {})
        # nobody can complete a frame that its recording no longer has
        is_complete = bool(labels) or (frame.finalised and frame.index is not None)
        points = count_points(frame, [label.box for label in labels])
        of_tracks = last[frame.recording_id]
        is_timed = frame.index is not None and recordings[frame.recording_id].is_sequence
        motion, previous = motions[frame.recording_id], before.get(frame.id, -1)
        # as this frame's camera sees them
        earlier = [replace(each, box=motion.moved(each.box, previous, frame.id)) for each in by_frame.get(previous, [])]
        near = {
            id: replace(label, box=motion.moved(label.box, there.id, frame.id))
            for id, (there, label) in of_tracks.items()
            if (frame.index or 0) - (there.index or 0) <= MOST_BESIDE
        }
        rules: tuple[tuple[Kind, Iterable[tuple[int | None, str]]], ...] = (
            (Kind.CLASS, _unknown_classes(labels, classes)),
            (Kind.ATTRIBUTE, label_rules.odd_values(labels, attributes)),
            (Kind.ATTRIBUTE, ((None, m) for m in label_rules.odd_frame_values(values, attributes, is_complete))),
            (Kind.ATTRIBUTE, tracks.odd_values(labels, frame, attributes)),
            (Kind.TRACK, tracks.odd_classes(labels, frame)),
            (Kind.SIZE, tracks.odd_sizes(labels, frame, dict(label_rules.odd_sizes(labels, usual)))),
            (Kind.HEADING, label_rules.heading_jumps(labels, earlier, last=near)),
            *((kind, [(n, told)]) for n, each in enumerate(labels) for kind, told in of_motion.get(each.uid, ())),
            (Kind.DUPLICATE, _duplicates(labels)),
            (Kind.EMPTY, _empty(labels, points)),
        )
        warnings += [
            WarningRow(
                kind=kind,
                frame=frame.id,
                number=None if frame.index is None else numbers[frame.recording_id],
                key=frame.key,
                recording=recordings[frame.recording_id].name,
                uid=None if number is None else labels[number].uid,
                message=message,
            )
            for kind, breaches in rules
            for number, message in breaches
        ]
        if is_timed:
            of_tracks |= {each.track_id: (frame, each) for each in labels if each.track_id is not None}
    count_points.save()
    gone = (why_gone(each.path, each.name, project.path.name) for each in recordings.values())
    return CheckReport(
        warnings=tuple(warnings),
        labels=len(stored),
        unreadable=(*filter(None, gone), *count_points.unreadable),
        uncounted=count_points.unknown,
    )


def _odd_motions(
    motions: Mapping[int, Motion], stored: Sequence[StoredLabel], frames: Mapping[int, StoredFrame]
) -> dict[str, list[tuple[Kind, str]]]:
    """What is odd about how tracks move in the world, by the uid of the box where it begins."""
    tracks = defaultdict[tuple[int, int], list[tuple[int, StoredFrame, Label]]](list)
    for each in stored:
        frame = frames[each.frame_id]
        if each.label.track_id is not None and frame.index is not None:
            tracks[frame.recording_id, each.label.track_id].append((frame.index, frame, each.label))
    found = defaultdict[str, list[tuple[Kind, str]]](list)
    for (recording, number), ones in tracks.items():
        motion = motions[recording]
        if not motion.is_known:
            continue
        ones = sorted(ones, key=lambda one: one[0])
        boxes = [motion.moved(label.box, frame.id, ones[0][1].id) for _, frame, label in ones]
        for at, far_m in label_rules.moves_backwards(boxes):
            told = f"track {number} moves {far_m:.1f} m against its heading from here on"
            found[ones[at][2].uid].append((Kind.HEADING, told))
        for at, far_m in label_rules.jumps(boxes, [place for place, _, _ in ones]):
            told = f"track {number} jumps by {far_m:.1f} m since frame {ones[at - 1][1].key}"
            found[ones[at][2].uid].append((Kind.TRACK, told))
    return found


class _Tracks:
    """The usual size, the classes and the values of each track."""

    def __init__(self, stored: Sequence[StoredLabel], frames: Mapping[int, StoredFrame]) -> None:
        tracked = [(e.label, _track(e.label, frames[e.frame_id])) for e in stored if e.label.track_id is not None]
        reviewed = ((key, label.box.size_m) for label, key in tracked if label.state in REVIEWED)
        self._usual = label_rules.usual_sizes(reviewed, label_rules.TRACK_SIZE_FACTOR)
        # by track, then by attribute; None: the class
        self._values = defaultdict[str, dict[str | None, Counter[AttributeValue]]](lambda: defaultdict(Counter))
        for label, key in tracked:
            for name, value in ((None, label.label), *label.attributes.items()):
                self._values[key][name][value] += 1

    def odd_values(
        self, labels: Sequence[Label], frame: StoredFrame, attributes: Sequence[Attribute]
    ) -> Iterator[BoxBreach]:
        """Yields labels of a frame whose values differ from those of their track in other frames."""
        for name in (each.name for each in attributes if each.of is AttributeOf.TRACK):
            for number, label, most in self._others(labels, frame, name):
                value = label.attributes.get(name)
                if value is not None and value != most:
                    here = f"{value_text(most)}, but {value_text(value)} here"
                    yield number, f"{name} of track {label.track_id} is mostly {here}"

    def odd_classes(self, labels: Sequence[Label], frame: StoredFrame) -> Iterator[BoxBreach]:
        for number, label, most in self._others(labels, frame, None):
            if label.label != most:
                yield number, f"track {label.track_id} is mostly {most}, but {label.label} here"

    def odd_sizes(
        self, labels: Sequence[Label], frame: StoredFrame, of_class: Mapping[int, str]
    ) -> Iterator[BoxBreach]:
        """Yields sizes that are odd for their class (`of_class` has the messages), else for their track."""
        for number, label in enumerate(labels):
            of_track = self._usual.get(_track(label, frame))
            if number in of_class:
                yield number, of_class[number]
            elif of_track is not None and of_track.odd(label.box.size_m):
                name = f"track {label.track_id}: {label.label}"
                yield number, label_rules.odd_size_message(name, label.box.size_m, of_track)

    def _others(
        self, labels: Sequence[Label], frame: StoredFrame, name: str | None
    ) -> Iterator[tuple[int, Label, AttributeValue]]:
        """Yields the labels whose tracks have a value, with the value that occurs most."""
        for number, label in enumerate(labels):
            counts = self._values.get(_track(label, frame), {}).get(name)
            if counts:
                yield number, label, counts.most_common(1)[0][0]


def _track(label: Label, frame: StoredFrame) -> str:
    """Returns the name of a label's track within the project."""
    return f"{frame.recording_id}/{label.track_id}"


def _previous_frames(frames: Iterable[StoredFrame], sequences: set[int]) -> dict[int, int]:
    """Returns the id of the previous frame for each frame of a sequence, by id."""
    places = {(f.recording_id, f.index): f.id for f in frames if f.index is not None}
    return {
        frame_id: places[recording, index - 1]
        for (recording, index), frame_id in places.items()
        if recording in sequences and (recording, index - 1) in places
    }


def _unknown_classes(labels: Sequence[Label], classes: Sequence[str]) -> Iterator[BoxBreach]:
    for number, each in enumerate(labels):
        if each.label not in classes:
            yield number, f"the project has no class {each.label!r}; {alternatives(each.label, classes)}"


def _duplicates(labels: Sequence[Label]) -> Iterator[BoxBreach]:
    for first, second, iou in label_rules.overlaps(labels, label_rules.OVERLAP_IOU):
        if labels[first].label == labels[second].label:
            yield second, f"two boxes of {labels[first].label} overlap by {iou:.0%} (IoU)"


def _empty(labels: Sequence[Label], points: Sequence[int]) -> Iterator[BoxBreach]:
    """`points` is empty where they could not be counted."""
    for number, count in enumerate(points):
        if count < label_rules.LEAST_POINTS:
            yield number, label_rules.few_points_message(labels[number].label, count)
