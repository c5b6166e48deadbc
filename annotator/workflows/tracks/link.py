"""`annotator track`: the boxes of a recording linked into tracks, and open proposals smoothed over theirs.

An automatic pass: it gives track ids, and better boxes to proposals that wait for a review. What people have reviewed
keeps its box; ids that people (or files) have given stay, and so does everything in finalised frames. It starts from
what was proposed, not from what it made of that before, so that a second run changes nothing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from annotator.project import REVIEWED, Change, FramePart, Project, StoredFrame, StoredLabel
from annotator.project.payloads import LinkedLabel, TracksLinked
from annotator.project.records import BoxRecord
from annotator.recordings.kitti_folder import KittiFolder
from annotator.tracking.config import TrackingConfig
from annotator.tracking.link import Seen, Track, link
from annotator.tracking.numbers import numbered
from annotator.tracking.smooth import TrackBox, smoothed
from annotator.types import OrientedBox, ReviewState, Source
from annotator.types.errors import FinalisedFrameError, StaleRevisionError
from annotator.workflows.frames import FrameSource
from annotator.workflows.tracks.times import times_of

AUTHOR = "tracks"
LINKED_STATES = (ReviewState.PROPOSED, *REVIEWED)
# Frames that are written in one transaction: each costs a wait for the disk, and others wait meanwhile.
FRAMES_AT_ONCE = 50
# How often a recording is linked anew because somebody has changed one of its frames meanwhile.
ATTEMPTS = 5
# A proposal without a score, or with next to none, still counts for something.
LEAST_WEIGHT = 0.05


@dataclass
class LinkSummary:
    """What linking did.

    Attributes:
        recordings: that were linked.
        boxes: labels in their tracks.
        tracks: how many these are.
        changed: labels that got another track id or box.
        left: labels without a track id in finalised frames, which stay as they are.
        unordered: names of recordings that were left out because their frames do not follow each other in time.
        busy: names of recordings that somebody went on changing; linking them again finishes them.
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
    config: TrackingConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> LinkSummary:
    """Links the labels of recordings into tracks, rejected ones left out.

    Args:
        recordings: ids; None = all.
        smooth: give open proposals the size and the smooth heading of their track; otherwise they get back the boxes
            that they were proposed with.
        config: how boxes are linked.
        progress: called with (recordings done, recordings to do).

    Raises:
        NotFoundError: no such recording.
        RecordingError: a recording is not where it was.
    """
    chosen = project.recordings.all() if recordings is None else [project.recordings.get(id) for id in recordings]
    summary, config = LinkSummary(), config or TrackingConfig()
    for number, recording in enumerate(chosen, 1):
        if not recording.is_sequence:
            summary.unordered += (recording.name,)
        else:
            summary.recordings += 1
            for _ in range(ATTEMPTS):
                linked = _Recording(project, recording.id, config, smooth)
                if linked.store(summary):
                    break
            else:
                summary.busy += (recording.name,)
            summary.boxes += sum(len(labels) for labels in linked.labels)
            summary.tracks += len(linked.tracks)
            summary.left += linked.left
        if progress is not None:
            progress(number, len(chosen))
    return summary


