"""Opens a source of live frames by name."""

from __future__ import annotations

from pathlib import Path

from annotator.project import Project
from annotator.recordings import open_recording
from annotator.types.errors import ConfigError
from annotator.workflows.frame_source import OpenedRecording, open_stored
from annotator.workflows.live.kinect import KinectSource
from annotator.workflows.live.playback import Playback, Repeat
from annotator.workflows.live.recorder import require_recordable
from annotator.workflows.live.source import Source

KINECT = "kinect"


def open_source(
    project: Project, name: str, *, rate: float | None = None, loop: bool = False, to_record: bool = False
) -> Source:
    """Opens a device or a recording. A recording of the project is read as the project reads it.

    Args:
        name: `kinect`, `kinect:` with a serial number or device index, the path of a recording, or the name of one of
            the project.
        rate: as for `Playback`.
        loop: start again after the last frame.
        to_record: refuse a recording that cannot be recorded again.

    Raises:
        ConfigError: `rate` or `loop` for a device, an invalid rate, a recording that cannot be recorded again, or a
            path of several recordings of the project.
        RecordingError: there is no such recording.
        DeviceError: there is no such device, or it cannot be used.
    """
    kind, _, which = name.partition(":")
    if kind == KINECT and not Path(name).exists():
        if rate is not None or loop:
            raise ConfigError(f"{name}: a device has its own rate and no end; --rate and --loop are for recordings")
        return KinectSource(which or None)
    opened = _opened(project, Path(name), name)
    if to_record:
        require_recordable(opened.recording)
    return Playback(opened.recording, rate=rate, repeat=Repeat.AGAIN if loop else Repeat.NO, read=opened.read)


def _opened(project: Project, path: Path, name: str) -> OpenedRecording:
    """The recording with the options, the up direction and the correction that the project has for it."""
    if path.exists():
        known = project.recordings.at(path.resolve())
    else:
        known = tuple(each for each in project.recordings.all() if each.name == name)
    stored = next((each for each in known if len(known) == 1 or not each.options), None)
    if stored is not None:
        return open_stored(stored.path, stored.name, project.path.name, stored.up, stored.options, stored.correction)
    if known:
        names = ", ".join(each.name for each in known)
        raise ConfigError(f"{name}: the project has several recordings of it; give the name of one: {names}")
    return OpenedRecording(open_recording(path), None)
