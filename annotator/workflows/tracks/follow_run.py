"""Follows objects through a recording together, frame by frame, and proposes each box as soon as it is found."""

from __future__ import annotations

from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from annotator.geometry.iou import iou_3d
from annotator.project import REVIEWED, Effort, FramePart, Project, Receipt, StoredFrame, new_action
from annotator.project.event_types import LabelProposed, LabelTracked, Payload
from annotator.rcv.config import RcvConfig
from annotator.rcv.follow_object import FollowConfig
from annotator.types import Frame, Label, Proposal
from annotator.types.errors import ConfigError, FrameError, NotFoundError, StaleRevisionError, TrackTakenError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.follow_frames import DEFAULTS, Follower, Moment
from annotator.workflows.tracks.interpolate import KeyFrame
from annotator.workflows.tracks.propose_boxes import NewProposal, next_track_id, part_of, proposal_events
from annotator.workflows.tracks.times import times_of
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

# Boxes found by following forward and backward are the same with at least this IoU.
SAME_BOX_IOU = 0.5
# Objects that are followed from the same frame need the same frames at about the same time; others read them again.
FRAMES_KEPT = 4
# If a frame changes while boxes are stored in it, its state is read again, at most so often.
TRIES = 5
KEY_CHANGED = "the reviewed box was changed in the meantime; follow it again"


@dataclass(frozen=True)
class StoppedAt:
    """The frame in which an object was not found, and why."""

    frame_id: int
    key: str
    reason: str


@dataclass(frozen=True)
class FollowedTrack:
    """What became of one object.

    Attributes:
        uid: of its first reviewed label.
        track_id: None while it has no track.
        label: its class.
        boxes: number of new proposals.
        doubtful: number of frames left out because following forward and backward gave different boxes.
        stops: where it was lost before the next reviewed box or the end of the recording.
    """

    uid: str
    track_id: int | None
    label: str
    boxes: int
    doubtful: int
    stops: tuple[StoppedAt, ...]


@dataclass(frozen=True)
class Following:
    """The state of a run.

    Attributes:
        done, total: numbers of frames; a frame counts once for each object and direction.
        tracks: one entry per object.
        changed: the frames changed since the last report: (frame id, receipt) each.
        proposed: the labels proposed since the last report: (frame id, uid) each.
    """

    done: int
    total: int
    tracks: tuple[FollowedTrack, ...]
    changed: tuple[tuple[int, Receipt], ...] = ()
    proposed: tuple[tuple[int, str], ...] = ()


class Timeline:
    """The frames of a recording that follow each other in time, read when they are needed.

    Attributes:
        frames: in order, without those that are no longer in the recording.
    """

    def __init__(self, project: Project, recording_id: int) -> None:
        """
        Raises:
            ConfigError: the recording is not a sequence.
            NotFoundError: no such recording.
            RecordingError: the recording cannot be opened.
        """
        recording = project.recordings.get(recording_id)
        if not recording.is_sequence:
            raise ConfigError(f"the frames of {recording.name} do not follow each other in time; it has no tracks")
        self.project, self.recording_id = project, recording_id
        self.frames: tuple[StoredFrame, ...] = tuple(
            frame for frame in project.frames.of([recording_id]) if frame.index is not None
        )
        self._source = FrameSource(project)
        self._times = times_of(self._source.recording(recording_id), self.frames)
        self._read: OrderedDict[int, Frame] = OrderedDict()

    def moment(self, index: int) -> Moment:
        """Reads a frame.

        Raises:
            FrameError: it cannot be read.
        """
        if index not in self._read:
            self._read[index] = self._source.read(self.frames[index])
            while len(self._read) > FRAMES_KEPT:
                self._read.popitem(last=False)
        return Moment(index, self._read[index], float(self._times[index]))


@dataclass(frozen=True, eq=False)
class Stretch:
    """The frames between two reviewed boxes of an object, or from its only one to an end of the recording (None)."""

    before: KeyFrame | None
    after: KeyFrame | None

    @property
    def keys(self) -> tuple[KeyFrame, ...]:
        """Its reviewed boxes."""
        return tuple(key for key in (self.before, self.after) if key is not None)

    def inside(self, frames: int) -> range:
        """Indices of its frames, in a recording with so many frames."""
        first = 0 if self.before is None else self.before.index + 1
        return range(first, frames if self.after is None else self.after.index)


@dataclass(eq=False)
class _Walk:
    """An object on its way from one reviewed box; `left` are the frames still to come."""

    key: KeyFrame
    left: deque[int]
    follower: Follower | None = None
    boxes: dict[int, Proposal] = field(default_factory=dict)


