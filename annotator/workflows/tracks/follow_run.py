"""Follows objects through a recording together, frame by frame, and proposes each box as soon as it is found."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

from annotator.geometry.oriented_box import same_box
from annotator.project import REVIEWED, Effort, Project, StoredFrame, StoredLabel, new_action
from annotator.project.changes import REQUESTED, LabelChanged, LabelDeleted, NewLabel, Payload
from annotator.project.overview import read_page
from annotator.tracking.link import overlap_at_place
from annotator.types import Label, OrientedBox, Proposal, ReviewState
from annotator.types.errors import ConfigError, FrameError, NotFoundError, StaleRevisionError, TrackTakenError
from annotator.workflows.tracks.follow_objects import (
    Ends,
    FollowedObject,
    FollowedTrack,
    Follower,
    StoppedAt,
    Walk,
    between,
)
from annotator.workflows.tracks.propose_boxes import (
    around,
    blocking,
    label_of,
    page_at,
    proposal_events,
    proposal_like,
    write,
)
from annotator.workflows.tracks.timeline import KeyFrame, Timeline
from annotator.workflows.workbench.drawing_steps import frame_config
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

# If a frame changes while boxes are stored in it, its state is read again, at most so often.
TRIES = 5
OTHER_TRACK = "a box of {} is here; if it is the same object, give both one track; else draw this object's box here"
KEY_CHANGED = "the reviewed box was changed in the meantime; follow it again"


@dataclass(frozen=True)
class Following:
    """The state of a run.

    Attributes:
        done, total: numbers of frames; a frame counts once for each object and direction.
        first: frame id and uid of the first label that it has proposed.
    """

    done: int
    total: int
    tracks: tuple[FollowedTrack, ...]
    first: tuple[int, str] | None


class FollowRun:
    """Objects that are followed through one recording. All their boxes are one action, which can be undone."""

    def __init__(
        self,
        timeline: Timeline,
        objects: Iterable[Sequence[Ends]],
        view: ReadyDetector | None,
        author: str,
        *,
        effort: Effort | None = None,
    ) -> None:
        """
        Args:
            view: the project's view detector, if any; it is used for the classes that it was trained on, and for boxes
                of the kind that it measures.
        """
        self._timeline, self._view, self._author, self._effort = timeline, view, author, effort
        self._objects = [FollowedObject(ends, len(timeline.frames)) for ends in objects]
        self.action = new_action()
        self._total = self._left()
        self._first: tuple[int, str] | None = None
        self._last_event = timeline.project.log.last()

    @property
    def state(self) -> Following:
        """The state between two rounds."""
        tracks = tuple(item.result() for item in self._objects)
        return Following(self._total - self._left(), self._total, tracks, self._first)

    def run(
        self,
        progress: Callable[[Following], object] = lambda _: None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> Following:
        """Follows all objects to their ends.

        An object that meets a reviewed box of its class at its place goes on from that box, which gets its track. If
        that box has another track, the object stops there. Boxes that earlier runs have proposed for it, and this one
        has not confirmed, are removed, also beyond the frame in which it is lost.

        Args:
            progress: called after each round, in which objects have moved on by one frame.

        After a stop or an error the boxes found so far are stored, between two reviewed boxes also those that were
        found from one of them only.
        """
        try:
            while (front := self._front()) and not stopped():
                for walk in front:
                    if stopped():
                        break
                    if walk.left:  # else another object has ended it
                        self._step(walk)
                self._store()
                progress(self.state)
        finally:
            if self._store(ended=True):
                progress(self.state)
        return self.state

    def _front(self) -> list[Walk]:
        """The walks that move on next.

        Those to an end of the recording are side by side in time, first those forward, then those backward: so the
        first of several reviewed boxes of an object reaches the others before these are followed.
        """
        moving = [walk for item in self._objects for walk in item.walks if walk.left]
        inside = [walk for walk in moving if not walk.part.is_open]
        ahead = [walk for walk in moving if walk.part.is_open and walk.left[0] > walk.key.index]
        back = [walk for walk in moving if walk.part.is_open and walk.left[0] < walk.key.index]
        if ahead:
            first = min(walk.left[0] for walk in ahead)
            return inside + [walk for walk in ahead if walk.left[0] == first]
        last = max((walk.left[0] for walk in back), default=None)
        return inside or [walk for walk in back if walk.left[0] == last]

    def _left(self) -> int:
        return sum(len(walk.left) for item in self._objects for walk in item.walks)

    def _step(self, walk: Walk) -> None:
        item = walk.item
        index = reading = walk.left.popleft()
        item.passed.add(index)
        try:
            if walk.follower is None:
                reading = walk.key.index
                start, label, view = self._timeline.moment(reading), walk.key.label, self._view
                if view is not None and not (label.label in view.labels and view.box_kind is label.box_kind):
                    view = None
                settings = partial(frame_config, self._timeline.project, detector=self._view)
                walk.follower = Follower(start, label.box, label.label, view, settings)
                reading = index
            moment = self._timeline.moment(index)
            expected = walk.follower.expected(moment)
            followed = walk.follower.step(moment)
        except FrameError as error:
            self._stop(walk, reading, str(error))
            return
        box = expected if followed.proposal is None else followed.proposal.box
        if (there := self._standing_at(item, index, box)) is not None:
            self._meet(walk, KeyFrame(index, there), followed.proposal is not None)
        elif followed.proposal is None:
            why = followed.stop.value if followed.stop is not None else ""
            self._stop(walk, index, f"{why} ({followed.detail})" if followed.detail else why)
        elif any(self._collides(item, other, index, box) for other in self._objects):
            self._stop(walk, index, OTHER_TRACK.format("another followed object"))
        else:
            walk.boxes[index], walk.new[index] = box, followed.proposal
            if not walk.left and not walk.part.is_open:
                self._arrive(walk, walk.follower)

    def _arrive(self, walk: Walk, follower: Follower) -> None:
        """Notes whether an object that was followed up to its next reviewed box is found at that one."""
        (key,) = (other.key for other in walk.part.walks if other is not walk)
        with suppress(FrameError):
            found = follower.step(self._timeline.moment(key.index)).proposal
            walk.part.is_joined |= found is not None and bool(overlap_at_place([found.box], [key.label.box]).any())

    def _standing_at(self, item: FollowedObject, index: int, box: OrientedBox) -> Label | None:
        """Returns the label at a place beside which no box of an object is proposed, or None."""
        labels = read_page(self._timeline.project, self._timeline.frames[index].id).labels
        label = blocking(NewLabel(item.label.label, box, track_id=item.track_id), labels)
        # a reviewed box of the track may be elsewhere in the frame
        return label if label is not None and overlap_at_place([box], [label.box]).any() else None

    def _meet(self, walk: Walk, key: KeyFrame, is_found: bool) -> None:
        """Goes on through a reviewed box, or stops at a box of another object."""
        item, label = walk.item, key.label
        others = [other for other in self._objects if other is not item and other.has(label.uid)]
        is_own = label.track_id == item.track_id if label.track_id is not None else item.has(label.uid)
        is_free = label.track_id is None and not any(other.track_id is not None or other.met for other in others)
        if label.state not in REVIEWED or not (is_own or is_free):
            name = "another followed object" if label.track_id is None else f"track {label.track_id}"
            self._stop(walk, key.index, OTHER_TRACK.format(name))
            return
        for other in others:
            # the same object: nothing of it is stored yet
            other.end()
            self._objects.remove(other)
            item.stops += other.stops
        self._total += item.meet(key, walk, is_found)

    @staticmethod
    def _collides(item: FollowedObject, other: FollowedObject, index: int, box: OrientedBox) -> bool:
        """Whether another object of the run, of the same class, was found at the same place."""
        if other is item or other.label.label != item.label.label:
            return False
        return bool(overlap_at_place([box], [w.boxes[index] for w in other.walks if index in w.boxes]).any())

    def _stop(self, walk: Walk, index: int, reason: str) -> None:
        walk.item.passed.update(walk.left)
        walk.left.clear()
        frame = self._timeline.frames[index]
        walk.item.stops.append(StoppedAt(frame.id, frame.key, reason))

    def _store(self, *, ended: bool = False) -> bool:
        """Proposes the boxes that were found; returns whether that changed a frame."""
        found = [(item, item.take(ended)) for item in self._objects]
        found = [(item, boxes) for item, boxes in found if boxes or item.met or ended]
        for _ in range(TRIES - 1):
            with suppress(StaleRevisionError, TrackTakenError):
                return self._try_to_store(found, ended)
        return self._try_to_store(found, ended)

    def _try_to_store(self, found: Sequence[tuple[FollowedObject, dict[int, Proposal]]], ended: bool) -> bool:
        project, frames = self._timeline.project, self._timeline.frames
        # each frame is read once, before its labels: so a change after that is noticed when the events are appended
        needed = {index for item, boxes in found for index in (*boxes, *(key.index for key in item.keys))}
        needed.update(*(item.passed for item, _ in found if ended))
        read = {index: project.frames.get(frames[index].id) for index in needed}
        new: dict[int, list[NewLabel]] = defaultdict(list)
        owners: dict[int, FollowedObject] = {}
        untracked: set[int] = set()
        for item, boxes in found:
            label = self._present(item)
            if label is None:
                continue
            track_id = label.track_id
            if track_id is None:
                track_id = max([project.labels.next_track_id(self._timeline.recording_id), *(id + 1 for id in owners)])
                untracked.add(track_id)
            owners[track_id] = item
            for index, proposal in boxes.items():
                new[index].append(proposal_like(label, proposal.box, track_id, proposal=proposal))
        payloads: dict[int, list[Payload]] = defaultdict(list)
        proposed: list[tuple[int, int | None, str]] = []
        for index, proposals in new.items():
            if not read[index].finalised:
                payloads[index] = proposal_events(around(project, read[index], proposals), read[index], proposals)
                proposed += [(index, e.track_id, e.uid) for e in payloads[index] if isinstance(e, NewLabel)]
        with_boxes = {track_id for _, track_id, _ in proposed}
        given = {track_id for track_id in untracked if track_id in with_boxes or owners[track_id].met}
        for track_id, item in owners.items():
            for key in (*(item.keys[:1] if track_id in given else ()), *item.met):
                payloads[key.index] += self._given_track(key, track_id)
            for index, uid in self._stale(item, track_id, read) if ended else ():
                payloads[index].append(LabelDeleted(uid=uid))
        # two objects may replace the same label
        once = {index: [e for n, e in enumerate(events) if e not in events[:n]] for index, events in payloads.items()}
        changes = [(read[index], events) for index, events in sorted(once.items()) if events]
        if not changes:
            return False
        write(project, changes, self._author, self._effort, action=self.action, new_tracks=given)
        self._effort = None
        for track_id, item in owners.items():
            if track_id not in untracked or track_id in given:
                item.track_id = track_id
            item.met.clear()
            item.proposed |= {index: uid for index, owner, uid in proposed if owner == track_id}
            item.uids |= {uid for _, owner, uid in proposed if owner == track_id}
        if proposed and self._first is None:
            self._first = frames[proposed[0][0]].id, proposed[0][2]
        return True

    def _given_track(self, key: KeyFrame, track_id: int) -> list[Payload]:
        """Returns the events that give a reviewed label its track, in place of open proposals of the track."""
        project = self._timeline.project
        labels = project.labels.of_frame(self._timeline.frames[key.index].id)
        same = [label for label in labels if label.track_id == track_id]
        if any(label.uid == key.label.uid or label.state in REVIEWED for label in same):
            return []
        replaced = [LabelDeleted(uid=label.uid) for label in same if label.state is ReviewState.PROPOSED]
        return [*replaced, LabelChanged(uid=key.label.uid, track_id=track_id)]

    def _stale(self, item: FollowedObject, track_id: int, read: Mapping[int, StoredFrame]) -> list[tuple[int, str]]:
        """Returns what the run has not confirmed of an object: indices of frames, and uids.

        That is: boxes that earlier runs have proposed for it, and the run's own ones that following in the other
        direction has contradicted.
        """
        project = self._timeline.project
        # a run that was stopped has not come to all
        to_come = {index for walk in item.walks for index in walk.left}
        indices = {self._timeline.frames[index].id: index for index in item.passed - to_come}
        is_open = project.labels.along(self._timeline.recording_id, states=[ReviewState.PROPOSED], tracks=[track_id])
        stale: list[tuple[int, str]] = []
        for stored in is_open:
            uid, index = stored.label.uid, indices.get(stored.frame_id)
            if index is None or item.proposed.get(index) == uid or read[index].finalised:
                continue
            if uid in item.uids or (self._was_followed(stored) and uid not in project.labels.kept(stored.frame_id)):
                stale.append((index, uid))
        return stale

    def _was_followed(self, stored: StoredLabel) -> bool:
        """Whether an earlier run has proposed a box; automatic passes and operators propose others."""
        events = self._timeline.project.log.of_frame(stored.frame_id)
        return any(
            event.kind == REQUESTED
            and row.key == stored.label.uid
            and row.after is not None
            and row.after["proposed_box"] is not None
            and event.id <= self._last_event
            for event in events
            for row in event.rows
        )

    def _present(self, item: FollowedObject) -> Label | None:
        """Returns an object's first reviewed label as it is now.

        Returns None, and gives the object up, if one of its reviewed labels has changed.
        """
        timeline, first = self._timeline, None
        for key in item.keys:
            try:
                label = timeline.project.labels.get(key.label.uid).label
            except NotFoundError:
                label = None
            was = key.label
            is_same = label is not None and label.label == was.label and same_box(label.box, was.box)
            if label is None or label.state not in REVIEWED or not is_same:
                frame = timeline.frames[key.index]
                stop = StoppedAt(frame.id, frame.key, KEY_CHANGED)
                if stop not in item.stops:  # else this is another try to store what others have found
                    item.stops.append(stop)
                    item.end()
                return None
            first = first or label
        return first


def follow_recording(
    project: Project,
    recording_id: int,
    view: ReadyDetector | None,
    author: str,
    *,
    tracks: Collection[int] | None = None,
    forward: bool = True,
    backward: bool = False,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> Following:
    """Proposes boxes of tracks from their reviewed boxes on, as one action.

    Between two reviewed boxes a track is followed from both; if it gets to neither from the other one, frames in which
    the results differ are left out. Reviewed and rejected labels stay, and unreviewed proposals of the same objects are
    replaced. A reviewed label without a track gets one with its first new box, or that of an object that comes to it.
    Finalised frames stay as they are, except that a reviewed box there may get a track.

    Args:
        view: the project's view detector, if any (`view_with_classes`).
        tracks: track ids; None = all reviewed boxes.
        forward, backward: whether to go on after the last, and before the first reviewed box.
        progress: called with (frames done, frames), counted for each object and direction.
    """
    timeline = Timeline(project, recording_id)
    objects = []
    for keys in _reviewed(timeline, tracks):
        ends = [None if backward else keys[0], *keys, None if forward else keys[-1]]
        objects.append([(before, after) for before, after in pairwise(ends) if before is not after])
    run = FollowRun(timeline, objects, view, author)
    return run.run(lambda state: progress(state.done, state.total))


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
        view: the project's view detector, if any (`view_with_classes`).
        uid: a label; None = all reviewed labels of the frame.
        forward: False = backward in time.
    """
    page = page_at(project, frame_id, revision)
    frame = page.frame
    moving = [stored for stored in page.labels if stored.is_own and stored.still is None]
    chosen = moving if uid is None else [label_of(page, uid)]
    reviewed = [stored.label for stored in chosen if stored.label.state in REVIEWED]
    if not reviewed:
        which = "this box is not reviewed" if uid is not None else "this frame has no reviewed box to follow"
        raise ConfigError(f"{which}; accept {'it' if uid is not None else 'one'} first")
    timeline = Timeline(project, frame.recording_id)
    ends = [_ends_from(timeline, frame_id, label, forward) for label in reviewed]
    if not any(between(each, len(timeline.frames)) for each in ends):
        side = "next" if forward else "previous"
        at_end = any(None in each for each in ends)
        raise ConfigError(
            f"this is the {'last' if forward else 'first'} frame of its recording; there is no {side} one"
            if at_end
            else f"the {side} frame has a reviewed box of this track already; go on from there"
        )
    return FollowRun(timeline, [[each] for each in ends], view, author, effort=effort)