class _Recording:
    """One recording as it is now, and what linking makes of it.

    Attributes:
        frames: those that have labels, in order.
        labels: of each of them.
        tracks, numbers: the objects, and the id of each.
        left: labels in finalised frames that have no id.
    """

    def __init__(self, project: Project, recording_id: int, config: TrackingConfig, smooth: bool) -> None:
        self.project = project
        by_frame: dict[int, list[StoredLabel]] = defaultdict(list)
        for stored in project.labels.select(states=LINKED_STATES, recordings=[recording_id]):
            by_frame[stored.frame_id].append(stored)
        present = [frame for frame in project.frames.of([recording_id]) if frame.index is not None]
        self.frames = [frame for frame in present if frame.id in by_frame]
        self.labels = [by_frame[frame.id] for frame in self.frames]
        self.left = sum(
            stored.label.track_id is None
            for frame, labels in zip(self.frames, self.labels, strict=True)
            if frame.finalised
            for stored in labels
        )
        self._proposed = project.proposals.boxes(recording_id)
        recording = FrameSource(project).recording(recording_id)
        every = times_of(recording, present)
        # KITTI's cameras drive
        self._is_still = not isinstance(recording, KittiFolder)
        times = dict(zip((frame.id for frame in present), every.tolist(), strict=True))
        self._times = [times[frame.id] for frame in self.frames]
        seen = [
            [Seen(stored.label.label, self._box(stored), _given(stored, frame)) for stored in labels]
            for frame, labels in zip(self.frames, self.labels, strict=True)
        ]
        self.tracks = link(seen, self._times, config)
        self.numbers = _numbers(self.tracks, self.labels)
        self._boxes = {} if not smooth else self._smooth_boxes(config)

    def store(self, summary: LinkSummary) -> bool:
        """Writes what is new, some frames at once; False where somebody has changed a frame meanwhile."""
        ids = {
            member: number for track, number in zip(self.tracks, self.numbers, strict=True) for member in track.members
        }
        parts: list[FramePart] = []
        counts: list[int] = []
        for place, (frame, labels) in enumerate(zip(self.frames, self.labels, strict=True)):
            if frame.finalised:
                continue
            entries = [self._change(stored, frame, ids[place, number]) for number, stored in enumerate(labels)]
            changed = tuple(entry for entry in entries if entry is not None)
            if changed:
                change = Change(frame.revision, AUTHOR, Source.AUTO)
                parts.append(FramePart(frame.id, [TracksLinked(labels=changed)], change))
                counts.append(len(changed))
        for first in range(0, len(parts), FRAMES_AT_ONCE):
            try:
                self.project.log.append_to_frames(parts[first : first + FRAMES_AT_ONCE])
            except (StaleRevisionError, FinalisedFrameError):
                return False
            summary.changed += sum(counts[first : first + FRAMES_AT_ONCE])
        return True

    def _change(self, stored: StoredLabel, frame: StoredFrame, number: int) -> LinkedLabel | None:
        label = stored.label
        is_given = _given(stored, frame) is not None
        is_new = not is_given and label.track_id != number
        box = self._boxes.get(label.uid, self._box(stored))
        # as it will be read back: what is the same to the last bit is no change
        record = BoxRecord.of(box)
        is_moved = self._may_move(stored) and record != BoxRecord.of(label.box)
        if not is_new and not is_moved:
            return None
        return LinkedLabel(uid=label.uid, track_id=None if is_given else number, box=record if is_moved else None)

    def _box(self, stored: StoredLabel) -> OrientedBox:
        """A label's box as it was proposed, or as a person has made it."""
        return self._proposed[stored.label.uid] if self._may_move(stored) else stored.label.box

    def _may_move(self, stored: StoredLabel) -> bool:
        """True for open proposals of the recursion; those between key frames are smooth already."""
        return stored.label.state is ReviewState.PROPOSED and stored.label.uid in self._proposed

    def _smooth_boxes(self, config: TrackingConfig) -> dict[str, OrientedBox]:
        found: dict[str, OrientedBox] = {}
        for track in self.tracks:
            members = [self.labels[place][number] for place, number in track.members]
            boxes = [
                TrackBox(self._times[place], self._box(each), _weight(each), self._is_fixed(each, self.frames[place]))
                for (place, _), each in zip(track.members, members, strict=True)
            ]
            smooth = zip(members, boxes, smoothed(boxes, config, self._is_still), strict=True)
            found |= {each.label.uid: box for each, before, box in smooth if not before.is_fixed}
        return found

    def _is_fixed(self, stored: StoredLabel, frame: StoredFrame) -> bool:
        return frame.finalised or not self._may_move(stored)


def _given(stored: StoredLabel, frame: StoredFrame) -> int | None:
    """The track id that stays: somebody gave it, or the frame is finalised."""
    return None if stored.track_linked and not frame.finalised else stored.label.track_id


def _weight(stored: StoredLabel) -> float:
    score = stored.label.score
    return 1.0 if score is None else float(np.clip(score, LEAST_WEIGHT, 1.0))


def _numbers(tracks: Sequence[Track], labels: Sequence[Sequence[StoredLabel]]) -> list[int]:
    before = [
        [known for place, number in track.members if (known := labels[place][number].label.track_id) is not None]
        for track in tracks
    ]
    return numbered([track.given for track in tracks], before)
