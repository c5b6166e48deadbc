"""`annotator track`: links the boxes of a recording into tracks, and smooths unreviewed proposals along them.

This automatic pass sets track ids and changes the boxes of unreviewed proposals. It keeps the boxes of reviewed labels,
track ids given by operators or files, everything in finalised frames, and what other cameras of the moments have.
Smoothing starts from the boxes as proposed, so a second run changes nothing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from annotator.geometry.oriented_box import same_box
from annotator.project import REVIEWED, FramePart, Project, StoredFrame, StoredLabel, WriteContext, new_action
from annotator.project.changes import LabelChanged, TracksLinked
from annotator.project.classes.attributes import AttributeOf
from annotator.project.records import BoxRecord
from annotator.recordings.kitti import KittiFolder
from annotator.tracking.link import Seen, link, numbered
from annotator.tracking.smooth import TrackBox, smoothed
from annotator.types import OrientedBox, ReviewState, Source
from annotator.types.errors import FinalisedFrameError, StaleRevisionError
from annotator.types.label import AttributeValue
from annotator.workflows.tracks.timeline import Timeline

AUTHOR = "tracks"
LINKED_STATES = (ReviewState.PROPOSED, *REVIEWED)
# Frames per transaction: each transaction waits for the disk, and other writers wait for the transaction.
FRAMES_PER_WRITE = 50
# Attempts to link a recording whose frames are changed concurrently.
ATTEMPTS = 5
# Minimum weight of a proposal with a very low score.
MIN_WEIGHT = 0.05


@dataclass
class LinkSummary:
    """Counts of linking.

    Attributes:
        changed: number of labels with a new track id or box.
        left: number of labels without a track id in finalised frames, which are not changed.
        unordered: names of recordings left out because their frames are not a sequence.
        busy: names of recordings not fully linked because they were changed concurrently; link them again.
    """

    recordings: int = 0
    boxes: int = 0
    tracks: int = 0
    changed: int = 0
    left: int = 0
    unordered: tuple[str, ...] = ()
    busy: tuple[str, ...] = ()


def link_tracks(
    project: Project,
    *,
    recordings: Sequence[int] | None = None,
    smooth: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> LinkSummary:
    """Links the labels of recordings into tracks, except rejected labels.

    Args:
        recordings: ids; None = all.
        smooth: give unreviewed proposals the common size and smoothed heading of their track; otherwise restore the
            boxes as proposed.
        progress: called with (recordings done, recordings to do).
    """
    chosen = project.recordings.all() if recordings is None else [project.recordings.get(id) for id in recordings]
    summary = LinkSummary()
    for number, recording in enumerate(chosen, 1):
        if not recording.is_sequence:
            summary.unordered += (recording.name,)
        else:
            summary.recordings += 1
            for _ in range(ATTEMPTS):
                linked = _Recording(project, recording.id, smooth)
                if linked.store(summary):
                    break
            else:
                summary.busy += (recording.name,)
            summary.boxes += sum(stored.is_own for labels in linked.labels for stored in labels)
            first = (linked.labels[index][number] for track in linked.tracks for index, number in track.members[:1])
            summary.tracks += sum(stored.is_own for stored in first)
            summary.left += linked.left
        if progress is not None:
            progress(number, len(chosen))
    return summary


class _Recording:
    """A recording and the result of linking it.

    Attributes:
        numbers: the id of each track's labels without a given one.
        left: number of labels in finalised frames without an id.
    """

    def __init__(self, project: Project, recording_id: int, smooth: bool) -> None:
        self.project = project
        by_frame: dict[int, list[StoredLabel]] = defaultdict(list)
        for stored in project.labels.along(recording_id, states=LINKED_STATES):
            by_frame[stored.frame_id].append(stored)
        timeline = Timeline(project, recording_id)
        self.frames = [frame for frame in timeline.frames if frame.id in by_frame]
        self.labels = [by_frame[frame.id] for frame in self.frames]
        self.left = sum(
            stored.is_own and stored.label.track_id is None
            for frame, labels in zip(self.frames, self.labels, strict=True)
            if frame.finalised
            for stored in labels
        )
        self._proposed = project.proposals.boxes(recording_id)
        self._timeline = timeline
        # KITTI's cameras are on a moving car
        self._is_still = timeline.motion.is_known or not isinstance(timeline.recording, KittiFolder)
        self._times = [float(timeline.times[timeline.index[frame.id]]) for frame in self.frames]
        seen = [
            [Seen(stored.label.label, self._first(frame, stored), _given(stored, frame)) for stored in labels]
            for frame, labels in zip(self.frames, self.labels, strict=True)
        ]
        self.tracks = link(seen, self._times)
        self._values = self._values_along_tracks()
        members = [[self.labels[index][number].label.track_id for index, number in t.members] for t in self.tracks]
        previous = [[number for number in numbers if number is not None] for numbers in members]
        self.numbers = numbered([track.given for track in self.tracks], previous)
        self._boxes = {} if not smooth else self._smooth_boxes()

    def store(self, summary: LinkSummary) -> bool:
        """Writes the changes; returns False if a frame was changed in the meantime."""
        ids = {
            member: number for track, number in zip(self.tracks, self.numbers, strict=True) for member in track.members
        }
        parts: list[FramePart] = []
        counts: list[int] = []
        for index, (frame, labels) in enumerate(zip(self.frames, self.labels, strict=True)):
            if frame.finalised:
                continue
            own = [(number, stored) for number, stored in enumerate(labels) if stored.is_own]
            entries = [self._change(stored, frame, ids[index, number]) for number, stored in own]
            changed = tuple(entry for entry in entries if entry is not None)
            if changed:
                context = WriteContext(frame.revision, AUTHOR, Source.AUTO)
                parts.append(FramePart(frame.id, [TracksLinked(labels=changed)], context))
                counts.append(len(changed))
        action = new_action()
        for first in range(0, len(parts), FRAMES_PER_WRITE):
            try:
                self.project.log.append_to_frames(parts[first : first + FRAMES_PER_WRITE], action)
            except (StaleRevisionError, FinalisedFrameError):
                return False
            summary.changed += sum(counts[first : first + FRAMES_PER_WRITE])
        return True

    def _change(self, stored: StoredLabel, frame: StoredFrame, number: int) -> LabelChanged | None:
        label = stored.label
        is_given = _given(stored, frame) is not None
        is_new = not is_given and label.track_id != number
        box = self._boxes.get(label.uid, self._box(stored))
        # compared as records, since these are what is stored
        record = BoxRecord.of(box)
        is_moved = self._may_move(stored) and record != BoxRecord.of(label.box)
        values = self._values.get(label.uid, {})
        if not is_new and not is_moved and not values:
            return None
        tracked = {} if is_given else {"track_id": number}
        return LabelChanged(uid=label.uid, box=record if is_moved else None, attributes=values, **tracked)

    def _values_along_tracks(self) -> dict[str, dict[str, AttributeValue]]:
        """Returns the values of their track that labels lack, by uid.

        The value of a track is that of its first reviewed label with one, else of its first label with one. Reviewed
        labels that contradict it keep theirs; proposals may have been in another track before.
        """
        of_tracks = [each for each in self.project.config.attributes if each.of is AttributeOf.TRACK]
        lacking: dict[str, dict[str, AttributeValue]] = {}
        for track in self.tracks if of_tracks else ():
            members = [self.labels[index][number].label for index, number in track.members]
            for each in of_tracks:
                known = [label for label in members if each.name in label.attributes]
                if not known:
                    continue
                value = next((label for label in known if label.state in REVIEWED), known[0]).attributes[each.name]
                for label in members:
                    is_free = label.state not in REVIEWED or each.name not in label.attributes
                    if each.is_of(label.label) and is_free and label.attributes.get(each.name) != value:
                        lacking.setdefault(label.uid, {})[each.name] = value
        return lacking

    def _box(self, stored: StoredLabel) -> OrientedBox:
        """Returns a label's box as proposed, or as changed by an operator."""
        return self._proposed[stored.label.uid] if self._may_move(stored) else stored.label.box

    def _first(self, frame: StoredFrame, stored: StoredLabel) -> OrientedBox:
        """Returns that box as the camera of the first frame would see it: so only the object's own motion is left."""
        return self._timeline.moved(self._box(stored), self._timeline.index[frame.id], 0)

    def _may_move(self, stored: StoredLabel) -> bool:
        """Returns True for unreviewed proposals of the recursion; interpolated ones are smooth already."""
        return stored.label.state is ReviewState.PROPOSED and stored.label.uid in self._proposed

    def _smooth_boxes(self) -> dict[str, OrientedBox]:
        smoothed_boxes: dict[str, OrientedBox] = {}
        for track in self.tracks:
            members = [self.labels[index][number] for index, number in track.members]
            boxes = []
            for (index, _), each in zip(track.members, members, strict=True):
                score = 1.0 if each.label.score is None else float(np.clip(each.label.score, MIN_WEIGHT, 1.0))
                is_fixed = self.frames[index].finalised or not self._may_move(each)
                box = self._first(self.frames[index], each)
                boxes.append(TrackBox(self._times[index], box, score, is_fixed))
            smooth = zip(track.members, members, boxes, smoothed(boxes, self._is_still), strict=True)
            for (index, _), each, before, box in smooth:
                if not before.is_fixed and not same_box(before.box, box):
                    place = self._timeline.index[self.frames[index].id]
                    smoothed_boxes[each.label.uid] = self._timeline.moved(box, 0, place)
        return smoothed_boxes


def _given(stored: StoredLabel, frame: StoredFrame) -> int | None:
    """Returns a track id that must stay: given by an operator or a file, in a finalised frame or another camera's."""
    return None if stored.track_linked and stored.is_own and not frame.finalised else stored.label.track_id
