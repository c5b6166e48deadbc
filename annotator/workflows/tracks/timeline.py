"""The frames of a recording in time, and the key frames of its tracks, which are those with a reviewed box."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.project import REVIEWED, Project, StoredFrame
from annotator.recordings.frame_times import recorded_times
from annotator.recordings.poses import between
from annotator.recordings.recording import Recording
from annotator.tracking.link import frame_times
from annotator.types import Frame, Label, OrientedBox
from annotator.types.errors import ConfigError
from annotator.workflows.frame_source import FrameSource

OpenRecording = Callable[[int], Recording]
"""Gives the open recording with an id, which may be kept; raises RecordingError if it cannot be opened."""

Matrix = Float64[np.ndarray, "4 4"]

# Objects that are followed from the same frame need the same frames at about the same time; others read them again.
FRAMES_KEPT = 4


@dataclass(frozen=True, eq=False)
class Moment:
    """A frame and its time, in any unit; times decrease if an object is followed backward."""

    index: int
    frame: Frame
    time: float

    @cached_property
    def T_camera_world(self) -> Matrix | None:
        """The camera's pose; None if it is not known."""
        return None if self.frame.T_world_camera is None else self.frame.T_world_camera.inv().as_matrix()


@dataclass(frozen=True, eq=False)
class KeyFrame:
    """A key frame: its index in the timeline, and its label."""

    index: int
    label: Label


def moved(box: OrientedBox, T_first_world: Matrix | None, T_second_world: Matrix | None) -> OrientedBox:
    """A box that stands still in the world between two moments, in the frame of the second one's camera.

    Without one of the poses the camera is taken to stand still, too.
    """
    if T_first_world is None or T_second_world is None or T_first_world is T_second_world:
        return box
    return OrientedBox(T_second_world @ np.linalg.inv(T_first_world) @ box.pose, box.size_m)


class Motion:
    """How the camera of a recording moved, as its poses say.

    A frame without one is between the nearest frames before and after that have one; at the ends, it has that of the
    nearest.
    """

    def __init__(self, project: Project, recording_id: int, among: Sequence[int] | None = None) -> None:
        """
        Args:
            among: ids of frames in order; None = all of the recording.
        """
        self._T_camera_world = project.stills.pose_matrices(recording_id, among)
        if not self._T_camera_world:
            return
        every = (frame.id for frame in project.frames.of([recording_id]) if frame.index is not None)
        order = list(every) if among is None else list(among)
        posed = [n for n, id in enumerate(order) if id in self._T_camera_world]
        for n, id in enumerate(order):
            if id not in self._T_camera_world:
                after = bisect(posed, n)
                first, last = posed[max(after - 1, 0)], posed[min(after, len(posed) - 1)]
                start, end = (RigidTransform.from_matrix(self._T_camera_world[order[m]]).inv() for m in (first, last))
                T_world_camera = between(start, end, (n - first) / (last - first) if first < last else 0.0)
                assert T_world_camera is not None  # both are known
                self._T_camera_world[id] = T_world_camera.inv().as_matrix()

    @property
    def is_known(self) -> bool:
        """Whether any frame has a pose."""
        return bool(self._T_camera_world)

    def pose(self, frame_id: int) -> RigidTransform | None:
        """`T_world_camera` of a frame; None if no frame has a pose."""
        T = self._T_camera_world.get(frame_id)
        return None if T is None else RigidTransform.from_matrix(T).inv()

    def moved(self, box: OrientedBox, frame_id: int, to: int) -> OrientedBox:
        """As `moved`, from a frame to another one (ids)."""
        return moved(box, self._T_camera_world.get(frame_id), self._T_camera_world.get(to))


class Timeline:
    """The frames of a recording that follow each other in time, read when they are needed.

    Attributes:
        frames: in order, without those that are no longer in the recording.
        index: of each of them, by its id.
        times: in units of the frame interval, so that dropped frames are gaps; the indices without recorded times.
    """

    def __init__(self, project: Project, recording_id: int, recordings: OpenRecording | None = None) -> None:
        stored = project.recordings.get(recording_id)
        if not stored.is_sequence:
            raise ConfigError(
                f"the frames of {stored.name} do not follow each other in time; it has no next frame, and no tracks"
            )
        self.project, self.recording_id = project, recording_id
        self.frames: tuple[StoredFrame, ...] = tuple(
            frame for frame in project.frames.of([recording_id]) if frame.index is not None
        )
        self.index = {frame.id: index for index, frame in enumerate(self.frames)}
        source, frames = FrameSource(project), self.frames
        self.recording = (recordings or source.recording)(recording_id)
        times_ns = recorded_times(self.recording)
        self.times: Float64[np.ndarray, "n"] = (
            np.array([float(frame.index or 0) for frame in self.frames])
            if times_ns is None
            else frame_times([times_ns.get(frame.key) for frame in self.frames])
        )
        # not of `self`, so that the frames are freed with it
        self._read = lru_cache(FRAMES_KEPT)(lambda index: source.read(frames[index]))

    @cached_property
    def motion(self) -> Motion:
        """How the camera moved."""
        return Motion(self.project, self.recording_id)

    def moved(self, box: OrientedBox, index: int, to: int) -> OrientedBox:
        """As `moved`, from a frame to another one (indices)."""
        return self.motion.moved(box, self.frames[index].id, self.frames[to].id)

    def moment(self, index: int) -> Moment:
        """Reads a frame; where its pose is missing, it has that of `motion`."""
        frame = self._read(index)
        if frame.T_world_camera is None and (T := self.motion.pose(self.frames[index].id)) is not None:
            frame = replace(frame, T_world_camera=T)
        return Moment(index, frame, float(self.times[index]))

    def key_frames(self, track_id: int) -> list[KeyFrame]:
        """Returns the key frames of a track, in order."""
        keys: dict[int, KeyFrame] = {}
        for stored in self.project.labels.along(self.recording_id, states=REVIEWED, tracks=[track_id]):
            if (index := self.index.get(stored.frame_id)) is not None:
                keys[index] = KeyFrame(index, stored.label)
        return [keys[index] for index in sorted(keys)]
