"""Checks the labels of a project: warnings for the operator, never errors.

- size: a side of the box differs from the median of its class (or of its track) by more than the usual factor
  (`checking.label_rules.UsualSize`; length and width may be swapped); needs enough reviewed boxes;
- empty: fewer than `LEAST_POINTS` points of the cloud lie in the box;
- heading: a box has turned by more than 60 degrees since the previous frame of a sequence (matched by track, else the
  nearest box of its class within its own length);
- duplicate: two boxes of one class overlap by `OVERLAP_IOU` or more (exact 3D IoU);
- track: a track has two boxes in one frame, or boxes of two classes;
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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from enum import StrEnum

import numpy as np
from pydantic import TypeAdapter, ValidationError

from annotator.files import TABLE_BYTES, read_file, write_atomic
from annotator.geometry.oriented_box import contains
from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel
from annotator.project.classes.attributes import Attribute, AttributeOf, value_text
from annotator.types import Label, OrientedBox, ReviewState
from annotator.types.bases import Strict
from annotator.types.errors import FrameError, RecordingError
from annotator.types.label import AttributeValue
from annotator.types.messages import alternatives
from annotator.workflows.checking import label_rules
from annotator.workflows.frame_source import FrameSource, why_gone

# Within the project: data that can be recomputed.
CACHE = "cache/points_inside.json"
_COUNTS = TypeAdapter(dict[str, int])


class PointCounts:
    """Counts points, with a cache on disk, since reading the frames of a project takes minutes.

    Attributes:
        unreadable: frames that could not be read, as `key: reason`.
        unknown: number of frames left out because the time budget was used up.
    """

    def __init__(self, project: Project, budget_s: float | None = None) -> None:
        """
        Args:
            budget_s: time for reading frames, seconds; None = no limit.
        """
        self._source, self._path = FrameSource(project), project.path / CACHE
        self._left_s = math.inf if budget_s is None else budget_s
        self._cached = self._load()
        self._is_new = False
        self.unreadable: list[str] = []
        self.unknown = 0

    def __call__(self, frame: StoredFrame, boxes: Sequence[OrientedBox]) -> list[int] | None:
        """Returns the number of points of a frame in each box; None if it cannot be read or the time is used up."""
        keys = [_key(frame, box) for box in boxes]
        if any(key not in self._cached for key in keys):
            if self._left_s <= 0:
                self.unknown += 1
                return None
            begin = time.perf_counter()
            try:
                xyz_m = self._source.read(frame).cloud.xyz_m
            except (FrameError, RecordingError) as error:
                self.unreadable.append(f"{frame.key}: {error}")
                return None
            finally:
                self._left_s -= time.perf_counter() - begin
            counts = [int(np.count_nonzero(contains(box, xyz_m))) for box in boxes]
            self._cached |= dict(zip(keys, counts, strict=True))
            self._is_new = True
        return [self._cached[key] for key in keys]

    def save(self) -> None:
        """Saves the new counts. A cache that cannot be written is ignored: points are then counted again."""
        if self._is_new:
            with suppress(OSError):
                self._path.parent.mkdir(exist_ok=True)
                write_atomic(self._path, _COUNTS.dump_json(self._load() | self._cached))

    def _load(self) -> dict[str, int]:
        try:
            return _COUNTS.validate_json(read_file(self._path, TABLE_BYTES))
        except (OSError, ValidationError):
            # missing or damaged: counted again
            return {}


def _key(frame: StoredFrame, box: OrientedBox) -> str:
    content = box.pose.tobytes() + box.size_m.tobytes()
    return f"{frame.id}:{hashlib.sha256(content).hexdigest()[:16]}"


CHECKED_STATES = (*REVIEWED, ReviewState.PROPOSED)

CountPoints = Callable[[StoredFrame, Sequence[OrientedBox]], Sequence[int] | None]
"""Returns the number of points of a frame in each of some boxes; None if the frame cannot be read."""


class Kind(StrEnum):
    """The kind of a warning."""

    SIZE = "size"
    EMPTY = "empty"
    HEADING = "heading"
    DUPLICATE = "duplicate"
    TRACK = "track"
    CLASS = "class"
    ATTRIBUTE = "attribute"


class WarningRow(Strict):
    """One warning: `frame` is an id, `recording` a name; without `uid`, it is about the frame as a whole."""

    kind: Kind
    frame: int
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


def check_project(project: Project, frame_id: int | None = None, budget_s: float | None = None) -> CheckReport:
    """Checks a project as `check` does, with points counted from the recordings.

    Args:
        budget_s: time for reading frames, seconds; None = no limit.
    """
    counts = PointCounts(project, budget_s)
    warnings = check(project, counts, frame_id)
    counts.save()
    recordings = project.recordings.all() if frame_id is None else ()
    gone = (why_gone(each.path, each.name, project.path.name) for each in recordings)
    checked = [e for e in project.labels.select(states=CHECKED_STATES) if frame_id in (None, e.frame_id)]
    return CheckReport(
        warnings=tuple(warnings),
        labels=len(checked),
        unreadable=(*filter(None, gone), *counts.unreadable),
        uncounted=counts.unknown,
    )


def check(project: Project, count_points: CountPoints, frame_id: int | None = None) -> list[WarningRow]:
    """Returns all warnings about frames, and about labels that are not rejected, frame by frame.

    Args:
        frame_id: warnings of this frame only (compared with the whole project); None = of all.
    """
    if frame_id is not None:
        project.frames.get(frame_id)
    frames = {frame.id: frame for frame in project.frames.of()}
    recordings = {recording.id: recording for recording in project.recordings.all()}
    by_frame: dict[int, list[Label]] = defaultdict(list)
    stored = project.labels.select(states=CHECKED_STATES)
    for entry in stored:
        by_frame[entry.frame_id].append(entry.label)
    usual = label_rules.usual_sizes((e.label.label, e.label.box.size_m) for e in stored if e.label.state in REVIEWED)
    tracks = _Tracks(stored, frames)
    config = project.config
    classes, attributes, of_frames = set(config.classes), config.attributes, project.frames.attributes()
    before = _previous_frames(frames.values(), {r.id for r in recordings.values() if r.is_sequence})
    warnings: list[WarningRow] = []
    for frame in frames.values():
        labels, values = by_frame.get(frame.id, []), of_frames.get(frame.id, {})
        # nobody can complete a frame that its recording no longer has
        is_complete = bool(labels) or (frame.finalised and frame.index is not None)
        if not (is_complete or values) or (frame_id is not None and frame.id != frame_id):
            continue
        earlier = by_frame.get(before.get(frame.id, -1), [])
        lines = [
            *(
                (Kind.CLASS, each.uid, f"the project has no class {each.label!r}; {alternatives(each.label, classes)}")
                for each in labels
                if each.label not in classes
            ),
            *_lines(Kind.ATTRIBUTE, labels, label_rules.odd_values(labels, attributes)),
            *(
                (Kind.ATTRIBUTE, None, message)
                for message in label_rules.odd_frame_values(values, attributes, is_complete)
            ),
            *tracks.odd(labels, frame, attributes),
            *_sizes(labels, usual, tracks, frame),
            *_lines(Kind.HEADING, labels, label_rules.heading_jumps(labels, earlier)),
            *_lines(Kind.DUPLICATE, labels, _duplicates(labels)),
            *_empty(labels, count_points(frame, [label.box for label in labels]) if labels else None),
        ]
        place = {"frame": frame.id, "key": frame.key, "recording": recordings[frame.recording_id].name}
        warnings += [WarningRow(kind=kind, uid=uid, message=message, **place) for kind, uid, message in lines]
    return warnings


Line = tuple[Kind, str | None, str]


def _lines(kind: Kind, labels: Sequence[Label], places: Iterable[tuple[int, str]]) -> Iterator[Line]:
    """Returns the findings of a rule about boxes, with the labels' uids."""
    return ((kind, labels[number].uid, message) for number, message in places)


