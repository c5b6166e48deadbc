"""Recordings into a project."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from annotator.project import Project, StoredRecording
from annotator.recordings import Recording, open_recording
from annotator.types.errors import ConfigError, FrameError, RecordingError

# A recording whose first frames are all unreadable is refused without reading the other ten thousand.
FRAMES_TRIED = 5


@dataclass(frozen=True)
class Added:
    """What became of one path.

    Attributes:
        recording: as the project has it now.
        is_new: False where the project had it already and only looked for new frames.
        new_frames, missing_frames: how many frames came, and how many known ones are gone (their labels stay).
    """

    recording: StoredRecording
    is_new: bool
    new_frames: int
    missing_frames: int


def add_recordings(
    project: Project, paths: Sequence[Path], *, name: str | None = None, up: Sequence[float] | None = None
) -> list[Added]:
    """Registers recordings; nothing is changed where one of the paths cannot be used. Their files stay in place.

    A recording that the project has already is looked at again for new frames; its name and up direction stay.

    Args:
        name: what to call the recording, where there is only one; otherwise each has its folder's name.
        up: direction against gravity in the camera frame, (3,) of any length, for recordings that do not know it.

    Raises:
        RecordingError: a path holds no recording, or none of its first frames can be read.
        ConfigError: one name for several recordings, or another name or up direction for one that is there already.
        ProjectError: the store refuses, as for an `up` without a direction.
    """
    if name is not None and len(paths) > 1:
        raise ConfigError(f"{len(paths)} recordings cannot all be called {name!r}; add them one by one")
    opened = [open_recording(path) for path in paths]
    for recording in opened:
        _require_readable(recording)
        _require_unchanged(_known(project, recording), name, up)
    return [_add(project, recording, name, up) for recording in opened]


def register_recording(
    project: Project, recording: Recording, *, name: str | None = None, up: Sequence[float] | None = None
) -> StoredRecording:
    """Registers one opened recording, or takes over its present frames where the project has it already.

    Raises:
        ProjectError: as `add_recordings`.
    """
    return _add(project, recording, name, up).recording


def move_recording(project: Project, recording_id: int, path: Path, author: str) -> StoredRecording:
    """Points a recording whose folder was moved to its new place. Nothing that is known of its frames changes; it may
    have grown since, and what is new is taken over.

    Args:
        author: who says so.

    Raises:
        NotFoundError: no such recording.
        RecordingError: `path` holds no recording, one of another format, or none of its first frames can be read.
        ProjectError: frames of the recording are not there (the message names them), or it is another recording of the
            project.
    """
    known, found = project.recordings.get(recording_id), open_recording(path)
    if found.format != known.format:
        raise RecordingError(
            f"{path}: is a recording of the format {found.format}, but {known.name} is of the format {known.format}; "
            "give the folder that was moved"
        )
    _require_readable(found)
    return project.recordings.move(recording_id, found.path, found.keys, author)


def _add(project: Project, recording: Recording, name: str | None, up: Sequence[float] | None) -> Added:
    known = _known(project, recording)
    if known is None:
        stored = project.recordings.add(
            recording.path, recording.format, name or recording.name, recording.keys, recording.is_sequence, up
        )
        return Added(stored, True, len(recording), 0)
    change = project.recordings.rescan(known.id, recording.keys)
    return Added(project.recordings.get(known.id), False, len(change.added), len(change.missing))


def _known(project: Project, recording: Recording) -> StoredRecording | None:
    path = recording.path.resolve()
    return next((stored for stored in project.recordings.all() if stored.path == path), None)


def _require_unchanged(known: StoredRecording | None, name: str | None, up: Sequence[float] | None) -> None:
    """What the project was told once is not quietly kept against what it is told now."""
    if known is None:
        return
    if name is not None and name != known.name:
        raise ConfigError(f"{known.path} is in the project already, as {known.name}; it cannot be called {name!r}")
    if up is not None and not _same_direction(up, known.up):
        raise ConfigError(
            f"{known.path} is in the project already, with the up direction {known.up or 'that its files give'}; "
            "labels were made with it, so it stays"
        )


def _same_direction(a: Sequence[float], b: Sequence[float] | None) -> bool:
    length = float(np.linalg.norm(a))
    return b is not None and length > 0 and np.allclose(np.asarray(a) / length, b)


def _require_readable(recording: Recording) -> None:
    problems = []
    for index in range(min(FRAMES_TRIED, len(recording))):
        try:
            recording.frame(index)
            return
        except FrameError as error:
            problems.append(str(error))
    raise RecordingError(f"{recording.path}: none of its first {len(problems)} frames can be read: {problems[0]}")
