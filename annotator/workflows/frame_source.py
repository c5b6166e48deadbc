"""Reads the frames of a project from its recordings, and tells which labels of a moment they show."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from scipy.spatial.transform import RigidTransform

from annotator.files import why_missing
from annotator.formats.nuscenes import is_seen
from annotator.geometry.oriented_box import corrected, with_image
from annotator.project import BoxRotation, Project, StoredFrame, StoredRecording
from annotator.project.recordings import SharedCloud
from annotator.rcv.config import Orientation
from annotator.recordings import Recording, open_recording, stored_options
from annotator.recordings.frame_times import image_at
from annotator.recordings.look_around import RigCamera
from annotator.types import Frame, Label
from annotator.types.errors import FrameError, RecordingError


@dataclass(frozen=True, eq=False)
class OpenedRecording:
    """An open recording of a project; frames are not cached.

    Attributes:
        stored: what the project sets over its files; None for one that is not in it.
        estimated: id of the event that set estimated poses; 0 = the files' poses hold.
        poses: these, `T_world_camera` with the correction, by key.
    """

    recording: Recording
    stored: StoredRecording | None
    estimated: int = 0
    poses: Mapping[str, RigidTransform] = field(default_factory=dict)

    def read(self, key: str) -> Frame:
        """Reads a frame, with the project's correction of the calibration and its up direction."""
        index = self.index(key)
        frame = self.recording.frame(index)
        if self.stored is None:
            return frame
        correction, up = self.stored.correction, self.stored.up
        if correction.time_offset_s:
            shown = image_at(self.recording, index, correction.time_offset_s)
            frame = frame if shown == index else with_image(frame, self.recording.image(shown))
        frame = corrected(frame, correction)
        if self.estimated:
            frame = replace(frame, T_world_camera=self.poses.get(key), in_map=False)
        return frame if up is None else replace(frame, up=np.asarray(up, np.float64))

    def image(self, key: str) -> UInt8[np.ndarray, "h w 3"]:
        """Reads the image of a frame, RGB order, as `read` gives it."""
        index = self.index(key)
        offset_s = 0.0 if self.stored is None else self.stored.correction.time_offset_s
        return self.recording.image(image_at(self.recording, index, offset_s) if offset_s else index)

    def index(self, key: str) -> int:
        if key not in self.recording.indices:
            raise FrameError(
                Path(self.recording.path), f"frame {key} no longer exists", "restore it, or add the folder again"
            )
        return self.recording.indices[key]


def open_stored(stored: StoredRecording, project: str) -> OpenedRecording:
    if missing := why_gone(stored.path, stored.name, project):
        raise RecordingError(missing)
    return OpenedRecording(open_recording(stored.path, stored_options(stored.options)), stored)


def why_gone(path: Path, name: str, project: str) -> str | None:
    """Says that a project's recording is missing, and what to do; None if it is there."""
    missing, command = why_missing(path), f"annotator project move {project} {name} PATH"
    return (
        missing and f"{path}: {missing}; restore {name}, or give its new path: {command}, or Locate on the start page"
    )


class FrameSource:
    """Reads frames of a project, as they are adjusted then. Each recording is opened once; frames are not cached."""

    def __init__(self, project: Project) -> None:
        self._project = project
        self._opened: dict[int, OpenedRecording] = {}

    def recording(self, recording_id: int) -> Recording:
        return self._open(recording_id).recording

    def read(self, frame: StoredFrame) -> Frame:
        """Reads a frame, with the project's up direction if it sets one."""
        return self.adjusted(frame.recording_id).read(frame.key)

    def recorded(self, frame: StoredFrame) -> Frame:
        """Reads a frame as the recording's files give it; errors as in `read`."""
        opened = self._open(frame.recording_id)
        return opened.recording.frame(opened.index(frame.key))

    def adjusted(self, recording_id: int) -> OpenedRecording:
        """The open recording with its present adjustment, which may have changed since it was opened."""
        opened, project = self._open(recording_id), self._project
        of = project.adjustments.newest(recording_id), project.estimates.newest(recording_id)
        if opened.stored is None or of != (opened.stored.adjusted, opened.estimated):
            keys = {frame.id: frame.key for frame in project.frames.of([recording_id])} if of[1] else {}
            known = project.stills.poses(recording_id) if of[1] else {}
            poses = {keys[number]: T.inv() for number, T in known.items()}
            stored = project.recordings.get(recording_id)
            opened = replace(opened, stored=stored, estimated=of[1], poses=poses)
            self._opened[recording_id] = opened
        return opened

    def _open(self, recording_id: int) -> OpenedRecording:
        if recording_id not in self._opened:
            stored = self._project.recordings.get(recording_id)
            self._project.recordings.require_readable(stored)
            self._opened[recording_id] = open_stored(stored, self._project.path.name)
        return self._opened[recording_id]


def orientation_for(rotation: BoxRotation, frame: Frame) -> Orientation:
    """Returns the rotations that boxes of a frame may have; AUTO is upright if the up direction is known."""
    if rotation is BoxRotation.AUTO:
        return Orientation.FREE if frame.up is None else Orientation.UPRIGHT
    return Orientation(rotation.value)


def seen_labels(project: Project, source: FrameSource, frame: StoredFrame) -> tuple[Label, ...]:
    """The labels of a frame's moment that were made in the frame, or that its image shows."""
    stored = project.labels.of_moment(frame.id)
    if all(each.is_own for each in stored):
        return tuple(each.label for each in stored)
    camera = source.read(frame).camera
    return tuple(
        each.label
        for each in stored
        if each.is_own or is_seen(each.label.box, camera.matrix, camera.width_px, camera.height_px)
    )


def shared_clouds(recording: Recording) -> dict[str, SharedCloud]:
    """The clouds of a recording that other cameras of its rig may share, by the keys of its frames.

    Those that lack a pose, and cannot be read, have none.
    """
    found: dict[str, SharedCloud] = {}
    if isinstance(recording, RigCamera) and recording.cameras:
        for index, key in enumerate(recording.keys):
            with suppress(FrameError):
                found[key] = SharedCloud(recording.moment(index), recording.T_rig_camera(index))
    return found


def recorded_poses(recording: Recording) -> dict[str, RigidTransform]:
    """Where the camera of each frame was, `T_world_camera`, by the frame's key; without those that are not known."""
    found: dict[str, RigidTransform] = {}
    if recording.pose_source is not None:
        for index, key in enumerate(recording.keys):
            with suppress(RecordingError):
                if (pose := recording.pose(index)) is not None:
                    found[key] = pose
    return found