class _Tracks:
    """The usual size, the classes and the values of each track."""

    def __init__(self, stored: Sequence[StoredLabel], frames: Mapping[int, StoredFrame]) -> None:
        tracked = [(e.label, self.key(e.label, frames[e.frame_id])) for e in stored if e.label.track_id is not None]
        reviewed = ((key, label.box.size_m) for label, key in tracked if label.state in REVIEWED)
        self.usual = label_rules.usual_sizes(reviewed, label_rules.TRACK_SIZE_FACTOR)
        # by track, then by attribute; None: the class
        self._values = defaultdict[str, dict[str | None, Counter[AttributeValue]]](lambda: defaultdict(Counter))
        for label, key in tracked:
            for name, value in ((None, label.label), *label.attributes.items()):
                self._values[key][name][value] += 1

    def key(self, label: Label, frame: StoredFrame) -> str:
        """Returns a track's name within the project."""
        return f"{frame.recording_id}/{label.track_id}"

    def odd(self, labels: Sequence[Label], frame: StoredFrame, attributes: Sequence[Attribute]) -> Iterator[Line]:
        """Yields labels of a frame whose values or class differ from those of their track in other frames."""
        names = [each.name for each in attributes if each.of is AttributeOf.TRACK]
        for label in labels:
            if label.track_id is None:
                continue
            of_track = self._values[self.key(label, frame)]
            most = {name: counts.most_common(1)[0][0] for name, counts in of_track.items()}
            for name in names:
                value = label.attributes.get(name)
                if value is not None and value != most[name]:
                    here = f"{value_text(most[name])}, but {value_text(value)} here"
                    yield Kind.ATTRIBUTE, label.uid, f"{name} of track {label.track_id} is mostly {here}"
            if label.label != most[None]:
                yield Kind.TRACK, label.uid, f"track {label.track_id} is mostly {most[None]}, but {label.label} here"


