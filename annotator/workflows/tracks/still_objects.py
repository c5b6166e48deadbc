"""Objects that stand still: which tracks do, and which moments see them, by the clouds themselves.

A still object has one box in the world, which stands in each moment that sees it, as reviewed. A box of its track in a
moment is the exception there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Container, Iterator
from dataclasses import replace
from itertools import groupby
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import in_frustum
from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel
from annotator.project.changes import LabelDeleted, Origin, Payload, StillEnded, StillMade
from annotator.project.stills import Sighting, StillObject
from annotator.types import Frame, OrientedBox
from annotator.types.errors import ConfigError, NotFoundError, RecordingError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.propose_boxes import proposal_like
from annotator.workflows.tracks.steps import COVERED, FINALISED, Count, FrameId, OfSpan, Step, Track, is_rejected

# Boxes of a track are compared if they are at least so many frames apart: what moves slowly agrees with itself before.
LEAST_APART = 5
# A moment sees an object by so many points in its box, unless more than this share of its outline has nearer points.
LEAST_POINTS, MOST_HIDDEN = 2, 0.95
# 3D IoU from which two boxes are of an object at one place.
AGREE_IOU = 0.6


class StandStill(OfSpan):
    """The object stands still: its box in a frame becomes the one in the world, which all frames that see it show.

    Open proposals in other frames go, and so do reviewed boxes that agree with it (3D IoU `AGREE_IOU`); there it is
    seen in any case. Other boxes stay, as exceptions.

    Attributes:
        frame: id of the frame whose box is taken; None = the first one with a reviewed box.
    """

    do: Literal["still"] = "still"
    frame: FrameId | None = None

    def steps(self, track: Track) -> Iterator[Step]:
        boxes, T_camera_world = track.of_frames(), track.project.stills.poses(track.recording_id)
        if any(each.still is not None and not is_rejected(each) for _, each in boxes):
            raise ConfigError(f"{track.name} stands still already")
        frame, chosen = self._chosen(track, T_camera_world)
        box, made = chosen.label.box.transformed(T_camera_world[frame.id].inv()), StillMade(uid=chosen.label.uid)
        yield Step(frame, [made], Count(changed=1, reviewed=chosen.label.state in REVIEWED), made.still)
        there = track.around()
        for other, stored in boxes:
            if other.id == frame.id:
                continue
            is_reviewed, T = stored.label.state in REVIEWED, T_camera_world.get(other.id)
            agrees = T is not None and iou_3d(stored.label.box, box.transformed(T)) >= AGREE_IOU
            if is_rejected(stored) or (is_reviewed and not agrees):
                yield Step(other, (), COVERED)
            elif there.is_finalised(other, stored):
                yield Step(other, (), FINALISED)
            else:
                gone = [LabelDeleted(uid=stored.label.uid)]
                yield Step(other, gone, Count(deleted=1, reviewed=is_reviewed), made.still if is_reviewed else None)

    def _chosen(self, track: Track, posed: Container[int]) -> tuple[StoredFrame, StoredLabel]:
        if self.frame is None:
            which, there = "reviewed box", [pair for pair in track.boxes if pair[1].label.state in REVIEWED]
        else:
            which, there = "box in this frame", [pair for pair in track.boxes if pair[0].id == self.frame]
        if not there:
            raise ConfigError(f"{track.name} has no {which}")
        if (found := next((pair for pair in there if pair[0].id in posed), None)) is None:
            raise ConfigError(
                f"{track.name} cannot stand still: the recording does not say where its camera was; `annotator poses "
                "--estimate` finds it; or add it again if its files do"
            )
        return found


class Move(OfSpan):
    """The object moves: its one box in the world becomes a box of each frame that sees it.

    It stays reviewed in one frame, and in finalised ones; in the others it is a proposal, which the correction of the
    next box moves along.

    Attributes:
        frame: id of the frame in which it stays; None = the first one.
    """

    do: Literal["moving"] = "moving"
    frame: FrameId | None = None

    def steps(self, track: Track) -> Iterator[Step]:
        ones = [(frame, each) for frame, each in track.of_frames() if each.still is not None and not is_rejected(each)]
        if not ones:
            raise ConfigError(f"{track.name} does not stand still, or no frame was found that sees it")
        first = next((pair for pair in ones if self.frame in (None, pair[0].id)), None)
        if first is None:
            raise NotFoundError(f"{track.name} has no box in this frame")
        for frame, each in sorted(ones, key=lambda pair: pair[0].id != first[0].id):
            ended: list[Payload] = [StillEnded(uid=each.label.uid)] if frame.id == first[0].id else []
            new = proposal_like(each.label, each.label.box, track.track_id, origin=Origin.COPIED)
            if stays := bool(ended) or frame.finalised:
                new = replace(new, state=each.label.state, origin=None)
            yield Step(frame, [*ended, new], Count(changed=stays, proposed=not stays))


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
    index = (0 if near is None else project.frames.get(near).index) or 0
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
    around = in_frustum(frame.camera, xyz_m, outline)
    before = around & (xyz_m[:, 2] < box_corners(box)[:, 2].min())
    return int(np.count_nonzero(contains(box, xyz_m))), float(before.sum() / max(int(around.sum()), 1))


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
