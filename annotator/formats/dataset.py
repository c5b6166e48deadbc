"""What every exporter of 3D boxes is given, and the names that it gives to frames."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from annotator.types import Frame, Label
from annotator.types.errors import FormatError


@dataclass(frozen=True, eq=False)
class DatasetItem:
    """One frame to export.

    Attributes:
        recording: name of the frame's recording.
        frame: image, cloud and camera.
        labels: only those that should leave; boxes in the camera frame.
        split: the part of the dataset that the frame belongs to, such as "train"; None where it is not divided.
    """

    recording: str
    frame: Frame
    labels: Sequence[Label]
    split: str | None = None


@dataclass
class FrameIds:
    """Unique ids of frames, fit for a file name on every system: `recording-key`, in the order of the frames."""

    ids: dict[tuple[str, str], str] = field(default_factory=dict)
    _taken: set[str] = field(default_factory=set)

    def add(self, out: Path, item: DatasetItem) -> str:
        """The id of one more frame.

        Args:
            out: the dataset, for the message.

        Raises:
            FormatError: the frame has come before.
        """
        origin = (item.recording, item.frame.key)
        if origin in self.ids:
            raise FormatError(out, f"{item.recording}, frame {item.frame.key}: the frame comes twice")
        frame_id = self._free("-".join(re.sub(r"[^\w.]+", "_", part) for part in origin).lstrip("."))
        self.ids[origin] = frame_id
        self._taken.add(frame_id.casefold())
        return frame_id

    def _free(self, wanted: str) -> str:
        """`wanted`, numbered where different names become the same file name."""
        candidate, number = wanted, 1
        while candidate.casefold() in self._taken:
            number += 1
            candidate = f"{wanted}-{number}"
        return candidate
