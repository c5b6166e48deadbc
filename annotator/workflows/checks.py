"""Labels that look wrong: warnings for an operator to look at, never errors.

- size: a side of the box differs from the median of its class by more than
  `SIZE_FACTOR` (length and width may be exchanged); said once there are `LEAST_FOR_MEDIAN` reviewed boxes;
- empty: fewer than `LEAST_POINTS` points of the cloud lie in the box;
- heading: from the frame before in a sequence, a box of the same track (else the nearest of its class within its own
  length) has turned by more than `HEADING_JUMP_RAD`;
- duplicate: two boxes of one class overlap by `DUPLICATE_IOU` or more (exact 3D IoU);
- class: the project does not have the label's class (any more).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.geometry.iou import iou_3d_matrix
from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel
from annotator.types import Label, OrientedBox, ReviewState
from annotator.workflows.point_counts import PointCounts

SIZE_FACTOR = 1.6
LEAST_FOR_MEDIAN = 5
LEAST_POINTS = 5
HEADING_JUMP_RAD = float(np.deg2rad(60))
DUPLICATE_IOU = 0.3
LOOKED_AT = (*REVIEWED, ReviewState.PROPOSED)

CountPoints = Callable[[StoredFrame, Sequence[OrientedBox]], Sequence[int] | None]
"""How many points of a frame lie in each of some boxes; None where the frame cannot be read."""


class Kind(StrEnum):
    """What looks wrong."""

    SIZE = "size"
    EMPTY = "empty"
    HEADING = "heading"
    DUPLICATE = "duplicate"
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
    medians = _medians(stored)
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
            *_size(labels, medians),
            *_heading(labels, earlier),
            *_duplicates(labels),
            *_empty(labels, count_points(frame, [label.box for label in labels])),
        ]
        name = recordings[frame.recording_id].name
        found += [Warned(kind, frame, name, uid, message) for kind, uid, message in lines]
    return found


Line = tuple[Kind, str, str]


def _medians(stored: Sequence[StoredLabel]) -> Mapping[object, np.ndarray]:
    """Median sizes of reviewed boxes, by class, where there are enough."""
    sizes: dict[object, list[np.ndarray]] = defaultdict(list)
    for entry in stored:
        if entry.label.state in REVIEWED:
            sizes[entry.label.label].append(entry.label.box.size_m)
    return {key: np.median(values, axis=0) for key, values in sizes.items() if len(values) >= LEAST_FOR_MEDIAN}


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


def _size(labels: Sequence[Label], medians: Mapping[object, np.ndarray]) -> Iterator[Line]:
    for label in labels:
        usual = medians.get(label.label)
        if usual is None:
            continue
        ratio = np.sort(label.box.size_m[:2]) / np.sort(usual[:2])
        ratio = np.append(ratio, label.box.size_m[2] / usual[2])
        if (np.abs(np.log(ratio)) > np.log(SIZE_FACTOR)).any():
            yield Kind.SIZE, label.uid, f"{label.label} of {_sides(label.box.size_m)}; the median is {_sides(usual)}"


def _sides(size_m: np.ndarray) -> str:
    return " x ".join(f"{side:.2f}" for side in size_m) + " m"


def _heading(labels: Sequence[Label], earlier: Sequence[Label]) -> Iterator[Line]:
    for label in labels:
        other = _predecessor(label, earlier)
        if other is None:
            continue
        cosine = float(np.clip(label.box.rotation[:, 0] @ other.box.rotation[:, 0], -1, 1))
        angle = float(np.arccos(cosine))
        if angle > HEADING_JUMP_RAD:
            message = f"{label.label} has turned by {np.rad2deg(angle):.0f} degrees since the frame before"
            yield Kind.HEADING, label.uid, message


def _predecessor(label: Label, earlier: Sequence[Label]) -> Label | None:
    same = [other for other in earlier if other.label == label.label]
    if label.track_id is not None:
        tracked = next((other for other in same if other.track_id == label.track_id), None)
        if tracked is not None:
            return tracked
    reach = float(label.box.size_m.max())
    near = [(float(np.linalg.norm(other.box.center_m - label.box.center_m)), n) for n, other in enumerate(same)]
    if not near or min(near)[0] > reach:
        return None
    nearest = same[min(near)[1]]
    # two known tracks that differ are two objects
    return nearest if nearest.track_id is None or label.track_id is None else None


def _duplicates(labels: Sequence[Label]) -> Iterator[Line]:
    for name in dict.fromkeys(label.label for label in labels):
        same = [label for label in labels if label.label == name]
        overlap = np.triu(iou_3d_matrix([a.box for a in same], [b.box for b in same]), 1)
        for first, second in np.argwhere(overlap >= DUPLICATE_IOU):
            message = f"two boxes of {name} overlap by {overlap[first, second]:.0%} (IoU)"
            yield Kind.DUPLICATE, same[second].uid, message


def _empty(labels: Sequence[Label], points: Sequence[int] | None) -> Iterator[Line]:
    for label, count in zip(labels, points or (), strict=False):
        if count < LEAST_POINTS:
            yield Kind.EMPTY, label.uid, f"{count} points lie in the box of this {label.label}"
