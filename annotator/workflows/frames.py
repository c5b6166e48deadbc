"""The frames of a project, read from its recordings one at a time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from annotator.files import why_missing
from annotator.project.config import BoxRotation
from annotator.project.frames import StoredFrame
from annotator.project.project import Project
from annotator.project.recordings import StoredRecording
from annotator.rcv.config import Orientation
from annotator.recordings import Recording, open_recording
from annotator.types import Frame
from annotator.types.errors import FrameError, RecordingError


class FrameSource:
    """Reads frames of a project; each recording is opened once, no frame is kept."""

    def __init__(self, project: Project) -> None:
        self._project = project
        self._stored: dict[int, StoredRecording] = {}
        self._opened: dict[int, tuple[Recording, dict[str, int]]] = {}

    def stored(self, recording_id: int) -> StoredRecording:
        """What the project knows of a recording."""
        if recording_id not in self._stored:
            self._stored[recording_id] = self._project.recordings.get(recording_id)
        return self._stored[recording_id]

    def recording(self, recording_id: int) -> Recording:
        """The opened recording.

        Raises:
            RecordingError: it is not where it was, or not readable.
        """
        return self._open(recording_id)[0]

    def read(self, frame: StoredFrame) -> Frame:
        """One frame, with the up direction that the project was told, if any.

        Raises:
            FrameError: the frame cannot be read, or is no longer there.
            RecordingError: the recording is not where it was.
        """
        recording, places = self._open(frame.recording_id)
        if frame.key not in places:
            raise FrameError(
                Path(recording.path), f"frame {frame.key} is no longer there", "bring it back, or add the folder anew"
            )
        read = recording.frame(places[frame.key])
        up = self.stored(frame.recording_id).up
        return read if up is None else replace(read, up=np.asarray(up, np.float64))

    def _open(self, recording_id: int) -> tuple[Recording, dict[str, int]]:
        if recording_id not in self._opened:
            stored = self.stored(recording_id)
            missing = why_missing(stored.path)
            if missing is not None:
                raise RecordingError(
                    f"{stored.path}: {missing}; bring {stored.name} back, or say where it is now: "
                    f"annotator move {self._project.path.name} {stored.name} PATH, or Locate on the start page"
                )
            recording = open_recording(stored.path)
            self._opened[recording_id] = (recording, {key: i for i, key in enumerate(recording.keys)})
        return self._opened[recording_id]


def orientation_for(rotation: BoxRotation, frame: Frame) -> Orientation:
    """Which rotations boxes of this frame may have: AUTO is upright where gravity is known."""
    if rotation is BoxRotation.AUTO:
        return Orientation.FREE if frame.up is None else Orientation.UPRIGHT
    return Orientation(rotation.value)