def _sizes(
    labels: Sequence[Label], usual: Mapping[str, label_rules.UsualSize], tracks: _Tracks, frame: StoredFrame
) -> Iterator[Line]:
    """Yields sizes that are odd for their class, else for their track."""
    of_class = dict(label_rules.odd_sizes(labels, usual))
    for number, label in enumerate(labels):
        of_track = tracks.usual.get(tracks.key(label, frame))
        if number in of_class:
            yield Kind.SIZE, label.uid, of_class[number]
        elif of_track is not None and of_track.odd(label.box.size_m):
            name = f"track {label.track_id}: {label.label}"
            yield Kind.SIZE, label.uid, label_rules.odd_size_message(name, label.box.size_m, of_track)


def _previous_frames(frames: Iterable[StoredFrame], sequences: set[int]) -> dict[int, int]:
    """Returns the id of the previous frame for each frame of a sequence, by id."""
    places = {(f.recording_id, f.index): f.id for f in frames if f.index is not None}
    return {
        frame_id: places[recording, index - 1]
        for (recording, index), frame_id in places.items()
        if recording in sequences and (recording, index - 1) in places
    }


def _duplicates(labels: Sequence[Label]) -> Iterator[tuple[int, str]]:
    for first, second, iou in label_rules.overlaps(labels, label_rules.OVERLAP_IOU):
        if labels[first].label == labels[second].label:
            yield second, f"two boxes of {labels[first].label} overlap by {iou:.0%} (IoU)"


def _empty(labels: Sequence[Label], points: Sequence[int] | None) -> Iterator[Line]:
    for label, count in zip(labels, points or (), strict=False):
        if count < label_rules.LEAST_POINTS:
            yield Kind.EMPTY, label.uid, label_rules.few_points_message(label.label, count)
