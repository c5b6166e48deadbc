"""Objects that stand still: which tracks do, and which moments see them, by the clouds themselves.

A still object has one box in the world, which stands in each moment that sees it, as reviewed. A box of its track in a
moment is the exception there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import in_frustum
from annotator.project import REVIEWED, Effort, FramePart, Project, StoredFrame, StoredLabel, WriteContext
from annotator.project.changes import LabelDeleted, Origin, Payload, StillEnded, StillMade
from annotator.project.stills import Sighting, StillObject
from annotator.types import Frame, OrientedBox, ReviewState
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, NotFoundError, RecordingError, StaleRevisionError
from annotator.types.messages import amount
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.propose_boxes import proposal_like

# 3D IoU from which two boxes are of an object at one place.
AGREE_IOU = 0.6
# Boxes of a track are compared if they are at least so many frames apart: what moves slowly agrees with itself before.
LEAST_APART = 5
# A moment sees an object by so many points in its box, unless more than this share of its outline has nearer points.
LEAST_POINTS, MOST_HIDDEN = 2, 0.95


class StillCount(Strict):
    """What a change of a track's motion does to its boxes in other frames.

    Attributes:
        replaced: reviewed ones that agree with the box in the world.
        dropped: open proposals.
        exceptions: boxes that stay, since they disagree, were rejected, or are in finalised frames.
        made: boxes that frames get which have seen the object.
    """

    replaced: int = 0
    dropped: int = 0
    exceptions: int = 0
    made: int = 0

    def words(self) -> str:
        """Such as "replaces 3 reviewed boxes and 20 proposals; 1 box stays as an exception"."""
        if self.made:
            return f"makes {amount(self.made, 'box')}, open but for that of the frame"
        gone = f"replaces {amount(self.replaced, 'other reviewed box')} and {amount(self.dropped, 'proposal')}"
        return gone + (f"; unchanged: {self.exceptions}, which stay as exceptions" if self.exceptions else "")


def make_still(
    project: Project,
    recording_id: int,
    track_id: int,
    author: str,
    *,
    frame_id: int | None = None,
    dry_run: bool = False,
    effort: Effort | None = None,
) -> StillCount:
    """Says that a track stands still, as one action: its box in a frame becomes the one in the world.

    Open proposals in other frames go, and so do reviewed boxes that agree with it (3D IoU `AGREE_IOU`); there it is
    seen in any case. Other boxes stay, as exceptions.

    Args:
        frame_id: the frame whose box is taken, in the recording; None = the first one with a reviewed box.
        dry_run: only count.

    Raises:
        ConfigError: the track stands still already, has no such box, or the frame has no pose.
    """
    boxes, name = _boxes(project, recording_id, track_id)
    if any(each.still is not None for _, each in boxes):
        raise ConfigError(f"{name} stands still already")
    T_camera_world = project.stills.poses(recording_id)
    chosen = _chosen(boxes, T_camera_world, frame_id, name)
    box = chosen[1].label.box.transformed(T_camera_world[chosen[0].id].inv())
    events: dict[StoredFrame, list[Payload]] = {chosen[0]: [made := StillMade(uid=chosen[1].label.uid)]}
    seen, count = [chosen[0]], defaultdict[str, int](int)
    finalised = {frame.id for frame in project.frames.of() if frame.finalised}
    for frame, stored in boxes:
        if frame.id == chosen[0].id:
            continue
        state, T = stored.label.state, T_camera_world.get(frame.id)
        agrees = T is not None and iou_3d(stored.label.box, box.transformed(T)) >= AGREE_IOU
        goes = state is ReviewState.PROPOSED or (state in REVIEWED and agrees)
        if not goes or {frame.id, stored.made_in} & finalised:
            count["exceptions"] += 1
            continue
        events[frame] = [LabelDeleted(uid=stored.label.uid)]
        count["replaced" if state in REVIEWED else "dropped"] += 1
        seen += [frame] if state in REVIEWED else []
    if not dry_run:
        _write(
            project,
            name,
            events,
            author,
            effort,
            [Sighting(made.still, each.id, each.moment_id, True) for each in seen],
        )
    return StillCount(**count)


def make_moving(
    project: Project,
    recording_id: int,
    track_id: int,
    author: str,
    *,
    frame_id: int | None = None,
    dry_run: bool = False,
    effort: Effort | None = None,
) -> StillCount:
    """Says that a track moves, as one action. Its box stays reviewed in one frame, and in finalised ones; in the others
    that have seen it, it is a proposal, which the correction of the next box moves along.

    Args:
        frame_id: the frame in which it stays; None = the first one.
        dry_run: only count.
    """
    boxes, name = _boxes(project, recording_id, track_id)
    ones = [(frame, each) for frame, each in boxes if each.still is not None]
    if not ones:
        raise ConfigError(f"{name} does not stand still, or no frame was found that sees it")
    first = next((pair for pair in ones if pair[0].id == frame_id), None if frame_id is not None else ones[0])
    if first is None:
        raise NotFoundError(f"{name} has no box in this frame")
    events: dict[StoredFrame, list[Payload]] = {first[0]: [StillEnded(uid=first[1].label.uid)]}
    for frame, each in ones:
        new = proposal_like(each.label, each.label.box, track_id, origin=Origin.COPIED)
        if frame.id == first[0].id or frame.finalised:
            new = replace(new, state=each.label.state, origin=None)
        events.setdefault(frame, []).append(new)
    if not dry_run:
        _write(project, name, events, author, effort)
    return StillCount(made=len(ones))


def _write(
    project: Project,
    name: str,
    events: dict[StoredFrame, list[Payload]],
    author: str,
    effort: Effort | None,
    seen: Sequence[Sighting] = (),
) -> None:
    parts: list[FramePart] = []
    for frame, payloads in events.items():
        context = WriteContext(frame.revision, author, effort=None if parts else effort)
        parts.append(FramePart(frame.id, payloads, context))
    try:
        project.stills.change(parts, seen)
    except StaleRevisionError as error:
        raise ConfigError(f"{name} is being changed by others; try again") from error


Box = tuple[StoredFrame, StoredLabel]


def _boxes(project: Project, recording_id: int, track_id: int) -> tuple[list[Box], str]:
    """The boxes of a track as a recording sees them, rejected ones included, and its name."""
    frames = {frame.id: frame for frame in project.frames.of([recording_id])}
    along = project.labels.along(recording_id, tracks=[track_id])
    return [
        (frames[each.frame_id], each) for each in along
    ], f"track {track_id} of {project.recordings.get(recording_id).name}"


def _chosen(boxes: list[Box], posed: Mapping[int, RigidTransform], frame_id: int | None, name: str) -> Box:
    there = [pair for pair in boxes if pair[1].label.state is not ReviewState.REJECTED]
    if frame_id is None:
        there = [pair for pair in there if pair[1].label.state in REVIEWED]
    else:
        there = [pair for pair in there if pair[0].id == frame_id]
    if not there:
        raise ConfigError(f"{name} has no {'reviewed box' if frame_id is None else 'box in this frame'}")
    if (found := next((pair for pair in there if pair[0].id in posed), None)) is None:
        raise ConfigError(
            f"{name} cannot stand still: the recording does not say where its camera was; add it again if its files do"
        )
    return found


# --- which moments see it ---------------------------------------------------------------------------------------------


def find_sightings(
    project: Project,
    recording_id: int,
    *,
    near: int | None = None,
    progress: Callable[[int, int], object] = lambda *_: None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> int:
    """Looks for the still objects of a recording's rig where that was not done; returns in how many moments it looked.

    What is found is kept moment by moment, so a stopped run goes on where it was.

    Args:
        near: id of a frame; the moments around it are first.
        progress: called with (moments done, moments).
    """
    left = project.stills.unsighted(recording_id)
    index = next((frame.index for frame in left if frame.id == near), 0) or 0
    ordered = sorted(left, key=lambda frame: (abs((frame.index or 0) - index), frame.moment_id, frame.id))
    moments = [list(group) for _, group in groupby(ordered, key=lambda frame: frame.moment_id)]
    source, poses, done = FrameSource(project), dict[int, dict[int, RigidTransform]](), 0
    progress(0, len(moments))
    for done, moment in enumerate(moments, 1):
        if is_stopped():
            return done - 1
        objects = left[moment[0]]
        found = dict[str, Sighting]()
        for frame in moment:
            if frame.recording_id not in poses:
                poses[frame.recording_id] = project.stills.poses(frame.recording_id)
            wanted = [each for each in objects if each.uid not in found or not found[each.uid].is_seen]
            T_camera_world = poses[frame.recording_id][frame.id]
            found |= {each.still: each for each in _seen(source, frame, T_camera_world, wanted)}
        project.stills.keep(list(found.values()))
        progress(done, len(moments))
    return done


def _seen(
    source: FrameSource, frame: StoredFrame, T_camera_world: RigidTransform, objects: list[StillObject]
) -> Iterator[Sighting]:
    """Yields what a frame sees of objects; its files are read only if one is in front of the camera."""
    boxes = [(each, each.box.transformed(T_camera_world)) for each in objects]
    ahead = {each.uid for each, box in boxes if (box_corners(box)[:, 2] > 0).any()}
    try:
        opened = source.read(frame) if ahead else None
    except RecordingError:
        return  # looked for again once it can be read
    for each, box in boxes:
        points, hidden = visible(opened, box) if opened is not None and each.uid in ahead else (0, 0.0)
        is_seen = points >= LEAST_POINTS and hidden <= MOST_HIDDEN
        yield Sighting(each.uid, frame.id, frame.moment_id, is_seen, points, hidden, each.place)


def visible(frame: Frame, box: OrientedBox) -> tuple[int, float]:
    """Returns how many points of a frame are in a box (camera frame) that its image shows; and of the points in its
    outline on the image, the share before it: what they are of hides it.
    """
    xyz_m, outline = frame.cloud.xyz_m, box_on_image(frame.camera, box, "")
    if outline is None:
        return 0, 0.0
    inside = contains(box, xyz_m)
    before = in_frustum(frame.camera, xyz_m, outline) & ~inside & (xyz_m[:, 2] < box_corners(box)[:, 2].min())
    around = in_frustum(frame.camera, xyz_m, outline)
    return int(np.count_nonzero(inside)), float(before.sum() / max(int(around.sum()), 1))


# --- which tracks stand still -----------------------------------------------------------------------------------------


def candidates(project: Project, recording_id: int) -> dict[int, str]:
    """The tracks that probably stand still, and have not been said to, with the reason in words.

    Either their class does, or their first and their last reviewed box, at least `LEAST_APART` frames apart, agree in
    the world.
    """
    T_camera_world, styles = project.stills.poses(recording_id), project.config.class_styles
    frames = {frame.id: frame for frame in project.frames.of([recording_id])}
    boxes, found = defaultdict[int, list[StoredLabel]](list), dict[int, str]()
    for each in project.labels.along(recording_id, states=REVIEWED):
        if each.label.track_id is not None and each.frame_id in T_camera_world:
            boxes[each.label.track_id].append(each)
    for track_id, ones in sorted(boxes.items()):
        if any(each.still is not None for each in ones):
            continue
        first, last = ones[0], ones[-1]
        apart = (frames[last.frame_id].index or 0) - (frames[first.frame_id].index or 0)
        if (style := styles.get(first.label.label)) is not None and style.still is not None:
            found |= {track_id: f"{first.label.label} stands still"} if style.still else {}
        elif apart >= LEAST_APART:
            T = T_camera_world[last.frame_id] * T_camera_world[first.frame_id].inv()
            iou = iou_3d(first.label.box.transformed(T), last.label.box)
            found |= {track_id: f"its boxes, {apart} frames apart, agree ({iou:.2f})"} if iou >= AGREE_IOU else {}
    return found
