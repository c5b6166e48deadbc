"""Interpolates the boxes of a track between its key frames.

Boxes carried over from other frames can be fitted to the points of the new frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from annotator.geometry.iou import iou_3d
from annotator.project import REVIEWED, Effort, Project, StoredFrame
from annotator.project.changes import Payload
from annotator.tracking.smooth import between
from annotator.types import Label, OrientedBox
from annotator.types.errors import ConfigError, NotFoundError
from annotator.types.label import MOST_TRACK
from annotator.workflows.tracks.propose_boxes import Changed, label_of, page_at, proposal_events, proposal_like, write
from annotator.workflows.tracks.timeline import KeyFrame, Timeline
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import ReadyDetector
from annotator.workflows.workbench.refit import refit

# 3D IoU of the fitted with the given box below which the fit is rejected: it has found another object, or a part.
MIN_IOU = 0.4

FitBox = Callable[[StoredFrame, OrientedBox, Label], OrientedBox]
"""(frame, box, label of the object in another frame) -> the box fitted to the frame's points.

The given box if the fit is rejected, or if the detector measures another kind of box than the label's.
"""


def box_fitter(
    project: Project, open_frame: Callable[[StoredFrame], OpenFrame], detector: ReadyDetector | None
) -> FitBox:
    """Returns a function that fits boxes with `refit`.

    Args:
        open_frame: returns a frame; its errors are passed on.
        detector: for pseudo-views; without one the sides move to the points inside.
    """

    def fit(frame: StoredFrame, box: OrientedBox, label: Label) -> OrientedBox:
        opened = open_frame(frame)
        config = frame_config(project, opened.frame, detector, label.box_kind)
        if detector is not None and config.box_kind is not label.box_kind:
            return box
        fitted = refit(opened, box, label.label, config, detector).box or box
        return fitted if iou_3d(fitted, box) >= MIN_IOU else box

    return fit


@dataclass(frozen=True)
class Interpolated:
    """The result of an interpolation.

    Attributes:
        finalised: number of frames not changed because they are finalised.
        covered: number of frames not changed because they have a reviewed or rejected box of this object.
    """

    filled: Changed
    finalised: int
    covered: int


def interpolate(
    project: Project,
    recording_id: int,
    track_id: int,
    author: str,
    *,
    first: str | None = None,
    last: str | None = None,
    fit: FitBox | None = None,
) -> Interpolated:
    """Proposes boxes of a track in the frames between its key frames, as one action.

    Centre, size and rotation are interpolated by the frames' times if they are recorded, else by their indices.
    Reviewed and rejected labels stay; unreviewed proposals of the same object are replaced.

    Args:
        first, last: keys of two key frames, the earlier one first; None = the first or the last key frame.
        fit: fits each new box to its frame's points.
    """
    if abs(track_id) > MOST_TRACK:
        raise ConfigError(f"track ids are at most {MOST_TRACK}, not {track_id:.6g}; give the id of a track")
    timeline = Timeline(project, recording_id)
    return _filled(timeline, _chosen(timeline, track_id, first, last), track_id, author, fit)


def _filled(
    timeline: Timeline,
    keys: Sequence[KeyFrame],
    track_id: int,
    author: str,
    fit: FitBox | None,
    effort: Effort | None = None,
) -> Interpolated:
    project, frames, times = timeline.project, timeline.frames, timeline.times.tolist()
    changes: list[tuple[StoredFrame, list[Payload]]] = []
    finalised = covered = 0
    for before, after in pairwise(keys):
        inside = range(before.index + 1, after.index)
        ends = (times[before.index], times[after.index])
        boxes = between(before.label.box, after.label.box, *ends, [times[index] for index in inside])
        for index, box in zip(inside, boxes, strict=True):
            frame, label = frames[index], before.label
            if frame.finalised:
                finalised += 1
                continue
            fitted = box if fit is None else fit(frame, box, label)
            # the values of the key frame that is nearer in time
            is_later = times[index] - ends[0] > ends[1] - times[index] and after.label.label == label.label
            values = after.label.attributes if is_later else label.attributes
            events = proposal_events(project, frame, [proposal_like(label, fitted, track_id, attributes=values)])
            covered += not events
            if events:
                changes.append((frame, events))
    if not changes:
        why = f" ({finalised} finalised, {covered} reviewed or rejected)" if finalised or covered else ""
        raise ConfigError(f"there is no frame to fill between the key frames of track {track_id}{why}")
    return Interpolated(write(project, changes, author, effort), finalised, covered)


def interpolate_back(
    project: Project,
    frame_id: int,
    uid: str,
    revision: int,
    author: str,
    *,
    fit: FitBox | None = None,
    effort: Effort | None = None,
) -> Interpolated:
    """Runs `interpolate` from the previous key frame to a reviewed label."""
    page = page_at(project, frame_id, revision)
    frame, label = page.frame, label_of(page, uid).label
    if label.state not in REVIEWED:
        raise ConfigError("only reviewed boxes are key frames; accept the box first")
    if label.track_id is None:
        raise ConfigError("the box belongs to no track; give it the track id of the earlier box first")
    timeline = Timeline(project, frame.recording_id)
    keys = [key for key in timeline.key_frames(label.track_id) if key.index <= timeline.index.get(frame.id, 0)][-2:]
    if len(keys) < 2:
        raise ConfigError(f"track {label.track_id} has no reviewed box in an earlier frame")
    return _filled(timeline, keys, label.track_id, author, fit, effort)


def _chosen(timeline: Timeline, track_id: int, first: str | None, last: str | None) -> list[KeyFrame]:
    """Returns the key frames from `first` to `last`."""
    keys, by_key = timeline.key_frames(track_id), {frame.key: n for n, frame in enumerate(timeline.frames)}
    ends = [0, len(timeline.frames)]
    for place, name in enumerate((first, last)):
        if name is not None and name not in by_key:
            raise NotFoundError(f"the recording has no frame {name!r}")
        if name is not None and by_key[name] not in {key.index for key in keys}:
            raise ConfigError(f"frame {name} has no reviewed box of track {track_id}")
        if name is not None:
            ends[place] = by_key[name]
    chosen = [key for key in keys if ends[0] <= key.index <= ends[1]]
    if len(chosen) < 2:
        raise ConfigError(f"track {track_id} has {len(chosen)} reviewed boxes there; interpolation needs at least two")
    return chosen
