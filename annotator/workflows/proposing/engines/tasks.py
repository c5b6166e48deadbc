"""Tasks and answers: picklable values that describe frames instead of containing them."""

from __future__ import annotations

import copyreg
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from annotator.project.config import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.starts import WarmStart
from annotator.types import NO_CORRECTION, BoxKind, Correction


@dataclass(frozen=True)
class RecordingSpec:
    """A recording as a worker needs it.

    Attributes:
        path: on the driver; workers may read it elsewhere (`Storage`).
        name: in the project.
        project: the project's name, for messages.
        up: unit vector against gravity in the camera frame, if the project sets one.
        options, correction: as in `StoredRecording`.
    """

    path: Path
    name: str
    project: str
    up: tuple[float, float, float] | None
    options: str = ""
    correction: Correction = NO_CORRECTION


@dataclass(frozen=True, eq=False)
class FrameSpec:
    """A frame to process.

    Attributes:
        key: its name in the recording, which identifies it.
        seeds: boxes of the previous frame, in this frame's camera frame.
    """

    recording: RecordingSpec
    key: str
    seeds: tuple[WarmStart, ...] = ()


@dataclass(frozen=True, eq=False)
class Task:
    """A few frames that go through the recursion together.

    Every engine gets the same groups, since the other images of a batch may change a detector's results in their last
    bits.

    Attributes:
        number: of the task in its engine.
        frames: one or more.
        config: settings; the orientation is replaced for each frame.
        rotation: gives the orientation.
    """

    number: int
    frames: tuple[FrameSpec, ...]
    config: RcvConfig
    rotation: BoxRotation


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """The `result` of a frame, or the `reason` of its failure.

    Attributes:
        seconds: processing time, without waiting.
    """

    result: FrameProposals | None
    reason: str | None
    seconds: float


@dataclass(frozen=True, eq=False)
class Answer:
    """The answer to a task: one answer per frame, in the task's order."""

    number: int
    frames: tuple[FrameAnswer, ...]


@dataclass(frozen=True)
class Identity:
    """The identity of a worker's detectors; workers with the same identity give the same results.

    Attributes:
        image, view: fingerprints of the detectors.
        backends: their backends, e.g. ("openvino", "openvino").
        box_kind: what the boxes of the view detector measure.
        class_agnostic: whether it measures objects of any class.
        image_kind: what the boxes of the image detector enclose.
        trained: whether the view detector was trained on objects of the project.
    """

    image: str
    view: str
    backends: tuple[str, str]
    box_kind: BoxKind
    class_agnostic: bool = False
    image_kind: BoxKind = BoxKind.BOX
    trained: bool = False


def transform_of(matrix: Float64[np.ndarray, "*n 4 4"]) -> RigidTransform:
    """Returns the transform with exactly this matrix."""
    return RigidTransform(matrix, normalize=False)


def _reduced(transform: RigidTransform) -> tuple[Any, ...]:
    return transform_of, (np.asarray(transform.as_matrix(), np.float64),)


def pickle_exactly() -> None:
    """Makes pickling of poses exact in this process: scipy's own pickle recomputes rotations inexactly."""
    copyreg.pickle(RigidTransform, _reduced)
