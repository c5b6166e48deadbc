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
class FileNames:
    """Names fit for files on every system, no two alike even where upper and lower case are the same."""

    _taken: set[str] = field(default_factory=set)

    def add(self, *parts: str) -> str:
        """One more name, the parts joined by "-"; numbered where different parts become the same name."""
        wanted = "-".join(re.sub(r"[^\w.]+", "_", part) for part in parts).lstrip(".") or "_"
        candidate, number = wanted, 1
        while candidate.casefold() in self._taken:
            number += 1
            candidate = f"{wanted}-{number}"
        self._taken.add(candidate.casefold())
        return candidate


@dataclass
class FrameIds:
    """Unique ids of frames, fit for a file name: `recording-key`, in the order of the frames."""

    ids: dict[tuple[str, str], str] = field(default_factory=dict)
    _names: FileNames = field(default_factory=FileNames)

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
        self.ids[origin] = self._names.add(*origin)
        return self.ids[origin]
