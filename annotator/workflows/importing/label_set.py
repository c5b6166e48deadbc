"""3D boxes that somebody labelled elsewhere, whatever format they were read from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from annotator.types import Frame, Truth


@runtime_checkable
class LabelSet(Protocol):
    """The boxes of a dataset, read and checked as a whole before anything is stored."""

    @property
    def path(self) -> Path:
        """The file or folder that they were read from."""

    @property
    def frames(self) -> Sequence[str]:
        """Names of the labelled frames, those without an object too: "RECORDING/KEY", or only "KEY"."""

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        """The objects of one of these frames, in the camera frame.

        Args:
            frame: our frame of that name; formats whose boxes are not in the camera frame need its
                `T_camera_label` or `up`.

        Raises:
            FormatError: the frame lacks what the format needs.
        """
