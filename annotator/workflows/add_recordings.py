"""Adds recordings to a project, and moves them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from annotator.project import BoxRotation, Project, StoredRecording
from annotator.project.recordings import SharedCloud
from annotator.recordings import ReaderOptions, Recording, open_recording, stored_options
from annotator.recordings.look_around import RigCamera, Scenes
from annotator.types import Frame
from annotator.types.errors import BrokenStartError, ConfigError, FrameError, RecordingError
from annotator.workflows.frame_source import recorded_poses, shared_clouds
from annotator.workflows.recorded.condition import (
    SECONDS,
    BrokenFrames,
    broken_frames,
    fingerprint_of,
    require_not_moved,
    still_broken,
)

# If this many frames at the beginning are unreadable, the recording is refused without trying the others.
FRAMES_TRIED = 5
NO_OPTIONS = ReaderOptions()


LONGEST_NAME = 100
Places = tuple[dict[str, SharedCloud], dict[str, RigidTransform]]
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
        came_back: True if it had been removed; its labels are back, too.
        broken: its frames that cannot be read.
        left_out: number of them that are no frames of the project.
    """

    recording: StoredRecording
    is_new: bool
    new_frames: int
    missing_frames: int
    notes: tuple[str, ...] = ()
    came_back: bool = False
    broken: BrokenFrames = field(default_factory=BrokenFrames)
    left_out: int = 0


def add_recordings(
    project: Project,
    paths: Sequence[Path],
    *,
    name: str | None = None,
    up: Sequence[float] | None = None,
    options: ReaderOptions = NO_OPTIONS,
    scenes: Sequence[str] = (),
    cameras: Sequence[str] = (),
    as_new: bool = False,
    leave_out_broken: bool = False,
) -> list[Added]:
    """Adds recordings to a project: all, or none if one of the paths cannot be used. Their files stay in place.

    A recording that the project has already is updated with its new frames; its name and up direction stay. One that
    was removed comes back with its labels. Frames that were left out come back once they can be read.

    Args:
        name: name of a single recording; None = the name of its folder.
        up: direction against gravity in the camera frame, (3,) of any length; None = as the files give it.
        scenes, cameras: names, of which each combination is a recording, or `ALL`; () = those of `options`.
        as_new: add a recording even if it seems to be one of the project whose path is gone.
        leave_out_broken: leave out the frames that cannot be read; their labels, if they have any, stay.
    """
    if name is not None:
        _check_name(name)
    opened = [each for path in paths for each in _chosen(path, options, tuple(scenes), tuple(cameras))]
    if name is not None and len(opened) > 1:
        raise ConfigError(f"{len(opened)} recordings cannot all be called {name!r}; add them one by one")
    ready = []
    for recording, options in opened:
        known = _known(project, recording, options)
        if known is not None and known.options != options.stored():
            # with the origin that was found when it was added
            options = stored_options(known.options)
            recording = open_recording(recording.path, options)
        left_out = _left_out(project, known)
        hint = "; --leave-out-broken tries all" if len(recording) > FRAMES_TRIED and not leave_out_broken else ""
        most = len(recording) if leave_out_broken else FRAMES_TRIED
        frame = _require_readable(recording, left_out, most, hint)
        _require_unchanged(project.path.name, known, name, up)
        if known is None:
            if frame.T_world_camera is not None:
                options = options.model_copy(update={"origin": recording.origin or options.origin})
            if not as_new:
                require_not_moved(project, recording, options)
        ready.append((recording, options, frame))
    tried = [
        broken_frames(recording, _left_out(project, _known(project, recording, options)), SECONDS / len(ready))
        for recording, options, _ in ready
    ]
    read = [(fingerprint_of(frame), _places(recording)) for recording, _, frame in ready]
    added = []
    # nobody sees a part of a rig
    with project.store.together():
        for (recording, options, _), broken, (fingerprint, places) in zip(ready, tried, read, strict=True):
            lost = _left_out(project, _known(project, recording, options))
            left_out = frozenset(broken.errors) if leave_out_broken else lost & broken.errors.keys()
            one = _add(project, recording, name, up, options, places, fingerprint, left_out)
            added.append(replace(one, broken=broken))
    return [_with_up_note(project, one, frame) for one, (*_, frame) in zip(added, ready, strict=True)]


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
    """Adds an open recording, or updates the frames of one that the project has already."""
    return _add(project, recording, name, up, options, _places(recording)).recording


def move_recording(project: Project, recording_id: int, path: Path) -> StoredRecording:
    """Sets the new path of a recording whose folder was moved. Stored frames are unchanged; new frames are added.

    A removed recording comes back with its labels.

    Other recordings with the same path, such as the other cameras of a rig, are moved with it: all or none.
    """
    known = project.recordings.get(recording_id, removed=True)
    beside = project.recordings.at(known.path) if known.removed_by is None else ()
    # this recording first: its error says what is wrong
    every = {each.id: each for each in (known, *beside)}
    left_out = {number: _left_out(project, each) for number, each in every.items()}
    moved = {number: _moved(each, path, left_out[number]) for number, each in every.items()}
    broken = {number: still_broken(recording, left_out[number]) for number, recording in moved.items()}
    places = {number: (recording.path, recording.keys) for number, recording in moved.items()}
    clouds = {number: shared_clouds(recording) for number, recording in moved.items()}
    poses = {number: recorded_poses(recording) for number, recording in moved.items()}
    first = project.recordings.move(places, clouds, poses)[0]
    for number, keys in broken.items():
        if keys:
            project.recordings.rescan(number, moved[number].keys, left_out=keys)
    return first


