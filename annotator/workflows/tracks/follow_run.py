"""Follows objects through a recording together, frame by frame, and proposes each box as soon as it is found."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from annotator.project import REVIEWED, Effort, Project, StoredFrame, StoredLabel, new_action
from annotator.project.changes import REQUESTED, LabelChanged, LabelDeleted, NewLabel, Payload
from annotator.project.overview import read_page
from annotator.tracking.link import overlap_at_place
from annotator.types import Label, OrientedBox, Proposal, ReviewState
from annotator.types.errors import ConfigError, FrameError, NotFoundError, StaleRevisionError, TrackTakenError
from annotator.workflows.tracks.follow_objects import (
    FollowedObject,
    FollowedTrack,
    Follower,
    Part,
    StoppedAt,
    Stretch,
    Walk,
)
from annotator.workflows.tracks.propose_boxes import (
    Changed,
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
        proposed: the labels proposed since the last report: (frame id, uid) each.
    """

    done: int
    total: int
    tracks: tuple[FollowedTrack, ...]
    changed: Changed = ()
    proposed: tuple[tuple[int, str], ...] = ()


_OnWay = tuple[FollowedObject, Part, Walk]
_Stored = tuple[Changed, tuple[tuple[int, str], ...]]
"""The `changed` and `proposed` of `Following`."""