def _ends_from(timeline: Timeline, frame_id: int, label: Label, forward: bool) -> Ends:
    """Returns a reviewed label and the next reviewed box of its track on one side, if any."""
    index = timeline.index.get(frame_id)
    if index is None:
        raise NotFoundError("this frame is no longer in its recording; restore it, or follow from another frame")
    own = KeyFrame(index, label)
    others = [] if label.track_id is None else timeline.key_frames(label.track_id)
    if forward:
        return own, next((key for key in others if key.index > index), None)
    return next((key for key in reversed(others) if key.index < index), None), own


def _reviewed(timeline: Timeline, tracks: Collection[int] | None) -> list[list[KeyFrame]]:
    """Returns the reviewed boxes of each object, in order; each box without a track is an object."""
    stored = timeline.project.labels.select(states=REVIEWED, recordings=[timeline.recording_id])
    # an object that stands still has its boxes
    present = [each for each in stored if each.frame_id in timeline.index and each.still is None]
    known = {each.label.track_id for each in present if each.label.track_id is not None}
    if tracks is not None and (missing := set(tracks) - known):
        raise ConfigError(f"track {min(missing)} has no reviewed box to follow; accept one first")
    if not present:
        raise ConfigError("there is no reviewed box to follow; accept one first")
    chosen = sorted(known if tracks is None else set(tracks))
    objects = [timeline.key_frames(track_id) for track_id in chosen]
    if tracks is None:
        untracked = [each for each in present if each.label.track_id is None]
        objects += [[KeyFrame(timeline.index[each.frame_id], each.label)] for each in untracked]
    return objects