def bring_back(project: Project, recording_id: int) -> StoredRecording:
    """Brings a removed recording back from its path, with its labels and possibly new frames."""
    known = project.recordings.get(recording_id, removed=True)
    project.recordings.require_readable(known)
    there = _moved(known, known.path)
    project.recordings.rescan(known.id, there.keys, clouds=shared_clouds(there), poses=recorded_poses(there))
    return project.recordings.get(known.id)


def _left_out(project: Project, known: StoredRecording | None) -> frozenset[str]:
    """Returns the frames of a recording that the latest scan has not found, or that were left out of it."""
    if known is None or known.removed_by is not None:
        return frozenset()
    return frozenset(frame.key for frame in project.frames.of([known.id]) if frame.index is None)


def _moved(known: StoredRecording, path: Path, left_out: Collection[str] = ()) -> Recording:
    moved = open_recording(path, stored_options(known.options))
    if moved.format != known.format:
        raise RecordingError(
            f"{path}: is a recording of the format {moved.format}, but {known.name} is of the format {known.format}; "
            "give the folder that was moved"
        )
    _require_readable(moved, left_out, FRAMES_TRIED)
    return moved


def _chosen(
    path: Path, given: ReaderOptions, scenes: tuple[str, ...], cameras: tuple[str, ...]
) -> Iterator[tuple[Recording, ReaderOptions]]:
    """Yields the recordings of a path, with the options to store, which name scene and camera if it has several."""
    scenes = scenes or tuple(filter(None, [given.scene]))
    cameras = cameras or tuple(filter(None, [given.camera]))

    def opened(scene: str | None, camera: str | None) -> Recording:
        return open_recording(path, given.model_copy(update={"scene": scene, "camera": camera}))

    one = opened(_first(scenes), _first(cameras))
    several = one if isinstance(one, Scenes) and one.scenes else None
    for scene in _names(path, "scene", scenes, several.scenes, several.scene) if several else (None,):
        # opened without the name of what nobody named, so that its notes tell of the others
        asked = scene if scenes else None
        one = opened(asked, _first(cameras))
        rig = one if isinstance(one, RigCamera) and one.cameras else None
        for camera in _names(path, "camera", cameras, rig.cameras, rig.camera) if rig else (None,):
            recording = opened(asked, camera if cameras else None)
            yield recording, given.model_copy(update={"scene": scene, "camera": camera})


def _first(names: tuple[str, ...]) -> str | None:
    return None if ALL in names else next(iter(names), None)


def _names(path: Path, what: str, wanted: tuple[str, ...], all_names: tuple[str, ...], own: str) -> tuple[str, ...]:
    if ALL in wanted:
        return all_names
    missing = [name for name in wanted if name not in all_names]
    if missing:
        raise ConfigError(f"{path}: has no {what} {', '.join(missing)}; it has {', '.join(all_names)}")
    return tuple(dict.fromkeys(wanted)) or (own,)


def _places(recording: Recording) -> Places:
    """The clouds and the poses of its frames, by their keys."""
    return shared_clouds(recording), recorded_poses(recording)


def _add(
    project: Project,
    recording: Recording,
    name: str | None,
    up: Sequence[float] | None,
    options: ReaderOptions,
    places: Places,
    fingerprint: str | None = None,
    left_out: frozenset[str] = frozenset(),
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
            fingerprint,
            left_out,
            *places,
        )
        return Added(stored, True, stored.frames, 0, recording.notes, left_out=len(left_out))
    change = project.recordings.rescan(known.id, recording.keys, fingerprint, left_out, *places)
    stored, came_back = project.recordings.get(known.id), known.removed_by is not None
    new_frames = sum(key not in left_out for key in change.added)
    return Added(stored, False, new_frames, len(change.missing), recording.notes, came_back, left_out=len(left_out))


def _with_up_note(project: Project, added: Added, frame: Frame) -> Added:
    """Adds a note if boxes may be upright in the project, and the recording does not know which way is up."""
    stored = added.recording
    if frame.up is not None or stored.up is not None or project.config.settings.rotation is BoxRotation.FREE:
        return added
    note = (
        "which way is up is not known; find it in Alignment on the page, or with "
        f"`annotator up {project.path.name} {stored.name} --estimate`"
    )
    return replace(added, notes=(*added.notes, note))


def _known(project: Project, recording: Recording, options: ReaderOptions) -> StoredRecording | None:
    path = recording.path.resolve()
    here = [each for each in (*project.recordings.all(), *project.recordings.removed()) if each.path == path]
    return next((known for known in here if options.may_be(stored_options(known.options))), None)


def _require_unchanged(
    project: str, known: StoredRecording | None, name: str | None, up: Sequence[float] | None
) -> None:
    """Refuses a different name or up direction for a known recording, instead of ignoring it."""
    if known is None:
        return
    if name not in (None, known.name):
        raise ConfigError(f"{known.path} is in the project already, as {known.name}; it cannot be called {name!r}")
    if up is not None and not _same_direction(up, known.up):
        raise ConfigError(
            f"{known.path} is in the project already, with the up direction {known.up or 'that its files give'}; "
            f"`annotator up {project} {known.name} X Y Z` changes it"
        )


def _same_direction(a: Sequence[float], b: Sequence[float] | None) -> bool:
    length = float(np.linalg.norm(a))
    return b is not None and length > 0 and np.allclose(np.asarray(a) / length, b)


def _require_readable(recording: Recording, left_out: Collection[str], most: int, hint: str = "") -> Frame:
    problems = []
    # those that were left out are tried last
    order = sorted(range(len(recording)), key=lambda index: recording.keys[index] in left_out)
    for index in order[:most]:
        try:
            return recording.frame(index)
        except FrameError as error:
            problems.append(str(error))
    kind = BrokenStartError if hint else RecordingError
    raise kind(f"{recording.path}: none of its first frames can be read ({len(problems)} tried{hint}): {problems[0]}")
