"""Follows a reviewed box from frame to frame, forward or backward."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from annotator.project import Project, StoredFrame
from annotator.rcv.config import RcvConfig
from annotator.rcv.follow_object import FollowConfig, Followed, Look, follow_object
from annotator.tracking.link import predicted
from annotator.types import Detector, Frame, OrientedBox
from annotator.types.errors import ConfigError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.link import times_of

# Number of last boxes from which the motion is estimated.
MOTION_BOXES = 3
DEFAULTS = FollowConfig()


@dataclass(frozen=True, eq=False)
class Moment:
    """A frame and its time, in any unit; times decrease if an object is followed backward."""

    index: int
    frame: Frame
    time: float


class Follower:
    """Follows one object, one frame at a time, until it is not found."""

    def __init__(
        self,
        first: Moment,
        start: OrientedBox,
        label: str,
        view: Detector | None,
        settings: Callable[[Frame], RcvConfig],
        limits: FollowConfig = DEFAULTS,
    ) -> None:
        """
        Args:
            first: the frame of the reviewed box.
            start: the reviewed box, camera frame.
            view: view detector that was trained on the class, or None.
            settings: the recursion's settings for a frame and this detector.
        """
        self._label, self._view, self._settings, self._limits = label, view, settings, limits
        self._reviewed = self._last = Look.of(first.frame.cloud.xyz_m, start)
        self._boxes, self._times = [start], [first.time]

    def expected(self, moment: Moment) -> OrientedBox:
        """The box at another time, if the object keeps its motion."""
        return predicted(self._boxes[-MOTION_BOXES:], self._times[-MOTION_BOXES:], moment.time)

    def step(self, moment: Moment) -> Followed:
        """Looks for the object in the next frame; after a frame in which it is not found, there is no next step."""
        guess = self.expected(moment)
        config = self._settings(moment.frame)
        followed = follow_object(
            moment.frame, guess, self._reviewed, self._last, self._label, self._view, config, self._limits
        )
        if followed.proposal is not None:
            self._boxes.append(followed.proposal.box)
            self._times.append(moment.time)
            self._last = Look.of(moment.frame.cloud.xyz_m, followed.proposal.box, followed.kept)
        return followed


# Objects that are followed from the same frame need the same frames at about the same time; others read them again.
FRAMES_KEPT = 4


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
