"""Opens a source of live frames by name."""

from __future__ import annotations

from pathlib import Path

from annotator.recordings import open_recording
from annotator.types.errors import ConfigError
from annotator.workflows.live.kinect import KinectSource
from annotator.workflows.live.playback import Playback, Repeat
from annotator.workflows.live.recorder import require_recordable
from annotator.workflows.live.source import Source

KINECT = "kinect"


def open_source(name: str, *, rate: float | None = None, loop: bool = False, to_record: bool = False) -> Source:
    """Opens a device or a recording.

    Args:
        name: `kinect`, `kinect:` with a serial number or device index, or the path of a recording.
        rate: as for `Playback`.
        loop: start again after the last frame.
        to_record: refuse a recording that cannot be recorded again.

    Raises:
        ConfigError: `rate` or `loop` for a device, an invalid rate, or a recording that cannot be recorded again.
        RecordingError: there is no such recording.
        DeviceError: there is no such device, or it cannot be used.
    """
    kind, _, which = name.partition(":")
    if kind == KINECT and not Path(name).exists():
        if rate is not None or loop:
            raise ConfigError(f"{name}: a device has its own rate and no end; --rate and --loop are for recordings")
        return KinectSource(which or None)
    recording = open_recording(Path(name))
    if to_record:
        require_recordable(recording)
    return Playback(recording, rate=rate, repeat=Repeat.AGAIN if loop else Repeat.NO)
