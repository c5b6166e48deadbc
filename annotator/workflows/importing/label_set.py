"""Imported 3D boxes in any format, by frame."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
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


@dataclass(eq=False)
class LabelSet:
    """The 3D boxes of a dataset, read and checked as a whole before anything is stored.

    Attributes:
        path: the file or folder that they were read from.
        labelled: the frames by their names: "RECORDING/KEY", or only "KEY"; also empty ones.
        faults_of_frames: errors that concern one frame only: it is left out and reported.
    """

    path: Path
    labelled: Mapping[str, LabelledFrame]
    faults_of_frames: tuple[type[AnnotatorError], ...] = (FrameError,)

    @property
    def frames(self) -> Sequence[str]:
        """Names of the labelled frames."""
        return tuple(self.labelled)

    @cached_property
    def scores(self) -> ScoreRange | None:
        """The range of the scores of all boxes, as in the files; None without any."""
        return ScoreRange.of(truth.score for frame in self.labelled.values() for truth in frame.truths)

    @property
    def sizes_m(self) -> Iterable[Float64[np.ndarray, "3"]]:
        """The size of each box, as `OrientedBox.size_m`."""
        return (truth.box.size_m for frame in self.labelled.values() for truth in frame.truths)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        """The accepted objects of a frame, in the camera frame; with scores if all of the dataset are in 0..1.

        Args:
            frame: the project's frame of that name; formats whose boxes are not in the camera frame use its
                `T_camera_label` or `up`.

        Raises:
            FormatError: the frame lacks what the format needs.
            ValueError: the transform to the camera frame moves a box out of range.
        """
        truths = self._in_camera(name, self._chosen(name, _ACCEPTED), lambda: frame)
        return truths if self._are_confident else [replace(truth, score=None) for truth in truths]

    def suggested(self, name: str, read: Callable[[], Frame]) -> list[Truth]:
        """The objects of a frame that nobody has rejected, with their scores as in the file.

        Args:
            read: reads the project's frame, which takes long; called only if the format needs it.
        """
        return self._in_camera(name, self._chosen(name, _OPEN), read)

    def classes(self, name: str) -> list[str]:
        """The classes of the boxes that `suggested` may return; no frame is read."""
        return [each.label for each in self._chosen(name, _OPEN)]

    def values_of(self, name: str) -> Values:
        """The values of the attributes of a frame."""
        return self._frame(name).values

    def values_of_boxes(self, name: str) -> Sequence[Values]:
        """The values of the attributes of each box of a frame; no frame is read."""
        return [each.attributes for each in self._frame(name).truths]

    def left_out_of(self, name: str) -> LeftOut:
        """What is left out of a frame."""
        frame, accepted = self._frame(name), self._chosen(name, _ACCEPTED)
        return LeftOut(
            len(frame.truths) - len(accepted),
            len(frame.truths) - len(self._chosen(name, _OPEN)),
            0 if self._are_confident else sum(each.score is not None for each in accepted),
            frame.flat,
        )

    def unseen(self) -> int:
        """The number of boxes that are in none of the images whose frames have been read."""
        return 0

    def in_project(self, project: Project) -> LabelSet:
        """The boxes by the project's frames, if only its recordings tell which these are.

        Raises:
            FormatError: none of them is in the project.
            RecordingError: a recording has been moved.
        """
        return self

    def placed(self, project: Project, recording: str | None = None) -> MatchedFrames:
        """The labelled frames as frames of a project; some may be of several."""
        return match_frames(project, self.path, self.frames, recording)

    @property
    def _are_confident(self) -> bool:
        return self.scores is None or self.scores.are_confidences

    def _frame(self, name: str) -> LabelledFrame:
        return self.labelled[name]

    def _chosen(self, name: str, states: Collection[ReviewState | None]) -> Sequence[Truth]:
        frame = self._frame(name)
        if frame.states is None:
            return frame.truths
        return [each for each, state in zip(frame.truths, frame.states, strict=True) if state in states]

    def _in_camera(self, name: str, truths: Sequence[Truth], read: Callable[[], Frame]) -> list[Truth]:
        return transformed(truths, self._frame(name).T_camera(read))


# States of the boxes that are taken; None = the format has none.
_ACCEPTED: frozenset[ReviewState | None] = frozenset({None, *REVIEWED})
_OPEN = _ACCEPTED | {ReviewState.PROPOSED}


@contextmanager
def uncollected() -> Iterator[None]:
    """In the block, Python does not look through all boxes again and again for cycles, which they do not have: half of
    the time of reading many."""
    is_collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if is_collecting:
            gc.enable()


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
            away_m = math.hypot(*truth.box.pose[:3, 3].tolist())
            if away_m > FARTHEST_BOX_M:
                raise ValueError(
                    f"a box of {truth.label} is {away_m / 1000:,.0f} km from the camera: its coordinates are a map's, "
                    "but this format's, or the recording's, are not"
                )
    except ValueError as error:
        raise FormatError(dataset.path, f"{name}: {error}; correct its boxes or its calibration") from error
    return truths


def transformed(truths: Sequence[Truth], T: RigidTransform | None) -> list[Truth]:
    """Returns the objects with their boxes transformed; None: as they are."""
    return [truth if T is None else truth.transformed(T) for truth in truths]
