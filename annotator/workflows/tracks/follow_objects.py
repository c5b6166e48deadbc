"""Follows objects from reviewed boxes, frame by frame, forward or backward: the walks, and what they have found."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from annotator.geometry.iou import iou_3d
from annotator.rcv.config import RcvConfig
from annotator.rcv.follow_object import Followed, Look, follow_object
from annotator.tracking.link import predicted
from annotator.types import Detector, Frame, OrientedBox, Proposal
from annotator.workflows.tracks.timeline import KeyFrame, Moment, moved

# Number of last boxes from which the motion is estimated.
MOTION_BOXES = 3


class Follower:
    """Follows one object, one frame at a time, until it is not found."""

    def __init__(
        self,
        first: Moment,
        start: OrientedBox,
        label: str,
        view: Detector | None,
        settings: Callable[[Frame], RcvConfig],
    ) -> None:
        """
        Args:
            start: the reviewed box, camera frame.
            view: view detector that was trained on the class, or None.
            settings: the recursion's settings for a frame and this detector.
        """
        self._label, self._view, self._settings = label, view, settings
        self._reviewed = self._last = Look.of(first.frame.cloud.xyz_m, start)
        self._seen = [(start, first.T_camera_world, first.time)]

    def expected(self, moment: Moment) -> OrientedBox:
        """The box at another time, if the object keeps its motion in the world."""
        boxes = [moved(box, T_camera_world, moment.T_camera_world) for box, T_camera_world, _ in self._seen]
        return predicted(boxes, [time for *_, time in self._seen], moment.time)

    def step(self, moment: Moment) -> Followed:
        """Looks for the object in the next frame; after a frame in which it is not found, there is no next step."""
        guess, config = self.expected(moment), self._settings(moment.frame)
        looks = self._reviewed, self._last
        followed = follow_object(moment.frame, guess, *looks, self._label, self._view, config)
        if followed.proposal is not None:
            seen = followed.proposal.box, moment.T_camera_world, moment.time
            self._seen = [*self._seen, seen][-MOTION_BOXES:]
            self._last = Look.of(moment.frame.cloud.xyz_m, followed.proposal.box, followed.kept)
        return followed


# Boxes found by following forward and backward are the same with at least this IoU.
SAME_BOX_IOU = 0.5


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
        track_id: None while it has no track.
        doubtful: number of frames left out because following forward and backward gave different boxes.
        stops: where it was lost before the next reviewed box or the end of the recording.
        is_open: whether it was to be followed to an end of the recording, not only to its next reviewed box.
    """

    uid: str
    track_id: int | None
    label: str
    boxes: int
    doubtful: int
    stops: tuple[StoppedAt, ...]
    is_open: bool


Ends = tuple[KeyFrame | None, KeyFrame | None]
"""Two reviewed boxes of an object, the earlier one first; or one, and an end of the recording (None)."""


def between(ends: Ends, frames: int) -> range:
    """Indices of the frames between two ends, in a recording with so many frames."""
    before, after = ends
    return range(0 if before is None else before.index + 1, frames if after is None else after.index)


@dataclass(eq=False)
class Part:
    """The frames between two ends, through which an object is followed from each of its reviewed boxes there.

    Attributes:
        is_joined: the object was found at one of these boxes when it was followed from the other one.
    """

    walks: list[Walk] = field(default_factory=list)
    is_joined: bool = False
    is_taken: bool = False

    @property
    def is_open(self) -> bool:
        """Whether it goes to an end of the recording."""
        return len(self.walks) == 1


@dataclass(eq=False)
class Walk:
    """An object on its way from one reviewed box.

    Attributes:
        left: the frames still to come.
        boxes: those found, by frame.
        new: the proposals of those that are not taken.
    """

    item: FollowedObject
    part: Part
    key: KeyFrame
    left: deque[int]
    follower: Follower | None = None
    boxes: dict[int, OrientedBox] = field(default_factory=dict)
    new: dict[int, Proposal] = field(default_factory=dict)

    def end(self) -> None:
        """Ends it; boxes that are not taken are dropped."""
        self.left.clear()
        for index in self.new:
            del self.boxes[index]
        self.new.clear()


