"""Follows a reviewed box through a recording, forward or backward, until the object is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from annotator.rcv.config import RcvConfig
from annotator.rcv.follow_object import FollowConfig, Followed, expected_points, follow_object, points_in
from annotator.tracking.motion import predicted
from annotator.types import Detector, Frame, OrientedBox

# Number of last boxes from which the motion is estimated.
MOTION_BOXES = 3
DEFAULTS = FollowConfig()


@dataclass(frozen=True, eq=False)
class Moment:
    """A frame and its time, in any unit; times decrease if an object is followed backward."""

    index: int
    frame: Frame
    time: float


def follow_frames(
    first: Moment,
    start: OrientedBox,
    label: str,
    later: Iterable[Moment],
    view: Detector,
    settings: Callable[[Frame], RcvConfig],
    limits: FollowConfig = DEFAULTS,
) -> Iterator[tuple[Moment, Followed]]:
    """Yields the result of each frame, up to the first one in which the object is not found.

    Args:
        first: the frame of the reviewed box.
        start: the reviewed box, camera frame.
        later: the next frames, in the direction of following.
        settings: the recursion's settings for a frame and the view detector.
    """
    boxes, times, points = [start], [first.time], points_in(first.frame, start)
    for moment in later:
        guess = predicted(boxes[-MOTION_BOXES:], times[-MOTION_BOXES:], moment.time)
        expected = expected_points(points, boxes[-1], guess)
        config = settings(moment.frame)
        followed = follow_object(moment.frame, guess, start.size_m, expected, label, view, config, limits)
        yield moment, followed
        if followed.proposal is None:
            return
        boxes.append(followed.proposal.box)
        times.append(moment.time)
        points = points_in(moment.frame, followed.proposal.box)