@dataclass(eq=False)
class _Object:
    """An object, and its result so far; `walks` holds one or two walks for each stretch."""

    track_id: int | None
    keys: tuple[KeyFrame, ...]
    walks: list[list[_Walk]]
    boxes: int = 0
    doubtful: int = 0
    stops: list[StoppedAt] = field(default_factory=list)

    @classmethod
    def of(cls, stretches: Sequence[Stretch], frames: int) -> _Object:
        walks = []
        for stretch in stretches:
            inside = stretch.inside(frames)
            both = [] if stretch.before is None else [_Walk(stretch.before, deque(inside))]
            both += [] if stretch.after is None else [_Walk(stretch.after, deque(reversed(inside)))]
            walks.append(both)
        keys = {key.label.uid: key for stretch in stretches for key in stretch.keys}
        ordered = tuple(sorted(keys.values(), key=lambda key: key.index))
        return cls(ordered[0].label.track_id, ordered, walks)

    @property
    def label(self) -> Label:
        return self.keys[0].label

    def take(self, ended: bool) -> dict[int, Proposal]:
        """Returns the boxes that can be stored now.

        Those between two reviewed boxes can be stored once both directions are done, or once the run has ended.
        """
        taken: dict[int, Proposal] = {}
        for walks in self.walks:
            if len(walks) == 1:
                taken |= walks[0].boxes
            elif ended or not any(walk.left for walk in walks):
                taken |= self._agreed(*walks)
            else:
                continue
            for walk in walks:
                walk.boxes = {}
        return taken

    def _agreed(self, ahead: _Walk, back: _Walk) -> dict[int, Proposal]:
        """Returns the boxes that both directions agree on, each from the nearer reviewed box; or the only ones."""
        agreed = dict(ahead.boxes)
        for index, other in back.boxes.items():
            own = agreed.get(index)
            if own is None or (iou_3d(own.box, other.box) >= SAME_BOX_IOU and _is_nearer(back, ahead, index)):
                agreed[index] = other
            elif iou_3d(own.box, other.box) < SAME_BOX_IOU:
                del agreed[index]
                self.doubtful += 1
        return agreed

    def give_up(self, stop: StoppedAt) -> None:
        """Ends all its walks. Called again, while the boxes of others are being stored, it does nothing."""
        if stop in self.stops:
            return
        self.stops.append(stop)
        for walk in (walk for walks in self.walks for walk in walks):
            walk.left.clear()
            walk.boxes.clear()

    def result(self) -> FollowedTrack:
        return FollowedTrack(
            self.label.uid, self.track_id, self.label.label, self.boxes, self.doubtful, tuple(self.stops)
        )


def _is_nearer(walk: _Walk, other: _Walk, index: int) -> bool:
    return abs(walk.key.index - index) < abs(other.key.index - index)


