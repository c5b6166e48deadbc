"""Reads the frames of a project from its recordings, and the labels of the other cameras of a rig.

A rig is a set of a project's recordings with the same path and options but for the option `camera`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.files import why_missing
from annotator.formats.nuscenes import is_seen
from annotator.geometry.oriented_box import corrected, with_image
from annotator.project import REVIEWED, BoxRotation, Project, StoredFrame, StoredLabel, StoredRecording
from annotator.project.sources import covered_by
from annotator.rcv.config import Orientation
from annotator.recordings import Recording, open_recording, stored_options
from annotator.recordings.frame_times import Clock
from annotator.recordings.look_around import RigCamera
from annotator.types import NO_CORRECTION, Camera, Correction, Frame, Label, OrientedBox, ReviewState
from annotator.types.errors import FrameError, RecordingError


@dataclass(frozen=True, eq=False)
class OpenedRecording:
    """An open recording of a project; frames are not cached.

    Attributes:
        recording: the recording.
        up: unit vector against gravity in the (corrected) camera frame, if the project sets one.
        correction: of the calibration.
        indices: index in the recording, by key.
    """

    recording: Recording
    up: tuple[float, float, float] | None
    correction: Correction = NO_CORRECTION
    indices: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "indices", {key: index for index, key in enumerate(self.recording.keys)})

    def read(self, key: str) -> Frame:
        """Reads a frame, with the project's correction of the calibration and its up direction.

        Raises:
            FrameError: the frame cannot be read, or no longer exists.
        """
        index = self.index(key)
        frame = self.recording.frame(index)
        if self.correction.time_offset_s:
            shown = self._clock.image_at(index, self.correction.time_offset_s)
            frame = frame if shown == index else with_image(frame, self.recording.frame(shown).rgb)
        frame = corrected(frame, self.correction)
        return frame if self.up is None else replace(frame, up=np.asarray(self.up, np.float64))

    @cached_property
    def _clock(self) -> Clock:
        return Clock(self.recording)

    def index(self, key: str) -> int:
        """The frame's index in the recording.

        Raises:
            FrameError: the frame no longer exists.
        """
        if key not in self.indices:
            raise FrameError(
                Path(self.recording.path), f"frame {key} no longer exists", "restore it, or add the folder again"
            )
        return self.indices[key]


def open_stored(stored: StoredRecording, project: str) -> OpenedRecording:
    """Opens a recording of a project of this name.

    Raises:
        RecordingError: it is missing or cannot be read.
    """
    missing = why_gone(stored.path, stored.name, project)
    if missing is not None:
        raise RecordingError(missing)
    return OpenedRecording(open_recording(stored.path, stored_options(stored.options)), stored.up, stored.correction)


def why_gone(path: Path, name: str, project: str) -> str | None:
    """Says that a project's recording is missing, and what to do; None if it is there."""
    missing = why_missing(path)
    if missing is None:
        return None
    return (
        f"{path}: {missing}; restore {name}, or give its new path: "
        f"annotator project move {project} {name} PATH, or Locate on the start page"
    )


class FrameSource:
    """Reads frames of a project, as they are adjusted then. Each recording is opened once; frames are not cached."""

    def __init__(self, project: Project) -> None:
        self._project = project
        self._stored: dict[int, StoredRecording] = {}
        self._opened: dict[int, OpenedRecording] = {}

    def stored(self, recording_id: int) -> StoredRecording:
        """Returns a recording as stored in the project."""
        if recording_id not in self._stored:
            self._stored[recording_id] = self._project.recordings.get(recording_id)
        return self._stored[recording_id]

    def recording(self, recording_id: int) -> Recording:
        """Returns an open recording.

        Raises:
            RecordingError: it is missing or cannot be read.
        """
        return self._open(recording_id).recording

    def read(self, frame: StoredFrame) -> Frame:
        """Reads a frame, with the project's up direction if it sets one.

        Raises:
            FrameError: the frame cannot be read, or no longer exists.
            RecordingError: the recording is missing or cannot be read.
        """
        return self.adjusted(frame.recording_id).read(frame.key)

    def recorded(self, frame: StoredFrame) -> Frame:
        """Reads a frame as the recording's files give it; errors as in `read`."""
        opened = self._open(frame.recording_id)
        return opened.recording.frame(opened.index(frame.key))

    def adjusted(self, recording_id: int) -> OpenedRecording:
        """The open recording with its present adjustment, which may have changed since it was opened.

        Raises:
            RecordingError: the recording is missing or cannot be read.
        """
        opened = self._open(recording_id)
        if self._project.adjustments.newest(recording_id) != self.stored(recording_id).adjusted:
            stored = self._stored[recording_id] = self._project.recordings.get(recording_id)
            opened = self._opened[recording_id] = replace(opened, up=stored.up, correction=stored.correction)
        return opened

    def _open(self, recording_id: int) -> OpenedRecording:
        if recording_id not in self._opened:
            stored = self.stored(recording_id)
            self._project.recordings.require_readable(stored)
            self._opened[recording_id] = open_stored(stored, self._project.path.name)
        return self._opened[recording_id]


