"""Rigs: the labels of the other cameras, in the frame of one camera.

A rig is a set of a project's recordings with the same path and options but for the option `camera`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.formats.nuscenes import is_seen
from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel, StoredRecording
from annotator.project.sources import covered_by
from annotator.recordings import stored_options
from annotator.recordings.look_around import RigCamera
from annotator.types import Camera, Label, OrientedBox, ReviewState
from annotator.types.errors import RecordingError
from annotator.workflows.frame_source import FrameSource

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
            OtherLabel(_moved(label, sibling.T_here_there), sibling.frame, sibling.recording)
            for sibling in siblings
            for label in self._project.labels.of_frame(sibling.frame.id)
        ]

    def others_on_image(self, frame: StoredFrame, camera: Camera, own: Sequence[Label]) -> list[Label]:
        """Returns the labels of `others` that the image shows, without rejected ones and those of own labels' objects.

        Args:
            camera: of the frame.
            own: the frame's labels.
        """
        seen = [
            other.label
            for other in self.others(frame)
            if other.label.state is not ReviewState.REJECTED
            and is_seen(other.label.box, camera.matrix, camera.width_px, camera.height_px)
        ]
        return [label for label, cover in zip(seen, covered_by(seen, own), strict=True) if cover is None]

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
            (_rank(stored, sibling.frame), _moved(stored.label, sibling.T_here_there))
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


def _moved(label: Label, T_here_there: RigidTransform) -> Label:
    return replace(label, box=label.box.transformed(T_here_there))


def _cosine(box: OrientedBox) -> float:
    """Returns the cosine between the direction to a box and the camera's viewing direction."""
    return float(box.center_m[2] / max(np.linalg.norm(box.center_m), 1e-9))
