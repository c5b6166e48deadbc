"""The interface of imported 3D boxes in any format."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from annotator.types import Frame, Truth


@dataclass(frozen=True)
class LeftOut:
    """What `LabelSet.truths` leaves out of a frame.

    Attributes:
        not_reviewed: number of proposed and rejected boxes.
        scores: number of scores that are not confidences in 0..1.
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
        """Names of the labelled frames, including empty ones: "RECORDING/KEY", or only "KEY"."""

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        """Returns the objects of one of these frames, in the camera frame.

        Args:
            frame: the project's frame of that name; formats whose boxes are not in the camera frame use its
                `T_camera_label` or `up`.

        Raises:
            FormatError: the frame lacks what the format needs.
        """

    def left_out_of(self, name: str) -> LeftOut:
        """Returns what is left out of one of these frames, for the report."""


def are_confidences(scores: Iterable[float | None]) -> bool:
    """True if all scores of a dataset are in 0..1; otherwise they are raw values of a detector."""
    return all(score is None or 0 <= score <= 1 for score in scores)