def orientation_for(rotation: BoxRotation, frame: Frame) -> Orientation:
    """Returns the rotations that boxes of a frame may have; AUTO is upright if the up direction is known."""
    if rotation is BoxRotation.AUTO:
        return Orientation.FREE if frame.up is None else Orientation.UPRIGHT
    return Orientation(rotation.value)


# The option that tells the recordings of a rig apart.
CAMERA = "camera"

RigKey = tuple[Path, str]


@dataclass(frozen=True, eq=False)
class Sibling:
    """A frame of another camera at the same moment.

    Attributes:
        frame: the frame.
        recording: name of its recording.
        T_here_there: from its camera to this one.
        camera: its camera.
    """

    frame: StoredFrame
    recording: str
    T_here_there: RigidTransform
    camera: Camera


@dataclass(frozen=True, eq=False)
class OtherLabel:
    """A label of another camera.

    Attributes:
        label: the label; its box is in the frame of this camera.
        frame: the frame that it belongs to.
        recording: name of that frame's recording.
    """

    label: Label
    frame: StoredFrame
    recording: str


class Rigs:
    """The rigs of a project.

    Attributes:
        source: reads its recordings.
    """

    def __init__(self, project: Project, source: FrameSource | None = None) -> None:
        self.source = source or FrameSource(project)
        self._project = project
        self._indices: dict[int, Mapping[str, int]] = {}

    def recordings(self) -> list[int]:
        """Returns the ids of all recordings that belong to a rig."""
        rigs: dict[RigKey, list[int]] = {}
        for recording in self._project.recordings.all():
            if CAMERA in recording.options:
                rigs.setdefault(_rig_key(recording), []).append(recording.id)
        return sorted(recording for rig in rigs.values() if len(rig) > 1 for recording in rig)

    def siblings(self, frame: StoredFrame) -> list[Sibling]:
        """Returns the frames of the other cameras at the moment of a frame.

        Raises:
            FrameError, RecordingError: a recording of the rig cannot be read.
        """
        own = self.source.stored(frame.recording_id)
        if CAMERA not in own.options or frame.index is None:
            return []
        rig = [each for each in self._project.recordings.at(own.path) if _rig_key(each) == _rig_key(own)]
        if len(rig) == 1:
            return []
        here = self._camera(frame.recording_id)
        # its files may have changed since the project listed them
        if frame.index >= len(here) or here.keys[frame.index] != frame.key:
            return []
        # read anew, because corrections change while the page has the frame open
        own = next(each for each in rig if each.id == own.id)
        moment, T_rig_here = here.moment(frame.index), here.T_rig_camera(frame.index)
        T_here_rig = own.correction.T_camera_recorded * T_rig_here.inv()
        found = []
        for stored in rig:
            there = self._moments(stored.id).get(moment) if stored.id != own.id else None
            other = None if there is None else self._project.frames.present(stored.id, there)
            camera = self._camera(stored.id)
            if there is None or other is None or other.key != camera.keys[there]:
                continue
            T_here_there = T_here_rig * camera.T_rig_camera(there) * stored.correction.T_camera_recorded.inv()
            found.append(Sibling(other, stored.name, T_here_there, camera.intrinsics(there)))
        return found

    def others(self, frame: StoredFrame) -> list[OtherLabel]:
        """Returns all labels of the other cameras at the moment of a frame. Raises as `siblings`."""
        return self.labels_of(self.siblings(frame))

    def labels_of(self, siblings: Sequence[Sibling]) -> list[OtherLabel]:
        """Returns all labels of the other cameras, from the result of `siblings`."""
        return [
            OtherLabel(_moved_label(label, sibling.T_here_there), sibling.frame, sibling.recording)
            for sibling in siblings
            for label in self._project.labels.of_frame(sibling.frame.id)
        ]

    def others_on_image(self, frame: StoredFrame, camera: Camera, own: Sequence[Label]) -> list[Label]:
        """Returns the labels of `others` that the image shows, without rejected ones and those of objects in `own`."""
        return [
            other.label
            for other in uncovered(self.others(frame), own)
            if is_seen(other.label.box, camera.matrix, camera.width_px, camera.height_px)
        ]

    def is_better_seen(self, box: OrientedBox, siblings: Sequence[Sibling]) -> bool:
        """Returns True if another camera sees the middle of a box nearer to the middle of its view than this one.

        Args:
            box: in the frame of this camera.
            siblings: the frames of the other cameras that count.
        """
        here = _cosine(box)
        for sibling in siblings:
            there = box.transformed(sibling.T_here_there.inv())
            camera = sibling.camera
            if _cosine(there) > here + 1e-6 and is_seen(there, camera.matrix, camera.width_px, camera.height_px):
                return True
        return False

    def _camera(self, recording_id: int) -> RigCamera:
        recording = self.source.recording(recording_id)
        if not isinstance(recording, RigCamera):
            raise RecordingError(f"{recording.path}: is read as {recording.format}, which has no cameras; add it again")
        return recording

    def _moments(self, recording_id: int) -> Mapping[str, int]:
        if recording_id not in self._indices:
            camera = self._camera(recording_id)
            self._indices[recording_id] = {camera.moment(index): index for index in range(len(camera))}
        return self._indices[recording_id]


