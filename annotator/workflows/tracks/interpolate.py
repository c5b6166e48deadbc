"""Interpolates the boxes of a track between its key frames, which are the frames with a reviewed box.

Boxes carried over from other frames can be fitted to the points of the new frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from annotator.geometry.iou import iou_3d
from annotator.project import REVIEWED, Effort, FramePart, Project, Receipt, StoredFrame
from annotator.tracking.smooth import between
from annotator.types import Label, OrientedBox
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.types.label import MOST_TRACK
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.link import times_of
from annotator.workflows.tracks.propose_boxes import NewProposal, part_of, proposal_events
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
        fitted = refit(opened, box, label.label, config, detector).box
        return fitted if iou_3d(fitted, box) >= MIN_IOU else box

    return fit


@dataclass(frozen=True)
class Interpolated:
    """The result of an interpolation.

    Attributes:
        track_id: of the track.
        filled: the frames with a new proposal: (frame id, receipt) each.
        finalised: number of frames not changed because they are finalised.
        covered: number of frames not changed because they have a reviewed or rejected box of this object.
    """

    track_id: int
    filled: tuple[tuple[int, Receipt], ...]
    finalised: int
    covered: int


@dataclass(frozen=True, eq=False)
class KeyFrame:
    """A key frame: its index among the frames that are still in the recording, and its label."""

    index: int
    label: Label


def interpolate(
    project: Project,
    recording_id: int,
    track_id: int,
    author: str,
    *,
    first: str | None = None,
    last: str | None = None,
    fit: FitBox | None = None,
    effort: Effort | None = None,
) -> Interpolated:
    """Proposes boxes of a track in the frames between its key frames, as one action.

    Centre, size and rotation are interpolated by the frames' times if they are recorded, else by their indices.
    Reviewed and rejected labels stay; unreviewed proposals of the same object are replaced.

    Args:
        first, last: keys of two key frames, the earlier one first; None = the first or the last key frame.
        fit: fits each new box to its frame's points.

    Raises:
        NotFoundError: no such recording or frame.
        ConfigError: an invalid track id, fewer than two key frames, `first` or `last` is not a key frame, or there is
            no frame to fill.
        StaleRevisionError: one of the frames was changed in the meantime.
        RecordingError, FrameError: a frame that `fit` needs cannot be read.
    """
    if abs(track_id) > MOST_TRACK:
        raise ConfigError(f"track ids are at most {MOST_TRACK}, not {track_id:.6g}; give the id of a track")
    recording = project.recordings.get(recording_id)
    if not recording.is_sequence:
        raise ConfigError(f"the frames of {recording.name} do not follow each other in time; it has no tracks")
    frames = [frame for frame in project.frames.of([recording_id]) if frame.index is not None]
    keys = _chosen(key_frames(project, frames, recording_id, track_id), frames, track_id, first, last)
    times = times_of(FrameSource(project).recording(recording_id), frames).tolist()
    parts: list[FramePart] = []
    finalised = covered = 0
    for before, after in pairwise(keys):
        inside = range(before.index + 1, after.index)
        ends = (times[before.index], times[after.index])
        boxes = between(before.label.box, after.label.box, *ends, [times[index] for index in inside])
        for index, box in zip(inside, boxes, strict=True):
            frame = frames[index]
            if frame.finalised:
                finalised += 1
                continue
            label = before.label
            fitted = box if fit is None else fit(frame, box, label)
            # the values of the key frame that is nearer in time
            is_later = times[index] - ends[0] > ends[1] - times[index] and after.label.label == label.label
            values = after.label.attributes if is_later else label.attributes
            proposal = NewProposal(label.label, fitted, track_id, box_kind=label.box_kind, attributes=values)
            payloads = proposal_events(project, frame, [proposal])
            covered += not payloads
            if payloads:
                parts.append(part_of(frame, payloads, author, None if parts else effort))
    if not parts:
        why = f" ({finalised} finalised, {covered} reviewed or rejected)" if finalised or covered else ""
        raise ConfigError(f"there is no frame to fill between the key frames of track {track_id}{why}")
    receipts = project.log.append_to_frames(parts)
    filled = tuple((part.frame_id, receipt) for part, receipt in zip(parts, receipts, strict=True))
    return Interpolated(track_id, filled, finalised, covered)


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
    """Runs `interpolate` from the previous key frame to a reviewed label.

    Raises:
        StaleRevisionError: the frame was changed in the meantime.
        ConfigError: the label is not reviewed, has no track, or is the first of its track; or as `interpolate`.
        NotFoundError, RecordingError, FrameError: as `interpolate`; or no such label.
    """
    frame, label = project.frames.get(frame_id), project.labels.get(uid).label
    if frame.revision != revision:
        raise StaleRevisionError(f"frame {frame.key}", revision, frame.revision)
    if label.state not in REVIEWED:
        raise ConfigError("only reviewed boxes are key frames; accept the box first")
    if label.track_id is None:
        raise ConfigError("the box belongs to no track; give it the track id of the earlier box first")
    frames = [each for each in project.frames.of([frame.recording_id]) if each.index is not None]
    keys = key_frames(project, frames, frame.recording_id, label.track_id)
    earlier = [frames[key.index].key for key in keys if (frames[key.index].index or 0) < (frame.index or 0)]
    if not earlier:
        raise ConfigError(f"track {label.track_id} has no reviewed box in an earlier frame")
    return interpolate(
        project,
        frame.recording_id,
        label.track_id,
        author,
        first=earlier[-1],
        last=frame.key,
        fit=fit,
        effort=effort,
    )


def key_frames(project: Project, frames: Sequence[StoredFrame], recording_id: int, track_id: int) -> list[KeyFrame]:
    """Returns the key frames of a track, in order."""
    indices = {frame.id: index for index, frame in enumerate(frames)}
    keys: dict[int, KeyFrame] = {}
    for stored in project.labels.select(states=REVIEWED, recordings=[recording_id], tracks=[track_id]):
        if (index := indices.get(stored.frame_id)) is not None:
            keys[index] = KeyFrame(index, stored.label)
    return [keys[index] for index in sorted(keys)]


def _chosen(
    keys: list[KeyFrame], frames: Sequence[StoredFrame], track_id: int, first: str | None, last: str | None
) -> list[KeyFrame]:
    """Returns the key frames from `first` to `last`."""
    by_key = {frame.key: index for index, frame in enumerate(frames)}
    ends = []
    for name in (first, last):
        if name is not None and name not in by_key:
            raise NotFoundError(f"the recording has no frame {name!r}")
        if name is not None and by_key[name] not in {key.index for key in keys}:
            raise ConfigError(f"frame {name} has no reviewed box of track {track_id}")
        ends.append(None if name is None else by_key[name])
    low = 0 if ends[0] is None else ends[0]
    high = len(frames) if ends[1] is None else ends[1]
    chosen = [key for key in keys if low <= key.index <= high]
    if len(chosen) < 2:
        raise ConfigError(f"track {track_id} has {len(chosen)} reviewed boxes there; interpolation needs at least two")
    return chosen
