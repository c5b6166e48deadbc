"""3D boxes that somebody labelled elsewhere, whatever format they were read from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from annotator.types import Frame, Truth


@dataclass(frozen=True)
class LeftBehind:
    """What a dataset says of a frame and `LabelSet.truths` does not.

    Attributes:
        not_reviewed: boxes that nobody has accepted: proposed ones, and rejected ones.
        scores: of the frame's objects, which are no confidences in 0..1.
    """

    not_reviewed: int = 0
    scores: int = 0


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

    def left_behind(self, name: str) -> LeftBehind:
        """What of one of these frames does not come along, to be told."""


def are_confidences(scores: Iterable[float | None]) -> bool:
    """True where no score of a dataset is outside 0..1; one that is says that the others are raw figures, too."""
    return all(score is None or 0 <= score <= 1 for score in scores)
