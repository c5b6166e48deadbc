"""Labels that look wrong: warnings for an operator to look at, never errors.

- size: a side of the box differs from the median of its class by more than is usual there
  (`checking.box_rules.UsualSize`; length and width may be exchanged), or from the median of its own track by more than
  is usual there; said once there are enough reviewed boxes;
- empty: fewer than `LEAST_POINTS` points of the cloud lie in the box;
- heading: from the frame before in a sequence, a box of the same track (else the nearest of its class within its own
  length) has turned by more than 60 degrees;
- duplicate: two boxes of one class overlap by `OVERLAP_IOU` or more (exact 3D IoU);
- track: a track has two boxes in one frame, or boxes of two classes;
- class: the project does not have the label's class (any more).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from pydantic import BaseModel, ConfigDict

from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel
from annotator.types import Label, OrientedBox, ReviewState
from annotator.workflows.checking.box_rules import (
    LEAST_POINTS,
    OVERLAP_IOU,
    TRACK_SIZE_FACTOR,
    UsualSize,
    few_points_message,
    heading_jumps,
    odd_size_message,
    odd_sizes,
    overlaps,
    usual_sizes,
)
from annotator.workflows.point_counts import PointCounts

LOOKED_AT = (*REVIEWED, ReviewState.PROPOSED)

CountPoints = Callable[[StoredFrame, Sequence[OrientedBox]], Sequence[int] | None]
"""How many points of a frame lie in each of some boxes; None where the frame cannot be read."""


class Kind(StrEnum):
    """What looks wrong."""

    SIZE = "size"
    EMPTY = "empty"
    HEADING = "heading"
    DUPLICATE = "duplicate"
    TRACK = "track"
    CLASS = "class"


@dataclass(frozen=True)
class Warned:
    """One warning.

    Attributes:
        kind: of what.
        frame: where.
        recording: name of the frame's recording.
        uid: the label.
        message: for a person.
    """

    kind: Kind
    frame: StoredFrame
    recording: str
    uid: str
    message: str


class WarningRow(BaseModel):
    """One warning as JSON: `frame` is an id, `recording` a name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Kind
    frame: int
    key: str
    recording: str
    uid: str
    message: str


class CheckReport(BaseModel):
    """All warnings.

    Attributes:
        labels: how many were looked at.
        unreadable: frames whose points could not be counted, as `key: reason`.
        uncounted: frames whose points were not counted because the time was up; the next look goes on.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    warnings: tuple[WarningRow, ...]
    labels: int
    unreadable: tuple[str, ...]
    uncounted: int


def check_project(project: Project, frame_id: int | None = None, budget_s: float | None = None) -> CheckReport:
    """As `check`, with the points counted from the recordings.

    Args:
        budget_s: how long frames may be read for; None = until all are counted.

    Raises:
        NotFoundError: no such frame.
    """
    counts = PointCounts(project, budget_s)
    warned = check(project, counts, frame_id)
    counts.save()
    rows = tuple(
        WarningRow(kind=w.kind, frame=w.frame.id, key=w.frame.key, recording=w.recording, uid=w.uid, message=w.message)
        for w in warned
    )
    looked_at = [e for e in project.labels.select(states=LOOKED_AT) if frame_id in (None, e.frame_id)]
    return CheckReport(
        warnings=rows, labels=len(looked_at), unreadable=tuple(counts.unreadable), uncounted=counts.unknown
    )


def check(project: Project, count_points: CountPoints, frame_id: int | None = None) -> list[Warned]:
    """All warnings about labels that are not rejected, frame by frame.

    Args:
        frame_id: of this frame only (compared with the whole project); None = of all.

    Raises:
        NotFoundError: no such frame.
    """
    if frame_id is not None:
        project.frames.get(frame_id)
    frames = {frame.id: frame for frame in project.frames.of()}
    recordings = {recording.id: recording for recording in project.recordings.all()}
    by_frame: dict[int, list[Label]] = defaultdict(list)
    stored = project.labels.select(states=LOOKED_AT)
    for entry in stored:
        by_frame[entry.frame_id].append(entry.label)
    usual = usual_sizes((e.label.label, e.label.box.size_m) for e in stored if e.label.state in REVIEWED)
    tracks = _Tracks(stored, frames)
    classes = set(project.config.classes)
    before = _frames_before(frames.values(), {r.id for r in recordings.values() if r.is_sequence})
    found: list[Warned] = []
    for frame in frames.values():
        labels = by_frame.get(frame.id, [])
        if not labels or (frame_id is not None and frame.id != frame_id):
            continue
        earlier = by_frame.get(before.get(frame.id, -1), [])
        lines = [
            *_class(labels, classes),
            *_sizes(labels, usual, tracks, frame),
            *_lines(Kind.HEADING, labels, heading_jumps(labels, earlier)),
            *_lines(Kind.DUPLICATE, labels, _duplicates(labels)),
            *tracks.odd(labels, frame),
            *_empty(labels, count_points(frame, [label.box for label in labels])),
        ]
        name = recordings[frame.recording_id].name
        found += [Warned(kind, frame, name, uid, message) for kind, uid, message in lines]
    return found


Line = tuple[Kind, str, str]


def _lines(kind: Kind, labels: Sequence[Label], places: Iterable[tuple[int, str]]) -> Iterator[Line]:
    """The findings of a rule about boxes, with the labels' uids."""
    return ((kind, labels[number].uid, message) for number, message in places)