def uncovered(others: Sequence[OtherLabel], own: Sequence[Label]) -> list[OtherLabel]:
    """Returns the labels of other cameras that are not rejected, of objects that no own label covers."""
    present = [other for other in others if other.label.state is not ReviewState.REJECTED]
    covers = covered_by([other.label for other in present], own)
    return [other for other, cover in zip(present, covers, strict=True) if cover is None]


def once(project: Project, labels: Mapping[int, tuple[StoredLabel, ...]]) -> dict[int, tuple[StoredLabel, ...]]:
    """Returns labels by frame without those of objects that another camera of the rig has among them.

    Of the labels of one object, a reviewed one stays, else that of the camera that was added first.

    Raises:
        FrameError, RecordingError: a recording of a rig cannot be read.
    """
    rigs = Rigs(project)
    kept = dict(labels)
    in_rigs = rigs.recordings()
    for frame in project.frames.of(in_rigs) if in_rigs else ():
        if frame.id not in labels:
            continue
        others = [
            (_rank(stored, sibling.frame), _moved_label(stored.label, sibling.T_here_there))
            for sibling in rigs.siblings(frame)
            for stored in labels.get(sibling.frame.id, ())
        ]
        kept[frame.id] = tuple(
            stored
            for stored in labels[frame.id]
            if covered_by([stored.label], [label for rank, label in others if rank > _rank(stored, frame)]) == [None]
        )
    return {frame: each for frame, each in kept.items() if each}


def _rank(stored: StoredLabel, frame: StoredFrame) -> tuple[bool, int]:
    return stored.label.state in REVIEWED, -frame.recording_id


def _rig_key(recording: StoredRecording) -> RigKey:
    return recording.path, stored_options(recording.options).model_copy(update={CAMERA: None}).stored()


def _moved_label(label: Label, T_here_there: RigidTransform) -> Label:
    return replace(label, box=label.box.transformed(T_here_there))


def _cosine(box: OrientedBox) -> float:
    """Returns the cosine between the direction to a box and the camera's viewing direction."""
    return float(box.center_m[2] / max(np.linalg.norm(box.center_m), 1e-9))
