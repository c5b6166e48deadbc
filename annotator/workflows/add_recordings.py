"""Adds recordings to a project, and moves them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from annotator.project import BoxRotation, Project, StoredRecording
from annotator.recordings import ReaderOptions, Recording, open_recording, stored_options
from annotator.recordings.rig import RigCamera, Scenes
from annotator.types import Frame
from annotator.types.errors import ConfigError, FrameError, RecordingError

# If this many frames at the beginning are unreadable, the recording is refused without trying the others.
FRAMES_TRIED = 5
NO_OPTIONS = ReaderOptions()


LONGEST_NAME = 100
# In place of the names of scenes or cameras.
ALL = "all"


@dataclass(frozen=True)
class Added:
    """The result of adding one recording.

    Attributes:
        recording: as stored in the project.
        is_new: False if the project had it already and was only updated.
        new_frames: number of frames added.
        missing_frames: number of known frames that are gone; their labels stay.
        notes: what the reader says about it.
    """

    recording: StoredRecording
    is_new: bool
    new_frames: int
    missing_frames: int
    notes: tuple[str, ...] = ()


def add_recordings(
    project: Project,
    paths: Sequence[Path],
    *,
    name: str | None = None,
    up: Sequence[float] | None = None,
    options: ReaderOptions = NO_OPTIONS,
    scenes: Sequence[str] = (),
    cameras: Sequence[str] = (),
) -> list[Added]:
    """Adds recordings to a project: all, or none if one of the paths cannot be used. Their files stay in place.

    A recording that the project has already is updated with its new frames; its name and up direction stay.

    Args:
        name: name of a single recording; None = the name of its folder.
        up: direction against gravity in the camera frame, (3,) of any length; None = as the files give it.
        options: how the recordings are read.
        scenes, cameras: names, of which each combination is a recording, or `ALL`; () = those of `options`.

    Raises:
        RecordingError: a path holds no recording, or none of its first frames can be read.
        ConfigError: one name for several recordings, a name that is too long or cannot be printed, or another name or
            up direction for a known recording.
        ProjectError: the store refuses a value, e.g. an `up` of length zero.
    """
    if name is not None:
        _check_name(name)
    opened = [each for path in paths for each in _chosen(path, options, tuple(scenes), tuple(cameras))]
    if name is not None and len(opened) > 1:
        raise ConfigError(f"{len(opened)} recordings cannot all be called {name!r}; add them one by one")
    frames = []
    for recording, options in opened:
        frames.append(_require_readable(recording))
        _require_unchanged(project.path.name, _known(project, recording, options), name, up)
    added = [_add(project, recording, name, up, options) for recording, options in opened]
    return [_with_up_note(project, *each) for each in zip(added, frames, strict=True)]


def _check_name(name: str) -> None:
    if not 0 < len(name) <= LONGEST_NAME or not name.isprintable() or name != name.strip():
        raise ConfigError(
            f"{name[:80]!r} is not a valid name of a recording; use 1 to {LONGEST_NAME} printable characters, without "
            "spaces at the ends"
        )


def register_recording(
    project: Project,
    recording: Recording,
    *,
    name: str | None = None,
    up: Sequence[float] | None = None,
    options: ReaderOptions = NO_OPTIONS,
) -> StoredRecording:
    """Adds an open recording, or updates the frames of one that the project has already.

    Args:
        options: with which it was opened.

    Raises:
        ProjectError: as `add_recordings`.
    """
    return _add(project, recording, name, up, options).recording


def move_recording(project: Project, recording_id: int, path: Path, author: str) -> StoredRecording:
    """Sets the new path of a recording whose folder was moved. Stored frames are unchanged; new frames are added.

    Other recordings with the same path, such as the other cameras of a rig, are moved with it.

    Args:
        author: of the change.

    Raises:
        NotFoundError: no such recording.
        RecordingError: `path` holds no recording, one of another format, or none of its first frames can be read.
        ProjectError: frames of the recording are missing there (the message names them), or `path` is another recording
            of the project.
    """
    known = project.recordings.get(recording_id)
    # this recording first: its error says what is wrong
    together = sorted(project.recordings.at(known.path), key=lambda each: each.id != recording_id)
    for each in together:
        _move(project, each, path, author)
    return project.recordings.get(recording_id)


def _move(project: Project, known: StoredRecording, path: Path, author: str) -> None:
    moved = open_recording(path, stored_options(known.options))
    if moved.format != known.format:
        raise RecordingError(
            f"{path}: is a recording of the format {moved.format}, but {known.name} is of the format {known.format}; "
            "give the folder that was moved"
        )
    _require_readable(moved)
    project.recordings.move(known.id, moved.path, moved.keys, author)


def _chosen(
    path: Path, given: ReaderOptions, scenes: tuple[str, ...], cameras: tuple[str, ...]
) -> Iterator[tuple[Recording, ReaderOptions]]:
    """Yields the recordings of a path, with the options to store, which name scene and camera if it has several."""
    scenes, cameras = scenes or _named(given.scene), cameras or _named(given.camera)
    one = _open(path, given, _first(scenes), _first(cameras))
    for scene in _names(path, "scene", scenes, one.scenes, one.scene) if isinstance(one, Scenes) else (None,):
        # opened without the name of what nobody named, so that its notes tell of the others
        asked = scene if scenes else None
        one = _open(path, given, asked, _first(cameras))
        rig = one if isinstance(one, RigCamera) and one.cameras else None
        for camera in _names(path, "camera", cameras, rig.cameras, rig.camera) if rig else (None,):
            recording = _open(path, given, asked, camera if cameras else None)
            yield recording, given.model_copy(update={"scene": scene, "camera": camera})


def _open(path: Path, given: ReaderOptions, scene: str | None, camera: str | None) -> Recording:
    return open_recording(path, given.model_copy(update={"scene": scene, "camera": camera}))


def _named(name: str | None) -> tuple[str, ...]:
    return () if name is None else (name,)


def _first(names: tuple[str, ...]) -> str | None:
    return None if not names or ALL in names else names[0]


def _names(path: Path, what: str, wanted: tuple[str, ...], all_names: tuple[str, ...], own: str) -> tuple[str, ...]:
    if ALL in wanted:
        return all_names
    missing = [name for name in wanted if name not in all_names]
    if missing:
        raise ConfigError(f"{path}: has no {what} {', '.join(missing)}; it has {', '.join(all_names)}")
    return tuple(dict.fromkeys(wanted)) or (own,)


def _add(
    project: Project, recording: Recording, name: str | None, up: Sequence[float] | None, options: ReaderOptions
) -> Added:
    known = _known(project, recording, options)
    if known is None:
        stored = project.recordings.add(
            recording.path,
            recording.format,
            name or recording.name,
            recording.keys,
            recording.is_sequence,
            up,
            options.stored(),
        )
        return Added(stored, True, len(recording), 0, recording.notes)
    change = project.recordings.rescan(known.id, recording.keys)
    return Added(project.recordings.get(known.id), False, len(change.added), len(change.missing), recording.notes)


def _with_up_note(project: Project, added: Added, frame: Frame) -> Added:
    """Adds a note if boxes may be upright in the project, and the recording does not know which way is up."""
    stored = added.recording
    if frame.up is not None or stored.up is not None or project.config.settings.rotation is BoxRotation.FREE:
        return added
    note = (
        f"which way is up is not known: annotator up {project.path.name} {stored.name} --estimate, "
        "or Alignment on the page"
    )
    return replace(added, notes=(*added.notes, note))


def _known(project: Project, recording: Recording, options: ReaderOptions) -> StoredRecording | None:
    path, read = recording.path.resolve(), options.stored()
    return next((known for known in project.recordings.all() if known.path == path and known.options == read), None)


def _require_unchanged(
    project: str, known: StoredRecording | None, name: str | None, up: Sequence[float] | None
) -> None:
    """Refuses a different name or up direction for a known recording, instead of ignoring it."""
    if known is None:
        return
    if name is not None and name != known.name:
        raise ConfigError(f"{known.path} is in the project already, as {known.name}; it cannot be called {name!r}")
    if up is not None and not _same_direction(up, known.up):
        raise ConfigError(
            f"{known.path} is in the project already, with the up direction {known.up or 'that its files give'}; "
            f"annotator up {project} {known.name} X Y Z changes it"
        )


def _same_direction(a: Sequence[float], b: Sequence[float] | None) -> bool:
    length = float(np.linalg.norm(a))
    return b is not None and length > 0 and np.allclose(np.asarray(a) / length, b)


def _require_readable(recording: Recording) -> Frame:
    problems = []
    for index in range(min(FRAMES_TRIED, len(recording))):
        try:
            return recording.frame(index)
        except FrameError as error:
            problems.append(str(error))
    raise RecordingError(f"{recording.path}: none of its first {len(problems)} frames can be read: {problems[0]}")