class FollowRun:
    """Objects that are followed through one recording. All their boxes are one action, which can be undone."""

    def __init__(
        self,
        timeline: Timeline,
        objects: Iterable[Sequence[Stretch]],
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
        self._objects = [FollowedObject.of(stretches, len(timeline.frames)) for stretches in objects]
        self.action = new_action()
        self._total = self._left()
        self._last_event = timeline.project.log.last()

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
                for item, part, walk in front:
                    if stopped():
                        break
                    if walk.left:  # else another object has ended it
                        self._step(item, part, walk)
                self._report(progress, self._store())
        finally:
            stored = self._store(ended=True)
            if stored[0]:
                self._report(progress, stored)
        return self.state

    def _front(self) -> list[_OnWay]:
        """The walks that move on next.

        Those to an end of the recording are side by side in time, first those forward, then those backward: so the
        first of several reviewed boxes of an object reaches the others before these are followed.
        """
        moving = [(item, part, walk) for item in self._objects for part, walk in item.walks() if walk.left]
        between = [each for each in moving if not each[1].is_open]
        ahead, back = list[_OnWay](), list[_OnWay]()
        for each in moving:
            if each[1].is_open:
                (back if each[2].left[0] < each[2].key.index else ahead).append(each)
        if ahead:
            first = min(walk.left[0] for _, _, walk in ahead)
            return between + [each for each in ahead if each[2].left[0] == first]
        if between or not back:
            return between
        last = max(walk.left[0] for _, _, walk in back)
        return [each for each in back if each[2].left[0] == last]

    def _report(self, progress: Callable[[Following], None] | None, stored: _Stored) -> None:
        if progress is not None:
            progress(replace(self.state, changed=stored[0], proposed=stored[1]))

    def _left(self) -> int:
        return sum(len(walk.left) for item in self._objects for _, walk in item.walks())

    def _step(self, item: FollowedObject, part: Part, walk: Walk) -> None:
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
            self._stop(item, walk, reading, str(error))
            return
        box = expected if followed.proposal is None else followed.proposal.box
        if (there := self._standing_at(item, index, box)) is not None:
            self._meet(item, part, walk, KeyFrame(index, there), followed.proposal is not None)
        elif followed.proposal is None:
            why = followed.stop.value if followed.stop is not None else ""
            self._stop(item, walk, index, f"{why} ({followed.detail})" if followed.detail else why)
        elif any(self._collides(item, other, index, box) for other in self._objects):
            self._stop(item, walk, index, OTHER_TRACK.format("another followed object"))
        else:
            walk.boxes[index] = followed.proposal
            walk.new.add(index)
            if not walk.left and not part.is_open:
                self._arrive(part, walk, walk.follower)

    def _arrive(self, part: Part, walk: Walk, follower: Follower) -> None:
        """Notes whether an object that was followed up to its next reviewed box is found at that one."""
        (key,) = (other.key for other in part.walks if other is not walk)
        with suppress(FrameError):
            found = follower.step(self._timeline.moment(key.index)).proposal
            part.is_joined |= found is not None and bool(overlap_at_place([found.box], [key.label.box]).any())

    def _standing_at(self, item: FollowedObject, index: int, box: OrientedBox) -> Label | None:
        """Returns the label at a place beside which no box of an object is proposed, or None."""
        labels = read_page(self._timeline.project, self._timeline.frames[index].id).labels
        label = blocking(NewLabel(item.label.label, box, track_id=item.track_id), labels)
        # a reviewed box of the track may be elsewhere in the frame
        return label if label is not None and overlap_at_place([box], [label.box]).any() else None

    def _meet(self, item: FollowedObject, part: Part, walk: Walk, key: KeyFrame, is_found: bool) -> None:
        """Goes on through a reviewed box, or stops at a box of another object."""
        label = key.label
        others = [other for other in self._objects if other is not item and other.has(label.uid)]
        is_own = label.track_id == item.track_id if label.track_id is not None else item.has(label.uid)
        is_free = label.track_id is None and not any(other.track_id is not None or other.met for other in others)
        if label.state not in REVIEWED or not (is_own or is_free):
            name = "another followed object" if label.track_id is None else f"track {label.track_id}"
            self._stop(item, walk, key.index, OTHER_TRACK.format(name))
            return
        for other in others:
            # the same object: nothing of it is stored yet
            other.end()
            self._objects.remove(other)
            item.stops += other.stops
        self._total += item.meet(key, part, walk, is_found)

    @staticmethod
    def _collides(item: FollowedObject, other: FollowedObject, index: int, box: OrientedBox) -> bool:
        """Whether another object of the run, of the same class, was found at the same place."""
        if other is item or other.label.label != item.label.label:
            return False
        found = [walk.boxes[index].box for _, walk in other.walks() if index in walk.boxes]
        return bool(overlap_at_place([box], found).any())

    def _stop(self, item: FollowedObject, walk: Walk, index: int, reason: str) -> None:
        item.passed.update(walk.left)
        walk.left.clear()
        frame = self._timeline.frames[index]
        item.stops.append(StoppedAt(frame.id, frame.key, reason))

    def _store(self, *, ended: bool = False) -> _Stored:
        """Proposes the boxes that were found."""
        found = [(item, item.take(ended)) for item in self._objects]
        found = [(item, boxes) for item, boxes in found if boxes or item.met or ended]
        for attempt in range(TRIES):
            try:
                return self._try_to_store(found, ended)
            except (StaleRevisionError, TrackTakenError):
                if attempt == TRIES - 1:
                    raise
        raise AssertionError

    def _try_to_store(self, found: Sequence[tuple[FollowedObject, dict[int, Proposal]]], ended: bool) -> _Stored:
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
        for index, proposals in new.items():
            if not read[index].finalised:
                payloads[index] += proposal_events(project, read[index], proposals)
        proposed = [
            (index, payload)
            for index, events in payloads.items()
            for payload in events
            if isinstance(payload, NewLabel)
        ]
        given = untracked & {
            *(payload.track_id for _, payload in proposed),
            *(track_id for track_id, item in owners.items() if item.met),
        }
        for track_id, item in owners.items():
            first = item.keys[:1] if track_id in given else ()
            for key in (*first, *item.met):
                payloads[key.index] += self._given_track(key, track_id)
            for index, events in self._without_stale(item, track_id, read).items() if ended else ():
                payloads[index] += events
        changes = [(read[index], _once(events)) for index, events in sorted(payloads.items()) if events]
        if not changes:
            return (), ()
        changed = write(project, changes, self._author, self._effort, action=self.action, new_tracks=given)
        self._effort = None
        for track_id, item in owners.items():
            if track_id not in untracked or track_id in given:
                item.give_track(track_id)
            item.met.clear()
        for index, payload in proposed:
            if payload.track_id is not None:
                owners[payload.track_id].proposed[index] = payload.uid
                owners[payload.track_id].uids.add(payload.uid)
        return changed, tuple((frames[index].id, payload.uid) for index, payload in proposed)

    def _given_track(self, key: KeyFrame, track_id: int) -> list[Payload]:
        """Returns the events that give a reviewed label its track, in place of open proposals of the track."""
        project = self._timeline.project
        labels = project.labels.of_frame(self._timeline.frames[key.index].id)
        same = [label for label in labels if label.track_id == track_id]
        if any(label.uid == key.label.uid or label.state in REVIEWED for label in same):
            return []
        replaced = [LabelDeleted(uid=label.uid) for label in same if label.state is ReviewState.PROPOSED]
        return [*replaced, LabelChanged(uid=key.label.uid, track_id=track_id)]

    def _without_stale(
        self, item: FollowedObject, track_id: int, read: Mapping[int, StoredFrame]
    ) -> dict[int, list[Payload]]:
        """Returns the events that remove what the run has not confirmed of an object, by frame.

        That is: boxes that earlier runs have proposed for it, and the run's own ones that following in the other
        direction has contradicted.
        """
        project = self._timeline.project
        # a run that was stopped has not come to all
        to_come = {index for _, walk in item.walks() for index in walk.left}
        indices = {self._timeline.frames[index].id: index for index in item.passed - to_come}
        events: dict[int, list[Payload]] = {}
        is_open = project.labels.along(self._timeline.recording_id, states=[ReviewState.PROPOSED], tracks=[track_id])
        for stored in is_open:
            uid, index = stored.label.uid, indices.get(stored.frame_id)
            if index is None or item.proposed.get(index) == uid or read[index].finalised:
                continue
            if uid in item.uids or (self._was_followed(stored) and uid not in project.labels.kept(stored.frame_id)):
                events.setdefault(index, []).append(LabelDeleted(uid=uid))
        return events

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
            if label is None or label.state not in REVIEWED or not _is_same(label, key.label):
                frame = timeline.frames[key.index]
                stop = StoppedAt(frame.id, frame.key, KEY_CHANGED)
                if stop not in item.stops:  # else this is another try to store what others have found
                    item.stops.append(stop)
                    item.end()
                return None
            first = first or label
        return first


def _once(events: Sequence[Payload]) -> list[Payload]:
    """Returns the events without repeated deletions of one label."""
    gone = [event.uid if isinstance(event, LabelDeleted) else None for event in events]
    return [event for n, event in enumerate(events) if gone[n] is None or gone[n] not in gone[:n]]


def _is_same(a: Label, b: Label) -> bool:
    """Returns True for the same class and box."""
    return a.label == b.label and np.array_equal(a.box.pose, b.box.pose) and np.array_equal(a.box.size_m, b.box.size_m)


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
        objects.append([Stretch(before, after) for before, after in pairwise(ends) if before is not after])
    run = FollowRun(timeline, objects, view, author)
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
        view: the project's view detector, if any (`view_with_classes`).
        uid: a label; None = all reviewed labels of the frame.
        forward: False = backward in time.
    """
    page = page_at(project, frame_id, revision)
    frame = page.frame
    chosen = [stored for stored in page.labels if stored.is_own] if uid is None else [label_of(page, uid)]
    reviewed = [stored.label for stored in chosen if stored.label.state in REVIEWED]
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
    """Returns the stretch on one side of a reviewed label."""
    index = timeline.index.get(frame_id)
    if index is None:
        raise NotFoundError("this frame is no longer in its recording; restore it, or follow from another frame")
    own = KeyFrame(index, label)
    others = [] if label.track_id is None else timeline.key_frames(label.track_id)
    if forward:
        return Stretch(own, next((key for key in others if key.index > index), None))
    return Stretch(next((key for key in reversed(others) if key.index < index), None), own)


def _reviewed(timeline: Timeline, tracks: Collection[int] | None) -> list[list[KeyFrame]]:
    """Returns the reviewed boxes of each object, in order; each box without a track is an object."""
    stored = timeline.project.labels.select(states=REVIEWED, recordings=[timeline.recording_id])
    present = [each for each in stored if each.frame_id in timeline.index]
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
