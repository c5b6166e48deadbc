"""What goes to a worker and what comes back: plain values that can be pickled, and that say where a frame is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from annotator.project.config import BoxRotation
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.seeds import Seed


@dataclass(frozen=True)
class RecordingSpec:
    """A recording, as a worker finds it.

    Attributes:
        path: where the project has it; workers may find it elsewhere (`Storage`).
        name: within the project.
        project: the project's name, for messages.
        up: unit vector against gravity in the camera frame, where the project was told one.
    """

    path: Path
    name: str
    project: str
    up: tuple[float, float, float] | None


@dataclass(frozen=True, eq=False)
class FrameSpec:
    """A frame to be done.

    Attributes:
        key: its name within the recording; decides which frame it is, wherever it lies there.
        seeds: boxes that objects had a moment ago, in this frame's camera frame.
    """

    recording: RecordingSpec
    key: str
    seeds: tuple[Seed, ...] = ()


@dataclass(frozen=True, eq=False)
class Task:
    """A few frames that advance through the recursion together; the same ones in every engine, since what a detector
    computes for a picture may differ in its last bits with the pictures beside it.

    Attributes:
        number: counts the tasks of an engine.
        frames: one or more.
        config: settings; the orientation in it is replaced frame by frame.
        rotation: what that follows from.
    """

    number: int
    frames: tuple[FrameSpec, ...]
    config: RcvConfig
    rotation: BoxRotation


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """How one frame ended: `result`, or the `reason` why there is none.

    Attributes:
        seconds: that it took, without waiting for its turn.
    """

    result: FrameProposals | None
    reason: str | None
    seconds: float


@dataclass(frozen=True, eq=False)
class Answer:
    """What came of a task: one answer a frame, in the task's order."""

    number: int
    frames: tuple[FrameAnswer, ...]


@dataclass(frozen=True)
class Identity:
    """What decides the results of a worker.

    Attributes:
        image, view: fingerprints of its detectors.
        backends: what runs them, such as ("openvino", "openvino").
    """

    image: str
    view: str
    backends: tuple[str, str]