class FollowRun:
    """Objects that are followed through one recording. All their boxes are one action, which can be undone.

    Attributes:
        action: id of the action.
    """

    def __init__(
        self,
        timeline: Timeline,
        objects: Iterable[Sequence[Stretch]],
        view: ReadyDetector | None,
        author: str,
        *,
        effort: Effort | None = None,
        limits: FollowConfig = DEFAULTS,
    ) -> None:
        """
        Args:
            objects: the stretches of each object.
            view: the project's view detector, if any; it is used for the classes that it was trained on, and for boxes
                of the kind that it measures.
            author: the operator, who can undo this.
            effort: the operator's effort for this action.
        """
        self._timeline, self._view, self._author = timeline, view, author
        self._effort, self._limits = effort, limits
        self._objects = [_Object.of(stretches, len(timeline.frames)) for stretches in objects]
        self.action = new_action()
        self._total = self._left()

    @property
    def state(self) -> Following:
        """The state between two rounds."""
        tracks = tuple(item.result() for item in self._objects)
        return Following(self._total - self._left(), self._total, tracks)

    def run(
        self,
        progress: Callable[[Following], None] | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> Following:
        """Follows all objects to their ends.

        Args:
            progress: called after each round, in which every object has moved on by one frame.
            stopped: asked before each frame.

        After a stop or an error the boxes found so far are stored, between two reviewed boxes also those that were
        found from one of them only.

        Raises:
            StaleRevisionError: a frame is being changed again and again by others.
            TrackTakenError: new track ids are being taken again and again by others.
            DetectionError: the detector fails.
        """
        try:
            while self._left() and not stopped():
                for item in self._objects:
                    for walk in [walk for walks in item.walks for walk in walks if walk.left]:
                        if stopped():
                            break
                        self._step(item, walk)
                self._report(progress, *self._store())
        finally:
            changed, proposed = self._store(ended=True)
            if changed:
                self._report(progress, changed, proposed)
        return self.state

    def _report(
        self,
        progress: Callable[[Following], None] | None,
        changed: tuple[tuple[int, Receipt], ...],
        proposed: tuple[tuple[int, str], ...],
    ) -> None:
        if progress is not None:
            progress(replace(self.state, changed=changed, proposed=proposed))

    def _left(self) -> int:
        return sum(len(walk.left) for item in self._objects for walks in item.walks for walk in walks)

    def _step(self, item: _Object, walk: _Walk) -> None:
        index = reading = walk.left.popleft()
        try:
            if walk.follower is None:
                reading = walk.key.index
                start, label = self._timeline.moment(reading), walk.key.label
                view = self._view if self._view is not None and _measures(self._view, label) else None
                walk.follower = Follower(start, label.box, label.label, view, self._settings, self._limits)
                reading = index
            followed = walk.follower.step(self._timeline.moment(index))
        except FrameError as error:
            self._stop(item, walk, reading, str(error))
            return
        if followed.proposal is not None:
            walk.boxes[index] = followed.proposal
        else:
            why = followed.stop.value if followed.stop is not None else ""
            self._stop(item, walk, index, f"{why} ({followed.detail})" if followed.detail else why)

    def _stop(self, item: _Object, walk: _Walk, index: int, reason: str) -> None:
        walk.left.clear()
        frame = self._timeline.frames[index]
        item.stops.append(StoppedAt(frame.id, frame.key, reason))

    def _settings(self, frame: Frame) -> RcvConfig:
        return frame_config(self._timeline.project, frame, self._view)

    def _store(self, *, ended: bool = False) -> tuple[tuple[tuple[int, Receipt], ...], tuple[tuple[int, str], ...]]:
        """Proposes the boxes that were found; returns the changed frames and the new labels.

        Raises:
            StaleRevisionError, TrackTakenError: others change the frames, or take the track ids, again and again.
        """
        found = [(item, boxes) for item in self._objects if (boxes := item.take(ended))]
        for attempt in range(TRIES):
            try:
                return self._try_to_store(found)
            except (StaleRevisionError, TrackTakenError):
                if attempt == TRIES - 1:
                    raise
        raise AssertionError

    def _try_to_store(
        self, found: Sequence[tuple[_Object, dict[int, Proposal]]]
    ) -> tuple[tuple[tuple[int, Receipt], ...], tuple[tuple[int, str], ...]]:
        project, frames = self._timeline.project, self._timeline.frames
        # each frame is read once, before its labels: so a change after that is noticed when the events are appended
        needed = {index for item, boxes in found for index in (*boxes, item.keys[0].index)}
        read = {index: project.frames.get(frames[index].id) for index in needed}
        new: dict[int, list[NewProposal]] = defaultdict(list)
        owners: dict[int, _Object] = {}
        untracked: set[int] = set()
        for item, boxes in found:
            label = self._present(item)
            if label is None:
                continue
            track_id = label.track_id
            if track_id is None:
                track_id = max([next_track_id(project, self._timeline.recording_id), *(id + 1 for id in owners)])
                untracked.add(track_id)
            owners[track_id] = item
            for index, proposal in boxes.items():
                new[index].append(
                    NewProposal(item.label.label, proposal.box, track_id, proposal, label.box_kind, label.attributes)
                )
        payloads: dict[int, list[Payload]] = defaultdict(list)
        for index, proposals in new.items():
            if not read[index].finalised:
                payloads[index] += proposal_events(project, read[index], proposals)
        proposed = [
            (frames[index].id, payload)
            for index, events in payloads.items()
            for payload in events
            if isinstance(payload, LabelProposed)
        ]
        given = untracked & {payload.track_id for _, payload in proposed}
        for track_id in given:
            key = owners[track_id].keys[0]
            payloads[key.index].append(LabelTracked(uid=key.label.uid, track_id=track_id))
        parts: list[FramePart] = []
        for index, events in sorted(payloads.items()):
            if events:
                parts.append(part_of(read[index], events, self._author, None if parts else self._effort))
        if not parts:
            return (), ()
        receipts = project.log.append_to_frames(parts, self.action, given)
        self._effort = None
        for _, payload in proposed:
            if payload.track_id is not None:
                owners[payload.track_id].track_id = payload.track_id
                owners[payload.track_id].boxes += 1
        changed = tuple((part.frame_id, receipt) for part, receipt in zip(parts, receipts, strict=True))
        return changed, tuple((frame_id, payload.uid) for frame_id, payload in proposed)

    def _present(self, item: _Object) -> Label | None:
        """Returns an object's first reviewed label as it is now.

        Returns None, and gives the object up, if one of its reviewed labels has changed.
        """
        timeline, first = self._timeline, None
        for key in item.keys:
            try:
                label = timeline.project.labels.get(key.label.uid).label
            except NotFoundError:
                label = None
            if label is None or label.state not in REVIEWED or not _is_same(label, key.label):
                frame = timeline.frames[key.index]
                item.give_up(StoppedAt(frame.id, frame.key, KEY_CHANGED))
                return None
            first = first or label
        return first


def _measures(view: ReadyDetector, label: Label) -> bool:
    return label.label in view.labels and view.box_kind is label.box_kind


def _is_same(a: Label, b: Label) -> bool:
    """Returns True for the same class and box."""
    return a.label == b.label and np.array_equal(a.box.pose, b.box.pose) and np.array_equal(a.box.size_m, b.box.size_m)
