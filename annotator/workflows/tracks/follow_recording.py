"""What is followed: all reviewed boxes of a recording's tracks, or those of one frame."""

from __future__ import annotations

from collections.abc import Callable, Collection
from itertools import pairwise

from annotator.project import REVIEWED, Effort, Project
from annotator.project.overview import read_page
from annotator.rcv.follow_object import FollowConfig
from annotator.types import Label
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.tracks.follow_frames import DEFAULTS
from annotator.workflows.tracks.follow_objects import Stretch
from annotator.workflows.tracks.follow_run import Following, FollowRun
from annotator.workflows.tracks.interpolate import KeyFrame, key_frames
from annotator.workflows.tracks.link import Timeline
from annotator.workflows.workbench.loaded_detectors import ReadyDetector


def follow_recording(
    project: Project,
    recording_id: int,
    view: ReadyDetector | None,
    author: str,
    *,
    tracks: Collection[int] | None = None,
    forward: bool = True,
    backward: bool = False,
    progress: Callable[[int, int], None] | None = None,
    limits: FollowConfig = DEFAULTS,
) -> Following:
    """Proposes boxes of tracks from their reviewed boxes on, as one action.

    Between two reviewed boxes a track is followed from both; if it gets to neither from the other one, frames in which
    the results differ are left out. Reviewed and rejected labels stay, and unreviewed proposals of the same objects are
    replaced. A reviewed label without a track gets one with its first new box, or that of an object that comes to it.
    Finalised frames stay as they are, except that a reviewed box there may get a track.

    Args:
        view: the project's view detector, if any (`view_with_classes`).
        author: the operator, who can undo this.
        tracks: track ids; None = all reviewed boxes.
        forward, backward: whether to go on after the last, and before the first reviewed box.
        progress: called with (frames done, frames), counted for each object and direction.

    Raises:
        ConfigError: the recording is no sequence, there is no reviewed box to follow, or a track has two reviewed
            boxes in a frame.
        NotFoundError: no such recording.
        RecordingError: the recording cannot be opened.
        StaleRevisionError, TrackTakenError, DetectionError: as `FollowRun.run`.
    """
    timeline = Timeline(project, recording_id)
    objects = []
    for keys in _reviewed(timeline, tracks):
        ends = [None if backward else keys[0], *keys, None if forward else keys[-1]]
        objects.append([Stretch(before, after) for before, after in pairwise(ends) if before is not after])
    run = FollowRun(timeline, objects, view, author, limits=limits)
    return run.run(None if progress is None else lambda state: progress(state.done, state.total))


def follow_from_frame(
    project: Project,
    frame_id: int,
    revision: int,
    view: ReadyDetector | None,
    author: str,
    *,
    uid: str | None = None,
    forward: bool = True,
    effort: Effort | None = None,
) -> FollowRun:
    """Prepares to follow reviewed boxes of a frame to the next reviewed box of their tracks, or as far as possible.

    Reviewed boxes without a track that they come to get theirs.

    Args:
        revision: of the frame, as shown to the operator.
        view: the project's view detector, if any (`view_with_classes`).
        author: the operator, who can undo this.
        uid: a label; None = all reviewed labels of the frame.
        forward: False = backward in time.
        effort: the operator's effort for this action.

    Raises:
        StaleRevisionError: the frame was changed in the meantime.
        ConfigError: the recording is no sequence, there is no reviewed box, no frame to follow it to, or a track has
            two reviewed boxes in a frame.
        NotFoundError, RecordingError: no such frame or label, or the recording cannot be opened.
    """
    page = read_page(project, frame_id)
    frame = page.frame
    if frame.revision != revision:
        raise StaleRevisionError(f"frame {frame.key}", revision, frame.revision)
    labels = [stored.label for stored in page.labels if uid is None or stored.label.uid == uid]
    if not labels and uid is not None:
        raise NotFoundError(f"frame {frame.key} has no label {uid}; reload the frame")
    reviewed = [label for label in labels if label.state in REVIEWED]
    if not reviewed:
        which = "this box is not reviewed" if uid is not None else f"frame {frame.key} has no reviewed box to follow"
        raise ConfigError(f"{which}; accept {'it' if uid is not None else 'one'} first")
    timeline = Timeline(project, frame.recording_id)
    stretches = [_stretch_from(timeline, frame_id, label, forward) for label in reviewed]
    if not any(stretch.inside(len(timeline.frames)) for stretch in stretches):
        side = "next" if forward else "previous"
        at_end = any(len(stretch.keys) == 1 for stretch in stretches)
        raise ConfigError(
            f"frame {frame.key} is the {'last' if forward else 'first'} of its recording; there is no {side} frame"
            if at_end
            else f"the {side} frame of frame {frame.key} has a reviewed box of this track already; go on from there"
        )
    return FollowRun(timeline, [[stretch] for stretch in stretches], view, author, effort=effort)


def _stretch_from(timeline: Timeline, frame_id: int, label: Label, forward: bool) -> Stretch:
    """Returns the stretch on one side of a reviewed label.

    Raises:
        NotFoundError: its frame is no longer in the recording.
        ConfigError: its track has two reviewed boxes in a frame.
    """
    index = next((index for index, frame in enumerate(timeline.frames) if frame.id == frame_id), None)
    if index is None:
        raise NotFoundError("this frame is no longer in its recording; restore it, or follow from another frame")
    own, others = KeyFrame(index, label), []
    if label.track_id is not None:
        others = key_frames(timeline.project, timeline.frames, timeline.recording_id, label.track_id)
    if forward:
        return Stretch(own, next((key for key in others if key.index > index), None))
    return Stretch(next((key for key in reversed(others) if key.index < index), None), own)


def _reviewed(timeline: Timeline, tracks: Collection[int] | None) -> list[list[KeyFrame]]:
    """Returns the reviewed boxes of each object, in order; each box without a track is an object.

    Raises:
        ConfigError: there is none, or a track has two of them in a frame.
    """
    project, recording_id = timeline.project, timeline.recording_id
    indices = {frame.id: index for index, frame in enumerate(timeline.frames)}
    stored = project.labels.select(states=REVIEWED, recordings=[recording_id])
    present = [each for each in stored if each.frame_id in indices]
    known = {each.label.track_id for each in present if each.label.track_id is not None}
    if tracks is not None and (missing := set(tracks) - known):
        raise ConfigError(f"track {min(missing)} has no reviewed box to follow; accept one first")
    if not present:
        raise ConfigError("there is no reviewed box to follow; accept one first")
    chosen = sorted(known if tracks is None else set(tracks))
    objects = [key_frames(project, timeline.frames, recording_id, track_id) for track_id in chosen]
    if tracks is None:
        objects += [[KeyFrame(indices[each.frame_id], each.label)] for each in present if each.label.track_id is None]
    return objects
