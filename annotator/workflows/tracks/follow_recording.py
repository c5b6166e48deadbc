"""Follows the reviewed boxes of a project's tracks through a recording, and proposes the boxes that it finds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from annotator.geometry.iou import iou_3d
from annotator.project import REVIEWED, Effort, FramePart, Project, Receipt, StoredFrame
from annotator.project.event_types import LabelProposed
from annotator.rcv.config import RcvConfig
from annotator.rcv.follow_object import FollowConfig
from annotator.types import Frame, Label, Proposal
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.follow_frames import DEFAULTS, Moment, follow_frames
from annotator.workflows.tracks.propose_boxes import NewProposal, next_track_id, part_of, proposal_events
from annotator.workflows.tracks.times import times_of
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

# Boxes found by following forward and backward are the same with at least this IoU.
SAME_BOX_IOU = 0.5


@dataclass(frozen=True)
class FollowedTrack:
    """What became of one track.

    Attributes:
        track_id: of the track.
        label: its class.
        boxes: number of new proposals.
        doubtful: number of frames left out because following forward and backward gave different boxes.
        stops: where following ended before the next reviewed box: (frame key, reason) each.
    """

    track_id: int
    label: str
    boxes: int
    doubtful: int
    stops: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class FollowedRecording:
    """The result of following tracks through a recording.

    Attributes:
        tracks: one entry per track.
        changed: the changed frames: (frame id, receipt) each.
    """

    tracks: tuple[FollowedTrack, ...]
    changed: tuple[tuple[int, Receipt], ...]


def follow_recording(
    project: Project,
    recording_id: int,
    view: ReadyDetector,
    author: str,
    *,
    tracks: Collection[int] | None = None,
    forward: bool = True,
    backward: bool = False,
    effort: Effort | None = None,
    progress: Callable[[int, int], None] | None = None,
    limits: FollowConfig = DEFAULTS,
) -> FollowedRecording:
    """Proposes boxes of tracks from their reviewed boxes on, as one action.

    Between two reviewed boxes a track is followed from both; frames in which the results differ are left out. Reviewed
    and rejected labels stay, unreviewed proposals of the same objects are replaced, finalised frames stay as they are.

    Args:
        author: the operator, who can undo this.
        tracks: track ids; None = all tracks with a reviewed box.
        forward, backward: whether to go on after the last, and before the first reviewed box.
        effort: the operator's effort for this action.
        progress: called with (stretches done, stretches).

    Raises:
        ConfigError: the recording is no sequence, there is no reviewed box to follow, or nothing was proposed.
        NotFoundError: no such recording.
        StaleRevisionError: a frame was changed in the meantime.
        RecordingError: the recording cannot be opened.
    """
    run = _Run.of(project, recording_id, view, limits)
    keys = run.reviewed(tracks)
    stretches: list[tuple[int, int | None, int | None]] = []
    for track_id, boxes in sorted(keys.items()):
        ends: list[int | None] = [
            None if backward else boxes[0][0],
            *(index for index, _ in boxes),
            None if forward else boxes[-1][0],
        ]
        stretches += [(track_id, before, after) for before, after in pairwise(ends) if before != after]
    results: dict[int, list[_Stretch]] = defaultdict(list)
    for done, (track_id, before, after) in enumerate(stretches, start=1):
        results[track_id].append(run.stretch(dict(keys[track_id]), before, after))
        if progress is not None:
            progress(done, len(stretches))
    return run.store(results, keys, author, effort)


@dataclass(frozen=True, eq=False)
class _Stretch:
    """The boxes between two reviewed ones, by index of the frame."""

    boxes: dict[int, Proposal]
    doubtful: int
    stops: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class _Run:
    """A recording of a project and what is needed to follow objects in it."""

    project: Project
    recording_id: int
    view: ReadyDetector
    limits: FollowConfig
    frames: tuple[StoredFrame, ...]
    times: Float64[np.ndarray, "n"]
    source: FrameSource

    @classmethod
    def of(cls, project: Project, recording_id: int, view: ReadyDetector, limits: FollowConfig) -> _Run:
        recording = project.recordings.get(recording_id)
        if not recording.is_sequence:
            raise ConfigError(f"the frames of {recording.name} do not follow each other in time; it has no tracks")
        frames = tuple(frame for frame in project.frames.of([recording_id]) if frame.index is not None)
        source = FrameSource(project)
        return cls(
            project, recording_id, view, limits, frames, times_of(source.recording(recording_id), frames), source
        )

    def reviewed(self, tracks: Collection[int] | None) -> dict[int, list[tuple[int, Label]]]:
        """Returns each track's reviewed boxes by frame index, in order; a box without a track gets a new one."""
        indices = {frame.id: index for index, frame in enumerate(self.frames)}
        keys: dict[int, list[tuple[int, Label]]] = defaultdict(list)
        new = next_track_id(self.project, self.recording_id)
        for stored in self.project.labels.select(states=REVIEWED, recordings=[self.recording_id]):
            label, index = stored.label, indices.get(stored.frame_id)
            if index is None or (tracks is not None and label.track_id not in tracks):
                continue
            track_id = label.track_id
            if track_id is None:
                track_id, new = new, new + 1
            keys[track_id].append((index, replace(label, track_id=track_id)))
        if tracks is not None and (missing := set(tracks) - set(keys)):
            raise ConfigError(f"track {min(missing)} has no reviewed box to follow; accept one first")
        if not keys:
            raise ConfigError("there is no reviewed box to follow; accept one first")
        return {track_id: sorted(boxes, key=lambda pair: pair[0]) for track_id, boxes in keys.items()}

    def stretch(self, keys: dict[int, Label], before: int | None, after: int | None) -> _Stretch:
        """Follows a track between two reviewed boxes, or from the only one to an end of the recording."""
        last = len(self.frames) if after is None else after
        first = -1 if before is None else before
        ahead = self._one_way(keys[first], first, range(first + 1, last)) if before is not None else _Stretch({}, 0, ())
        back = self._one_way(keys[last], last, range(last - 1, first, -1)) if after is not None else _Stretch({}, 0, ())
        boxes, doubtful = {}, 0
        for index in sorted(ahead.boxes.keys() | back.boxes.keys()):
            one, other = ahead.boxes.get(index), back.boxes.get(index)
            if one is None or other is None:
                boxes[index] = one or other
            elif iou_3d(one.box, other.box) >= SAME_BOX_IOU:
                boxes[index] = one if index - first <= last - index else other
            else:
                doubtful += 1
        kept = {index: proposal for index, proposal in boxes.items() if proposal is not None}
        return _Stretch(kept, doubtful, ahead.stops + back.stops)

    def _one_way(self, label: Label, at: int, later: range) -> _Stretch:
        boxes: dict[int, Proposal] = {}
        try:
            start = self._moment(at)
            for moment, followed in follow_frames(
                start, label.box, label.label, map(self._moment, later), self.view, self._settings, self.limits
            ):
                if followed.proposal is None:
                    why = f"{followed.stop.value if followed.stop else ''} ({followed.detail})".replace(" ()", "")
                    return _Stretch(boxes, 0, ((self.frames[moment.index].key, why),))
                boxes[moment.index] = followed.proposal
        except FrameError as error:
            return _Stretch(boxes, 0, ((self.frames[at].key, str(error)),))
        return _Stretch(boxes, 0, ())

    def _moment(self, index: int) -> Moment:
        return Moment(index, self.source.read(self.frames[index]), float(self.times[index]))

    def _settings(self, frame: Frame) -> RcvConfig:
        return frame_config(self.project, frame, self.view)

    def store(
        self,
        results: dict[int, list[_Stretch]],
        keys: dict[int, list[tuple[int, Label]]],
        author: str,
        effort: Effort | None,
    ) -> FollowedRecording:
        """Proposes all boxes, as one action.

        Raises:
            ConfigError: there is none.
        """
        new: dict[int, list[NewProposal]] = defaultdict(list)
        for track_id, stretches in results.items():
            label = keys[track_id][0][1].label
            for stretch in stretches:
                for index, proposal in stretch.boxes.items():
                    new[index].append(NewProposal(label, proposal.box, track_id, proposal))
        parts: list[FramePart] = []
        stored: dict[int, int] = defaultdict(int)
        for index, boxes in sorted(new.items()):
            frame = self.frames[index]
            payloads = [] if frame.finalised else proposal_events(self.project, frame, boxes)
            if payloads:
                parts.append(part_of(frame, payloads, author, None if parts else effort))
            for payload in payloads:
                if isinstance(payload, LabelProposed) and payload.track_id is not None:
                    stored[payload.track_id] += 1
        tracks = tuple(
            FollowedTrack(
                track_id,
                keys[track_id][0][1].label,
                stored[track_id],
                sum(stretch.doubtful for stretch in stretches),
                tuple(stop for stretch in stretches for stop in stretch.stops),
            )
            for track_id, stretches in sorted(results.items())
        )
        if not parts:
            stops = [f"frame {key}: {why}" for track in tracks for key, why in track.stops]
            raise ConfigError(f"nothing was proposed{'; ' if stops else ''}{'; '.join(stops[:3])}")
        receipts = self.project.log.append_to_frames(parts)
        changed = tuple((part.frame_id, receipt) for part, receipt in zip(parts, receipts, strict=True))
        return FollowedRecording(tracks, changed)
