"""Key frames: a corrected box moves the unreviewed boxes of its track along, up to the next reviewed one on each side.

Towards a reviewed box, an unreviewed one changes as the interpolation between the two has changed: beside the corrected
box by nearly all of it, beside the reviewed one by nearly nothing. So boxes that were interpolated are interpolated
again, and those that were found keep what was found. Where no reviewed box follows, the boxes up to the end of the
track change like the corrected one, since what was followed from a wrong box is as wrong; but no further than up to the
first that is right already.

Where the boxes beside fit the corrected box better than the one before, only that one was wrong, and that side stays.
Shares are by the frames' times if these are recorded, else by their indices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from annotator.geometry.oriented_box import box_corners, same_box
from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel
from annotator.project.changes import Payload
from annotator.rcv.axes import with_axes_like
from annotator.tracking.link import MOTION_BOXES, predicted
from annotator.tracking.smooth import are_upright, between, nearest_change, relabelled, relabellings
from annotator.types import OrientedBox, ReviewState
from annotator.types.errors import RecordingError
from annotator.workflows.tracks.propose_boxes import Surroundings, changed_box
from annotator.workflows.tracks.timeline import Motion, OpenRecording, Timeline

MIN_SIZE_M = 0.01

Moved = list[tuple[StoredFrame, list[Payload]]]
"""Frames, and what changes in each."""


def moved_along(
    project: Project,
    frame: StoredFrame,
    stored: StoredLabel,
    now: OrientedBox,
    recordings: OpenRecording | None = None,
) -> Moved:
    """What the correction of a box changes in other frames.

    Args:
        frame: the box's frame.
        stored: the box before it was corrected.
    """
    was, track_id = stored.label.box, stored.label.track_id
    if track_id is None or stored.label.state is ReviewState.REJECTED or frame.index is None or same_box(was, now):
        return []
    if stored.still is not None or not project.recordings.get(frame.recording_id).is_sequence:
        return []
    along = project.labels.along(frame.recording_id, tracks=[track_id])
    along = tuple(each for each in along if each.label.state is not ReviewState.REJECTED)
    place = next(n for n, each in enumerate(along) if each.label.uid == stored.label.uid)
    sides = [_until_reviewed(side) for side in (along[:place][::-1], along[place + 1 :])]
    if not any(boxes for boxes, _ in sides):
        return []
    frames = {each.id: each for each in project.frames.of([frame.recording_id])}
    times, motion = _times(project, frame.recording_id, frames, recordings), Motion(project, frame.recording_id)
    there = Surroundings(project, [(frames[each.frame_id], each.label.box, track_id) for each in along])
    new: list[tuple[StoredFrame, StoredLabel, OrientedBox]] = []
    for boxes, end in sides:
        present = [
            each for each in boxes if each.frame_id in times and not there.is_finalised(frames[each.frame_id], each)
        ]
        if end is not None and end.frame_id not in times:
            continue
        # they are compared in the world, as the camera of the corrected box sees it
        beside = [
            (motion.moved(each.label.box, each.frame_id, frame.id), abs(times[each.frame_id] - times[frame.id]))
            for each in (*present, *([] if end is None else [end]))
        ]
        for each, change in zip(present, _changes(beside, end is not None, was, now), strict=False):
            new.append((frames[each.frame_id], each, corrected_alike(each.label.box, *change)))
    there = Surroundings(project, [(at, box, track_id) for at, _, box in new])
    return [(at, events) for at, each, box in new if (events := changed_box(there, at, each, box=box))]


def corrected_alike(box: OrientedBox, was: OrientedBox, now: OrientedBox) -> OrientedBox:
    """Changes a box as another one was changed: turned and moved alike in its own axes, its sides by as many metres.

    Args:
        was, now: the other box before and after.
    """
    turn = was.rotation.T @ now.rotation
    moved_m = was.rotation.T @ (now.center_m - was.center_m)
    turned = OrientedBox.from_parts(box.center_m + box.rotation @ moved_m, box.rotation @ turn, box.size_m)
    # a turn by 90 degrees makes the length the width
    own_m = with_axes_like(box, turned).size_m
    size_m = own_m + now.size_m - with_axes_like(was, now).size_m
    return OrientedBox.from_parts(turned.center_m, turned.rotation, np.maximum(size_m, MIN_SIZE_M))


def _until_reviewed(side: Sequence[StoredLabel]) -> tuple[list[StoredLabel], StoredLabel | None]:
    """The open boxes of a side, the nearest first, and the reviewed box where they end, if there is one."""
    ends = (n for n, each in enumerate(side) if each.label.state in REVIEWED)
    first = next(ends, None)
    return list(side[:first]), None if first is None else side[first]


def _times(
    project: Project, recording_id: int, frames: Mapping[int, StoredFrame], recordings: OpenRecording | None
) -> dict[int, float]:
    """The times of a recording's frames by their ids, in any unit, without those that are no longer in it."""
    try:
        timeline = Timeline(project, recording_id, recordings)
    except RecordingError:  # boxes can be corrected while its files are away
        return {id: float(frame.index) for id, frame in frames.items() if frame.index is not None}
    return {id: float(timeline.times[index]) for id, index in timeline.index.items()}


Change = tuple[OrientedBox, OrientedBox]


def _changes(side: Sequence[tuple[OrientedBox, float]], ends: bool, was: OrientedBox, now: OrientedBox) -> list[Change]:
    """The changes (before, after) that the boxes of a side are to follow, from the first on; empty if the side stays.

    Args:
        side: its boxes, and how far away in time they are.
        ends: whether the last one is reviewed, and stays.
    """
    beside, away = [box for box, _ in side], [time for _, time in side]
    if len(side) == ends:
        return []
    if not ends:
        return [(was, now)] * _alike(beside, away, was, now)
    # of a turn by 90 or 180 degrees: the part that is not shared, since half of it would be wrong everywhere
    turn = nearest_change(was, now, relabellings(are_upright([was, now])))
    before, after = (between(box, beside[-1], 0.0, away[-1], away[:-1]) for box in (relabelled(was, turn), now))
    before = [relabelled(box, turn.T) for box in before]
    stays = _apart(beside[0], after[0]) < _apart(beside[0], before[0])
    return [] if stays else list(zip(before, after, strict=True))


def _alike(beside: Sequence[OrientedBox], away: Sequence[float], was: OrientedBox, now: OrientedBox) -> int:
    """The number of boxes, from a corrected one on, that are wrong as it was: up to the first that is right already."""
    before, times = [was, *beside], [0.0, *away]
    for n, box in enumerate(beside):
        # of the first one, the boxes after it tell; of a later one, those before it
        near = slice(MOTION_BOXES, 0, -1) if n == 0 else slice(max(0, n + 1 - MOTION_BOXES), n + 1)
        expected = predicted(before[near], times[near], 0.0 if n == 0 else away[n])
        found, wrong, right = (expected, was, now) if n == 0 else (box, expected, corrected_alike(expected, was, now))
        if _apart(found, right) < _apart(found, wrong):
            return n
    return len(beside)


def _apart(one: OrientedBox, other: OrientedBox) -> float:
    """Mean distance of the corners, metres; a box that faces the other way is far away."""
    return float(np.linalg.norm(box_corners(one) - box_corners(other), axis=1).mean())
