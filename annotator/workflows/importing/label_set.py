"""Imported 3D boxes in any format: the interface of all, and the boxes that a file or folder has by frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.formats.frame_names import LabelledFrame, Values
from annotator.project import REVIEWED, Project
from annotator.types import Frame, ReviewState, Truth
from annotator.types.errors import AnnotatorError, FormatError, FrameError
from annotator.workflows.importing.placing import MatchedFrames, match_frames

# No sensor sees so far.
FARTHEST_BOX_M = 10_000.0


@dataclass(frozen=True)
class LeftOut:
    """What `LabelSet.truths` leaves out of a frame.

    Attributes:
        not_reviewed: number of proposed and rejected boxes.
        rejected: number of the rejected ones, which `LabelSet.suggested` leaves out, too.
        scores: number of scores that are not confidences in 0..1.
        flat: number of 2D boxes without a 3D box.
    """

    not_reviewed: int = 0
    rejected: int = 0
    scores: int = 0
    flat: int = 0


@dataclass(frozen=True)
class ScoreRange:
    """The lowest and the highest score of a dataset."""

    low: float
    high: float

    @classmethod
    def of(cls, scores: Iterable[float | None]) -> ScoreRange | None:
        """Returns the range of the scores that are known; None if none is."""
        known = [score for score in scores if score is not None]
        return cls(min(known), max(known)) if known else None

    @property
    def are_confidences(self) -> bool:
        """True if all scores are in 0..1; otherwise they are raw values of a detector."""
        return self.low >= 0 and self.high <= 1

    def confidence(self, score: float | None) -> float | None:
        """Returns a score as a number in 0..1; raw values are scaled so that the range becomes 0..1."""
        if score is None or self.are_confidences:
            return score
        return 1.0 if self.high == self.low else (score - self.low) / (self.high - self.low)


class LabelSet(ABC):
    """The 3D boxes of a dataset, read and checked as a whole before anything is stored.

    Attributes:
        path: the file or folder that they were read from.
        faults_of_frames: errors that concern one frame only: it is left out and reported.
        scores: the range of the scores of all boxes, as in the files; None without any.
        sizes_m: the size of each box, as `OrientedBox.size_m`.
    """

    path: Path
    faults_of_frames: tuple[type[AnnotatorError], ...] = (FrameError,)
    scores: ScoreRange | None = None
    sizes_m: Iterable[Float64[np.ndarray, "3"]] = ()

    @property
    @abstractmethod
    def frames(self) -> Sequence[str]:
        """Names of the labelled frames, including empty ones: "RECORDING/KEY", or only "KEY"."""

    @abstractmethod
    def truths(self, name: str, frame: Frame) -> list[Truth]:
        """Returns the accepted objects of one of these frames, in the camera frame.

        Args:
            frame: the project's frame of that name; formats whose boxes are not in the camera frame use its
                `T_camera_label` or `up`.

        Raises:
            FormatError: the frame lacks what the format needs.
            ValueError: the transform to the camera frame moves a box out of range.
        """

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        """Returns the objects of one of these frames that nobody has rejected, with their scores as in the file.

        Args:
            read: reads the project's frame, which takes long; called only if the format needs it.
        """
        return self.truths(name, read())

    def classes(self, name: str) -> list[str]:
        """Returns the classes of the boxes that `suggested` may return; no frame is read."""
        return []

    def values_of(self, name: str) -> Values:
        """Returns the values of the attributes of one of these frames."""
        return {}

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        """Returns the values of the attributes of each box of one of these frames; no frame is read."""
        return []

    def left_out_of(self, name: str) -> LeftOut:
        """Returns what is left out of one of these frames."""
        return LeftOut()

    def unseen(self) -> int:
        """Returns the number of boxes that are in none of the images whose frames have been read."""
        return 0

    def in_project(self, project: Project) -> LabelSet:
        """Returns the boxes by the project's frames, if only its recordings tell which these are.

        Raises:
            FormatError: none of them is in the project.
            RecordingError: a recording has been moved.
        """
        return self

    def placed(self, project: Project, recording: str | None = None) -> MatchedFrames:
        """Returns the labelled frames as frames of a project; some may be of several."""
        return match_frames(project, self.path, self.frames, recording)


def truths_of(dataset: LabelSet, name: str, frame: Frame) -> Sequence[Truth]:
    """Returns the accepted objects of a frame, in the camera frame."""
    return near(dataset, name, lambda: dataset.truths(name, frame))


def near(dataset: LabelSet, name: str, read: Callable[[], Sequence[Truth]]) -> Sequence[Truth]:
    """Returns the objects of a frame, which may be seen by its camera.

    Raises:
        FormatError: a box is out of range, or so far away that its format has boxes relative to another place than the
            camera; or as `LabelSet.truths`.
    """
    try:
        truths = read()
        for truth in truths:
            away_m = float(np.linalg.norm(truth.box.center_m))
            if away_m > FARTHEST_BOX_M:
                raise ValueError(
                    f"a box of {truth.label} is {away_m / 1000:,.0f} km from the camera: its coordinates are a map's, "
                    "but this format's, or the recording's, are not"
                )
    except ValueError as error:
        raise FormatError(dataset.path, f"{name}: {error}; correct its boxes or its calibration") from error
    return truths


@dataclass(frozen=True)
class PlacedBoxes(LabelSet):
    """Boxes that belong to one frame each.

    Attributes:
        labelled: the frames by their names.
    """

    path: Path
    labelled: Mapping[str, LabelledFrame]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.labelled)

    @cached_property
    def scores(self) -> ScoreRange | None:  # type: ignore[override]
        return ScoreRange.of(truth.score for frame in self.labelled.values() for truth in frame.truths)

    @property
    def sizes_m(self) -> Iterable[Float64[np.ndarray, "3"]]:  # type: ignore[override]
        return (truth.box.size_m for frame in self.labelled.values() for truth in frame.truths)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        """As `LabelSet.truths`. Scores are kept only if all of the dataset are in 0..1, as confidences are."""
        accepted = self._chosen(name, lambda state: state is None or state in REVIEWED)
        truths = self._in_camera(name, accepted, lambda: frame)
        return truths if self._are_confident else [replace(truth, score=None) for truth in truths]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        return self._in_camera(name, self._chosen(name, _is_open), read)

    def classes(self, name: str) -> list[str]:
        return [each.label for each in self._chosen(name, _is_open)]

    def values_of(self, name: str) -> Values:
        return self._frame(name).values

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        return [each.attributes for each in self._frame(name).truths]

    def left_out_of(self, name: str) -> LeftOut:
        accepted = self._chosen(name, lambda state: state is None or state in REVIEWED)
        frame = self._frame(name)
        every = frame.truths
        return LeftOut(
            len(every) - len(accepted),
            len(every) - len(self._chosen(name, _is_open)),
            0 if self._are_confident else sum(each.score is not None for each in accepted),
            frame.flat,
        )

    @property
    def _are_confident(self) -> bool:
        return self.scores is None or self.scores.are_confidences

    def _frame(self, name: str) -> LabelledFrame:
        return self.labelled[name]

    def _chosen(self, name: str, is_chosen: Callable[[ReviewState | None], bool]) -> Sequence[Truth]:
        frame = self._frame(name)
        if frame.states is None:
            return frame.truths
        return [each for each, state in zip(frame.truths, frame.states, strict=True) if is_chosen(state)]

    def _in_camera(self, name: str, truths: Sequence[Truth], read: Callable[[], Frame]) -> list[Truth]:
        return transformed(truths, self._frame(name).T_camera(read))


def _is_open(state: ReviewState | None) -> bool:
    return state is not ReviewState.REJECTED


def transformed(truths: Sequence[Truth], T: RigidTransform | None) -> list[Truth]:
    """Returns the objects with their boxes transformed; None: as they are."""
    return [truth if T is None else truth.transformed(T) for truth in truths]
