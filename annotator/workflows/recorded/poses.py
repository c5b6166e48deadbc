"""Poses of a recording in a project: those of its files, or estimated ones where it has none."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.geometry.odometry import LEAST_GRIP, LEAST_OVERLAP, LEAST_POINTS, Odometry, Placed
from annotator.geometry.transforms import level_pose
from annotator.project import Project
from annotator.project.records import FramePose
from annotator.recordings.poses import PosesReport, survey_poses
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, FrameError, RecordingError
from annotator.types.messages import first_few
from annotator.workflows.frame_source import FrameSource

ESTIMATED = "estimate"
# Frames that are named.
MOST_NAMED = 5


class Certainty(Strict):
    """How sure estimated poses are: the median and the least of what holds the frames (`odometry.Placed`)."""

    overlap: tuple[float, float]
    rmse: float
    grip: tuple[float, float]


class ProjectPoses(Strict):
    """The poses of a recording in a project.

    Attributes:
        poses: None without any.
        certainty: of estimated ones.
        warnings: frames that could not be placed, and where the poses are only near the truth; sentences.
    """

    recording: str
    source: Literal["files", "estimate", "none"]
    poses: PosesReport | None
    certainty: Certainty | None
    warnings: tuple[str, ...]


def estimate_poses(
    project: Project,
    recording_id: int,
    author: str,
    *,
    replace: bool = False,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> None:
    """Estimates where the camera of a recording was, by its frames, and keeps that as one action.

    The world is level if the first frame knows which way is up, with its origin at that camera. A run that is stopped
    changes nothing.

    Args:
        replace: take the place of poses that the recording has.

    Raises:
        ConfigError: the frames are in no order, or have poses. HistoryError: objects stand still in their world.
    """
    name, source = project.recordings.get(recording_id).name, FrameSource(project)
    recording = source.recording(recording_id)
    if not recording.is_sequence or len(recording) < 2:
        raise ConfigError(f"{name}: its frames are not in time order, so there is no way to estimate")
    if (project.stills.poses(recording_id) or project.estimates.is_recorded(recording_id)) and not replace:
        raise ConfigError(f"{name} has poses already; --replace estimates them anew, and undo brings them back")
    project.estimates.require_changeable(recording_id)
    odometry, T_world_first, found = None, RigidTransform.identity(), list[FramePose]()
    stored = [each for each in project.frames.of([recording_id]) if each.index is not None]
    for done, each in enumerate(stored):
        progress(done, len(stored))
        placed, frame = Placed(None, 0.0, 0.0, 0.0), None
        with suppress(FrameError):  # told as a gap
            frame = source.recorded(each)
        if frame is not None and frame.in_map:
            raise ConfigError(f"{name}: its clouds are in the coordinates of one map already")
        if frame is not None and len(frame.cloud) >= LEAST_POINTS:
            if odometry is None:
                odometry, T_world_first = Odometry(frame), level_pose(frame.up)
            placed = odometry.add(frame)
        T = None if placed.T_first_camera is None else T_world_first * placed.T_first_camera
        found.append(FramePose.of(each.key, T, placed.overlap, placed.rmse, placed.grip))
    progress(len(stored), len(stored))
    if sum(each.pose is not None for each in found) < 2:
        raise RecordingError(f"{name}: no two of its frames could be registered; nothing was changed")
    project.estimates.keep(recording_id, found, author)


def poses_of(project: Project, recording_id: int) -> ProjectPoses:
    """What is known of the poses of a recording."""
    stored, source = project.recordings.get(recording_id), FrameSource(project)
    recording, estimated = source.recording(recording_id), project.estimates.of(recording_id)
    if not estimated:
        survey = survey_poses(recording)
        origin: Literal["files", "none"] = "none" if survey is None else "files"
        return ProjectPoses(recording=stored.name, source=origin, poses=survey, certainty=None, warnings=())
    by_key = {each.key: each for each in estimated}
    there = [None if (one := by_key.get(key)) is None else one.transform() for key in recording.keys]
    survey = survey_poses(recording, ESTIMATED, there.__getitem__)
    placed = [each for each in estimated[1:] if each.pose is not None]
    overlap, grip = ([getattr(each, name) for each in placed] for name in ("overlap", "grip"))
    certainty = Certainty(
        overlap=(float(np.median(overlap)), min(overlap)),
        rmse=float(np.median([each.rmse for each in placed])),
        grip=(float(np.median(grip)), min(grip)),
    )
    return ProjectPoses(
        recording=stored.name, source="estimate", poses=survey, certainty=certainty, warnings=_warnings(estimated)
    )


def _warnings(estimated: tuple[FramePose, ...]) -> tuple[str, ...]:
    lost = [each for each in estimated if each.pose is None]
    why = {
        "see too little of what was seen before": [e.key for e in lost if 0 < e.overlap < LEAST_OVERLAP],
        "see too few surfaces and edges to be held in all directions": [
            e.key for e in lost if e.overlap >= LEAST_OVERLAP and e.grip < LEAST_GRIP
        ],
        "cannot be read, or show nothing to register": [e.key for e in lost if e.overlap == 0],
    }
    return tuple(f"left out, since they {what}: {first_few(keys, MOST_NAMED)}" for what, keys in why.items() if keys)
