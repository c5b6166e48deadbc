"""Key frames: a corrected box moves the unreviewed boxes of its track along, and an operator carries it on.

Between a corrected box and the next reviewed one on each side, an unreviewed box changes as the interpolation between
these two has changed: beside the corrected box by nearly all of it, beside the reviewed one by nearly nothing. So boxes
that were interpolated are interpolated again, and those that were found keep what was found. Where the box beside is
nearer to the new interpolation than to the old one, only the corrected box was wrong, and that side stays. Shares are
by the frames' indices.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from annotator.geometry.oriented_box import box_corners, same_box
from annotator.project import REVIEWED, Effort, Project, StoredFrame, StoredLabel
from annotator.project.changes import Payload
from annotator.rcv.axes import with_axes_like
from annotator.tracking.smooth import are_upright, between, nearest_change, relabelled, relabellings
from annotator.types import OrientedBox, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.tracks.propose_boxes import Changed, changed_box, is_finalised, label_of, page_at, write

MIN_SIZE_M = 0.01

Moved = list[tuple[StoredFrame, list[Payload]]]
"""Frames, and what changes in each."""


def moved_along(project: Project, frame: StoredFrame, stored: StoredLabel, now: OrientedBox) -> Moved:
    """What the correction of a box changes in other frames, up to the next reviewed box of its track on each side.

    Args:
        frame: the box's frame.
        stored: the box before it was corrected.
    """
    was = stored.label.box
    if stored.label.track_id is None or stored.label.state is ReviewState.REJECTED or frame.index is None:
        return []
    if same_box(was, now) or stored.still is not None or not project.recordings.get(frame.recording_id).is_sequence:
        return []
    moved: Moved = []
    for boxes, end in _sides(project, frame, stored):
        if not boxes or end is None or end[0].index is None:
            continue
        away = [float(abs((each.index or 0) - frame.index)) for each, _ in boxes]
        whole = float(abs(end[0].index - frame.index))
        change = _relabelling(was, now)
        before, after = (between(box, end[1].label.box, 0.0, whole, away) for box in (relabelled(was, change), now))
        nearest = boxes[0][1].label.box
        if _apart(nearest, after[0]) < _apart(nearest, relabelled(before[0], change.T)):
            continue
        moved += _changed(project, boxes, [(relabelled(b, change.T), a) for b, a in zip(before, after, strict=True)])
    return moved


def carry_correction(
    project: Project,
    frame_id: int,
    uid: str,
    revision: int,
    was: OrientedBox,
    author: str,
    *,
    effort: Effort | None = None,
) -> Changed:
    """Changes the open proposals of a track after its last reviewed box as that one was changed."""
    page = page_at(project, frame_id, revision)
    frame, stored = page.frame, label_of(page, uid)
    label = stored.label
    if label.state not in REVIEWED:
        raise ConfigError("only a reviewed box says how the later ones are to be corrected; correct this one first")
    if label.track_id is None:
        raise ConfigError("the box belongs to no track; enter a track id, or follow it")
    if same_box(was, label.box):
        raise ConfigError("this box was not corrected, so there is nothing to do alike; correct it first")
    _, (boxes, end) = _sides(project, frame, stored)
    if end is not None:
        raise ConfigError(
            f"track {label.track_id} has a reviewed box in frame {end[0].key}: the boxes up to there have moved with "
            "the correction; those after it follow that box"
        )
    if not (changes := _changed(project, boxes, [(was, label.box)] * len(boxes))):
        raise ConfigError(f"track {label.track_id} has no later proposal to correct")
    return write(project, changes, author, effort)


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


At = tuple[StoredFrame, StoredLabel]


def _sides(project: Project, frame: StoredFrame, stored: StoredLabel) -> Iterator[tuple[list[At], At | None]]:
    """Yields the open proposals of a track before a box of it, the nearest first, and the reviewed box where they end,
    if there is one; then those after it. Those in finalised frames are left out."""
    track_id = stored.label.track_id
    assert track_id is not None
    along = [
        each
        for each in project.labels.along(frame.recording_id, tracks=[track_id])
        if each.label.state is not ReviewState.REJECTED
    ]
    place = next(n for n, each in enumerate(along) if each.label.uid == stored.label.uid)
    for side in (along[:place][::-1], along[place + 1 :]):
        boxes: list[At] = []
        end: At | None = None
        for each in side:
            at = project.frames.get(each.frame_id)
            if each.label.state in REVIEWED:
                end = at, each
                break
            if at.index is not None and not is_finalised(project, at, each):
                boxes.append((at, each))
        yield boxes, end


def _changed(project: Project, boxes: Sequence[At], changes: Sequence[tuple[OrientedBox, OrientedBox]]) -> Moved:
    """The boxes, each changed as another one (before, after)."""
    found = [
        (frame, changed_box(project, frame, each, box=corrected_alike(each.label.box, was, now)))
        for (frame, each), (was, now) in zip(boxes, changes, strict=True)
    ]
    return [(frame, events) for frame, events in found if events]


def _relabelling(was: OrientedBox, now: OrientedBox) -> np.ndarray:
    """Of a turn by 90 or 180 degrees: the part that is not shared, since half of it would be wrong everywhere."""
    return nearest_change(was, now, relabellings(are_upright([was, now])))


def _apart(one: OrientedBox, other: OrientedBox) -> float:
    """Mean distance of the corners, metres; a box that faces the other way is far away."""
    return float(np.linalg.norm(box_corners(one) - box_corners(other), axis=1).mean())
