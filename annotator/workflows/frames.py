"""The frames of a project, read from its recordings one at a time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
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


@dataclass(frozen=True, eq=False)
class OpenedRecording:
    """A recording that is open; no frame is kept.

    Attributes:
        recording: as its reader gives it.
        up: unit vector against gravity in the camera frame, where the project was told one.
        places: of each key its place in the recording.
    """

    recording: Recording
    up: tuple[float, float, float] | None
    places: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "places", {key: place for place, key in enumerate(self.recording.keys)})

    def read(self, key: str) -> Frame:
        """One frame, with the up direction that the project was told, if any.

        Raises:
            FrameError: the frame cannot be read, or is no longer there.
        """
        if key not in self.places:
            raise FrameError(
                Path(self.recording.path), f"frame {key} is no longer there", "bring it back, or add the folder anew"
            )
        read = self.recording.frame(self.places[key])
        return read if self.up is None else replace(read, up=np.asarray(self.up, np.float64))


def open_stored(path: Path, name: str, project: str, up: tuple[float, float, float] | None) -> OpenedRecording:
    """A recording of a project.

    Args:
        path: where it is.
        name: within the project.
        project: the project's name.
        up: as in `OpenedRecording`.

    Raises:
        RecordingError: it is not where it was, or not readable.
    """
    missing = why_missing(path)
    if missing is not None:
        raise RecordingError(
            f"{path}: {missing}; bring {name} back, or say where it is now: "
            f"annotator move {project} {name} PATH, or Locate on the start page"
        )
    return OpenedRecording(open_recording(path), up)


class FrameSource:
    """Reads frames of a project; each recording is opened once, no frame is kept."""

    def __init__(self, project: Project) -> None:
        self._project = project
        self._stored: dict[int, StoredRecording] = {}
        self._opened: dict[int, OpenedRecording] = {}

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
        return self._open(recording_id).recording

    def read(self, frame: StoredFrame) -> Frame:
        """One frame, with the up direction that the project was told, if any.

        Raises:
            FrameError: the frame cannot be read, or is no longer there.
            RecordingError: the recording is not where it was.
        """
        return self._open(frame.recording_id).read(frame.key)

    def _open(self, recording_id: int) -> OpenedRecording:
        if recording_id not in self._opened:
            stored = self.stored(recording_id)
            self._opened[recording_id] = open_stored(stored.path, stored.name, self._project.path.name, stored.up)
        return self._opened[recording_id]


def orientation_for(rotation: BoxRotation, frame: Frame) -> Orientation:
    """Which rotations boxes of this frame may have: AUTO is upright where gravity is known."""
    if rotation is BoxRotation.AUTO:
        return Orientation.FREE if frame.up is None else Orientation.UPRIGHT
    return Orientation(rotation.value)