class _Tracks:
    """What all boxes of each track have in common."""

    def __init__(self, stored: Sequence[StoredLabel], frames: Mapping[int, StoredFrame]) -> None:
        tracked = [(e.label, self.key(e.label, frames[e.frame_id])) for e in stored if e.label.track_id is not None]
        reviewed = ((key, label.box.size_m) for label, key in tracked if label.state in REVIEWED)
        self.usual = usual_sizes(reviewed, TRACK_SIZE_FACTOR)
        self._classes: dict[str, Counter[str]] = defaultdict(Counter)
        for label, key in tracked:
            self._classes[key][label.label] += 1

    def key(self, label: Label, frame: StoredFrame) -> str:
        """A track's name within the project."""
        return f"{frame.recording_id}/{label.track_id}"

    def odd(self, labels: Sequence[Label], frame: StoredFrame) -> Iterator[Line]:
        """Labels of a frame that cannot all be of their tracks."""
        seen: set[int] = set()
        for label in labels:
            if label.track_id is None:
                continue
            if label.track_id in seen:
                yield Kind.TRACK, label.uid, f"track {label.track_id} has two boxes in this frame"
            seen.add(label.track_id)
            most = self._classes[self.key(label, frame)].most_common(1)[0][0]
            if most != label.label:
                yield Kind.TRACK, label.uid, f"track {label.track_id} is {most} elsewhere, and {label.label} here"


def _sizes(
    labels: Sequence[Label], usual: Mapping[str, UsualSize], tracks: _Tracks, frame: StoredFrame
) -> Iterator[Line]:
    """Sizes that are odd for their class, else for their track."""
    of_class = dict(odd_sizes(labels, usual))
    for number, label in enumerate(labels):
        own = tracks.usual.get(tracks.key(label, frame))
        if number in of_class:
            yield Kind.SIZE, label.uid, of_class[number]
        elif own is not None and own.odd(label.box.size_m):
            name = f"track {label.track_id}: {label.label}"
            yield Kind.SIZE, label.uid, odd_size_message(name, label.box.size_m, own)


def _frames_before(frames: Iterable[StoredFrame], sequences: set[int]) -> dict[int, int]:
    """For each frame of a sequence the one before, by id."""
    places = {(f.recording_id, f.index): f.id for f in frames if f.index is not None}
    return {
        frame_id: places[recording, index - 1]
        for (recording, index), frame_id in places.items()
        if recording in sequences and (recording, index - 1) in places
    }


def _class(labels: Sequence[Label], classes: set[str]) -> Iterator[Line]:
    for label in labels:
        if label.label not in classes:
            yield Kind.CLASS, label.uid, f"the project has no class {label.label!r}"


def _duplicates(labels: Sequence[Label]) -> Iterator[tuple[int, str]]:
    for first, second, iou in overlaps(labels, OVERLAP_IOU):
        if labels[first].label == labels[second].label:
            yield second, f"two boxes of {labels[first].label} overlap by {iou:.0%} (IoU)"


def _empty(labels: Sequence[Label], points: Sequence[int] | None) -> Iterator[Line]:
    for label, count in zip(labels, points or (), strict=False):
        if count < LEAST_POINTS:
            yield Kind.EMPTY, label.uid, few_points_message(label.label, count)
