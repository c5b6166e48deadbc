"""The interface of sources of live frames."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from annotator.types import Frame


@dataclass(frozen=True, eq=False)
class Taken:
    """A frame from a source.

    Attributes:
        taken_s: when the camera took it, or when it was due in playback; `time.perf_counter`.
        read_s: time to read it, seconds.
    """

    frame: Frame
    taken_s: float
    read_s: float


@runtime_checkable
class Source(Protocol):
    """A camera, or a played recording. Read by one thread."""

    @property
    def name(self) -> str:
        """The name shown to the operator."""

    @property
    def gives_newest(self) -> bool:
        """True if `read` returns the newest frame; False if unread frames queue up."""

    @property
    def skipped(self) -> int:
        """Number of frames left out to keep the frame rate."""

    def read(self, stop: threading.Event) -> Taken | None:
        """Waits for the next frame; returns None at the end, or when `stop` is set.

        Raises:
            FrameError: this frame cannot be read; the next one may be readable.
            DeviceError: the camera is disconnected or delivers no frames.
        """

    def resume(self) -> None:
        """Discards frames that are old by now; called after a pause."""

    def close(self) -> None:
        """Releases the camera."""
