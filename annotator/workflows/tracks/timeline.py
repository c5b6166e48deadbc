"""The frames of a recording in time."""

from __future__ import annotations

from collections import OrderedDict

from annotator.project import Project, StoredFrame
from annotator.types import Frame
from annotator.types.errors import ConfigError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.follow_frames import Moment
from annotator.workflows.tracks.times import times_of

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
