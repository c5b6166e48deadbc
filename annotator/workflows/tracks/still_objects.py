"""Objects that stand still: which tracks do, and which moments see them, by the clouds themselves.

A still object has one box in the world, which stands in each moment that sees it, as reviewed. A box of its track in a
moment is the exception there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import groupby

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners, contains
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import in_frustum
from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel
from annotator.project.stills import Sighting, StillObject
from annotator.types import Frame, OrientedBox
from annotator.types.errors import RecordingError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.operations import AGREE_IOU

# Boxes of a track are compared if they are at least so many frames apart: what moves slowly agrees with itself before.
LEAST_APART = 5
# A moment sees an object by so many points in its box, unless more than this share of its outline has nearer points.
LEAST_POINTS, MOST_HIDDEN = 2, 0.95


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