class FollowedObject:
    """An object, and its result so far.

    Attributes:
        keys: its reviewed boxes; those at the start in order, then those met on the way.
        track_id: None while it has no track.
        met: the keys met on the way, until their track is stored.
        passed: the frames in which it was found, met or lost, and those that it would have come to after that.
        proposed: uid of its new proposal, by frame.
        uids: of all its new proposals, also replaced ones.
        doubtful: the frames in which following forward and backward gave different boxes.
    """

    def __init__(self, ends: Sequence[Ends], frames: int) -> None:
        """At its start, between each pair of ends, in a recording with so many frames."""
        self.parts: list[Part] = []
        for before, after in ends:
            self.parts.append(part := Part())
            inside = between((before, after), frames)
            for key, indices in ((before, inside), (after, reversed(inside))):
                if key is not None:
                    part.walks.append(Walk(self, part, key, deque(indices)))
        keys = {key.label.uid: key for pair in ends for key in pair if key is not None}
        self.keys = sorted(keys.values(), key=lambda key: key.index)
        self.label = self.keys[0].label
        self.track_id = self.label.track_id
        self.met: list[KeyFrame] = []
        self.passed: set[int] = set()
        self.proposed: dict[int, str] = {}
        self.uids: set[str] = set()
        self.doubtful: set[int] = set()
        self.stops: list[StoppedAt] = []

    @property
    def walks(self) -> list[Walk]:
        return [walk for part in self.parts for walk in part.walks]

    def has(self, uid: str) -> bool:
        """Whether a label is one of its reviewed boxes."""
        return any(key.label.uid == uid for key in self.keys)

    def meet(self, key: KeyFrame, walk: Walk, is_found: bool) -> int:
        """Goes on from a reviewed box on the way, which from now on is its own; follows it back from there, too.

        Args:
            is_found: the object was found there, not only expected.

        Returns:
            The number of frames to go back.
        """
        if not self.has(key.label.uid):
            self.keys.append(key)
            self.met.append(key)
        inside = range(*sorted((walk.key.index, key.index)))[1:]
        back = inside if key.index < walk.key.index else reversed(inside)
        part, beyond = walk.part, Part()
        beyond.walks.append(Walk(self, beyond, key, deque(walk.left)))
        for other in part.walks:
            if other is not walk:
                other.part, other.left = beyond, deque(index for index in other.left if index in walk.left)
                beyond.walks.append(other)
        walk.left.clear()
        part.walks, part.is_joined = [walk, Walk(self, part, key, deque(back))], is_found
        self.parts.append(beyond)
        return len(inside)

    def take(self, ended: bool) -> dict[int, Proposal]:
        """Returns the boxes that can be stored now, and have not been taken.

        Those between two reviewed boxes can be stored once both directions are done, or once the run has ended.
        """
        taken: dict[int, Proposal] = {}
        for part in self.parts:
            if part.is_open:
                found = dict.fromkeys(part.walks[0].new, part.walks[0])
            elif not part.is_taken and (ended or not any(walk.left for walk in part.walks)):
                found, part.is_taken = self._agreed(part), True
            else:
                continue
            taken |= {index: walk.new.pop(index) for index, walk in found.items() if index in walk.new}
        return taken

    def _agreed(self, part: Part) -> dict[int, Walk]:
        """Returns who has found each box: of two that agree, the one from the nearer reviewed box.

        If the object was followed from one to the other, the boxes are of the same object, and none is left out.
        """
        ahead, back = part.walks
        agreed = dict.fromkeys(ahead.boxes, ahead)
        for index, box in back.boxes.items():
            own = ahead.boxes.get(index)
            if own is not None and not part.is_joined and iou_3d(own, box) < SAME_BOX_IOU:
                del agreed[index]
                self.doubtful.add(index)
                self.proposed.pop(index, None)
            elif own is None or abs(back.key.index - index) < abs(ahead.key.index - index):
                agreed[index] = back
        return agreed

    def end(self) -> None:
        """Ends all its walks."""
        for walk in self.walks:
            walk.end()

    def result(self) -> FollowedTrack:
        """What became of it so far."""
        counts = len(self.proposed), len(self.doubtful)
        is_open = any(part.is_open for part in self.parts)
        return FollowedTrack(self.label.uid, self.track_id, self.label.label, *counts, tuple(self.stops), is_open)
