"""Where live frames come from."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from annotator.types import Frame


@dataclass(frozen=True, eq=False)
class Taken:
    """A frame that has just come.

    Attributes:
        taken_s: when the camera had it, or a camera in the recording's place would have had it; `time.perf_counter`.
        read_s: how long it took to get it from there, seconds.
    """

    frame: Frame
    taken_s: float
    read_s: float


@runtime_checkable
class Source(Protocol):
    """A camera, or what stands for one. One thread reads."""

    @property
    def name(self) -> str:
        """What it is, for people."""

    @property
    def gives_newest(self) -> bool:
        """True where whoever asks later gets a newer frame; False where frames pile up unless they are taken."""

    @property
    def skipped(self) -> int:
        """Frames that it has left out to keep its pace."""

    def read(self, stop: threading.Event) -> Taken | None:
        """Waits for the next frame; None at the end, or when `stop` is set.

        Raises:
            FrameError: this frame cannot be read; the next one may be fine.
            DeviceError: the camera is gone, or gives nothing any more.
        """

    def resume(self) -> None:
        """Called after a pause: what has become old meanwhile is left out."""

    def close(self) -> None:
        """Gives the camera back."""
