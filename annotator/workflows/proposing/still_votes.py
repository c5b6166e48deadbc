"""One proposal for an object that stands still, in place of those of the frames: what passes found is put to the vote.

A pass looks at each frame alone. Where the recording has poses, the boxes of several frames that agree in the world
become one open still object (`rcv.votes`), which each frame that sees it shows: one look and one key take it. Objects
of a class that stands still need two such frames; of a class of which nobody has said so, a span of frames through
which the box does not move. What moves, or has no partner, stays a proposal of its frame.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

import numpy as np

from annotator.geometry.iou import iou_3d, iou_3d_matrix
from annotator.project import FramePart, Project, StoredFrame, WriteContext
from annotator.project.changes import LabelDeleted, Payload, StillProposal, StillsProposed
from annotator.rcv.votes import SAME_IOU, Agreed, Vote, agreed, grouped
from annotator.types import BoxKind, OrientedBox, ReviewState, Source
from annotator.types.errors import FinalisedFrameError, StaleRevisionError, TrackTakenError
from annotator.workflows.tracks.still_objects import find_sightings

AUTHOR = "rcv"  # of proposals
# Of a class of which nobody has said whether it stands still: the least span, in frames, and the least IoU of the boxes
# that its first and its second half agree on.
LEAST_SPAN, STEADY_IOU = 20, 0.5
# Attempts to write to frames that are changed meanwhile.
ATTEMPTS = 5


def vote_stills(
    project: Project,
    recordings: Sequence[int],
    author: str,
    action: str,
    box_kind: BoxKind = BoxKind.BOX,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> int:
    """Proposes what stands still in the rigs of recordings, in place of the open proposals of it; returns how many.

    Args:
        author, action: of the pass, of which this is a part.
        box_kind: what the proposed boxes enclose.
        progress: called with (moments done, moments) while they are looked through; its exceptions end that.
    """
    count, done = 0, set[int]()
    # each pass leaves a row for each object and moment; those of the one before stay for an undo of this one
    project.stills.forget()
    for recording_id in recordings:
        stored = project.recordings.get(recording_id)
        if stored.rig_id in done or not project.stills.poses(recording_id):
            continue
        done.add(stored.rig_id)
        for attempt in range(1, ATTEMPTS + 1):
            try:
                count += _Rig(project, stored.rig_id).propose(author, action, box_kind)
                break
            except (StaleRevisionError, FinalisedFrameError, TrackTakenError):  # by an operator, meanwhile
                if attempt == ATTEMPTS:
                    raise
        find_sightings(project, recording_id, progress=progress)
    return count


class _Rig:
    """A rig, with what the latest passes have found in its frames."""

    def __init__(self, project: Project, rig_id: int) -> None:
        self._project = project
        self._recordings = [each.id for each in project.recordings.all() if each.rig_id == rig_id]
        self._poses = {id: T.inv() for each in self._recordings for id, T in project.stills.poses(each).items()}
        frames = [frame for frame in project.frames.of(self._recordings) if frame.id in self._poses]
        known = [frame for frame in frames if frame.index is not None]
        self._frames = sorted(known, key=lambda frame: (frame.index or 0, frame.id))
        found = {id: each for recording in self._recordings for id, each in project.proposals.found(recording).items()}
        moving = {name for name, style in project.config.class_styles.items() if style.still is False}
        self._votes = [
            Vote(number, self._poses[frame.id], each.label, each.box, each.score, each.edges)
            for number, frame in enumerate(self._frames)
            for each in found.get(frame.id, ())
            if each.label not in moving
        ]

    def propose(self, author: str, action: str, box_kind: BoxKind) -> int:
        project, earlier = self._project, _open_stills(self._project, self._recordings)
        taken = self._reviewed()
        objects = agreed(list(filter(self._stands_still, grouped(self._votes))))
        objects = [each for each in objects if not _covered(each, taken.get(each.label, []))]
        here = next((frame for frame in self._frames if not frame.finalised), None)
        if here is None or not (objects or earlier):
            return 0
        first_track = project.labels.next_track_id(here.recording_id)
        new = [
            StillProposal(
                each.label,
                each.box.transformed(self._poses[here.id].inv()),
                first_track + number,
                each.score,
                each.expected_iou_loss,
                box_kind,
            )
            for number, each in enumerate(objects)
        ]
        events: dict[int, list[Payload]] = defaultdict(list, {here.id: [StillsProposed(new, earlier)]})
        of_moment = {here.moment_id: here.id}
        for frame, uid in self._replaced(objects):
            events[of_moment.setdefault(frame.moment_id, frame.id)].append(LabelDeleted(uid=uid))
        revisions = {frame.id: frame.revision for frame in self._frames}
        parts = [
            FramePart(id, payloads, WriteContext(revisions[id], author, Source.AUTO, maker=AUTHOR))
            for id, payloads in events.items()
        ]
        project.log.append_to_frames(parts, action, [each.track_id for each in new])
        return len(new)

    def _stands_still(self, group: Sequence[Vote]) -> bool:
        style = self._project.config.class_styles.get(group[0].label)
        if style is not None and style.still:
            return True
        first, last = (self._frames[vote.frame].index or 0 for vote in (group[0], group[-1]))
        if last - first < LEAST_SPAN or len(group) < 4:
            return False
        half = len(group) // 2
        both = [agreed([part]) for part in (group[:half], group[half:])]
        return all(both) and iou_3d(both[0][0].box, both[1][0].box) >= STEADY_IOU

    def _reviewed(self) -> dict[str, list[OrientedBox]]:
        """Where labels stay, in the world, by class."""
        found = defaultdict[str, list[OrientedBox]](list)
        for one in self._project.stills.of(self._recordings[0]):
            if not one.is_open:  # once, and not in each of thousands of frames
                found[one.label].append(one.box)
        for each in self._project.labels.select(recordings=self._recordings):
            is_open = each.label.state is ReviewState.PROPOSED
            if not is_open and each.still is None and each.frame_id in self._poses:
                found[each.label.label].append(each.label.box.transformed(self._poses[each.frame_id]))
        return found

    def _replaced(self, objects: Sequence[Agreed]) -> list[tuple[StoredFrame, str]]:
        """The open proposals that the objects' votes became, with their frames."""
        project = self._project
        votes = {(vote.frame, *vote.box.center_m.round(5).tolist()) for each in objects for vote in each.votes}
        frames = {frame.id: (number, frame) for number, frame in enumerate(self._frames) if not frame.finalised}
        proposed = {uid: box for each in self._recordings for uid, box in project.proposals.boxes(each).items()}
        kept = project.labels.kept(*frames)
        return [
            (frames[each.made_in][1], each.label.uid)
            for each in project.labels.select(states=[ReviewState.PROPOSED], recordings=self._recordings)
            if each.still is None and each.made_in in frames and each.label.uid in proposed
            if not each.said and each.label.uid not in kept
            if (frames[each.made_in][0], *proposed[each.label.uid].center_m.round(5).tolist()) in votes
        ]


def _open_stills(project: Project, recordings: Sequence[int]) -> list[str]:
    """The uids of a rig's open still objects."""
    return [each.uid for each in project.stills.of(recordings[0]) if each.is_open]


def _covered(found: Agreed, boxes: Sequence[OrientedBox]) -> bool:
    return bool(boxes) and bool(np.max(iou_3d_matrix([found.box], boxes)) >= SAME_IOU)
