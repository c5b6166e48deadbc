"""Runs a task: reads its frames and proposes boxes. Every engine uses it."""

from __future__ import annotations

import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.propose import propose
from annotator.types import Frame
from annotator.types.errors import AnnotatorError
from annotator.workflows.detectors import Detectors
from annotator.workflows.frame_source import OpenedRecording, orientation_for
from annotator.workflows.proposing.engines.storage import MAX_OPEN, Storage
from annotator.workflows.proposing.engines.tasks import (
    Answer,
    FrameAnswer,
    FrameSpec,
    Identity,
    RecordingSpec,
    Task,
    pickle_exactly,
)


@dataclass(frozen=True, eq=False)
class _Read:
    """A frame in memory, its index in the task, and the time to read it."""

    index: int
    spec: FrameSpec
    frame: Frame
    seconds: float


class TaskRunner:
    """Runs tasks with a pair of detectors.

    Two threads may share it: one reads the next task's frames while the other one proposes.

    Attributes:
        detectors: the pair.
    """

    def __init__(self, detectors: Detectors, storage: Storage) -> None:
        # answers may be pickled for another process, which must not change them
        pickle_exactly()
        self.detectors, self._storage = detectors, storage
        self._opened: OrderedDict[RecordingSpec, OpenedRecording] = OrderedDict()
        self._reading, self._proposing = threading.Lock(), threading.Lock()

    @property
    def identity(self) -> Identity:
        """The detectors' identity."""
        pair = self.detectors
        kinds = (pair.box_kind, pair.class_agnostic, pair.image_kind, pair.trained)
        return Identity(pair.image.fingerprint, pair.view.fingerprint, pair.backends, *kinds)

    def do(self, task: Task) -> Answer:
        """Runs a task. Every exception becomes the answer of its frame, so that one frame cannot end a long batch."""
        answers: dict[int, FrameAnswer] = {}
        with self._reading:
            read = self._read_all(task, answers)
        with self._proposing:
            for orientation in Orientation:
                same = [r for r in read if orientation_for(task.rotation, r.frame) is orientation]
                if same:
                    config = task.config.model_copy(update={"orientation": orientation})
                    self._propose(same, config, answers)
        return Answer(task.number, tuple(answers[index] for index in range(len(task.frames))))

    def _read_all(self, task: Task, answers: dict[int, FrameAnswer]) -> list[_Read]:
        read = []
        for index, spec in enumerate(task.frames):
            begin = time.perf_counter()
            try:
                frame = self._opened_at(spec.recording).read(spec.key)
            except Exception as error:
                answers[index] = failure(error, time.perf_counter() - begin)
            else:
                read.append(_Read(index, spec, frame, time.perf_counter() - begin))
        return read

    def _opened_at(self, recording: RecordingSpec) -> OpenedRecording:
        if recording not in self._opened:
            self._opened[recording] = self._storage.open(recording)
            if len(self._opened) > MAX_OPEN:
                self._opened.popitem(last=False)
        self._opened.move_to_end(recording)
        return self._opened[recording]

    def _propose(self, read: Sequence[_Read], config: RcvConfig, answers: dict[int, FrameAnswer]) -> None:
        begin = time.perf_counter()
        try:
            results = self._results(read, config)
        except Exception as error:
            if len(read) == 1:
                answers[read[0].index] = failure(error, read[0].seconds + time.perf_counter() - begin)
            else:  # one by one, so that only the faulty frame fails
                for one in read:
                    self._propose([one], config, answers)
            return
        seconds = (time.perf_counter() - begin) / len(read)
        for one, result in zip(read, results, strict=True):
            answers[one.index] = FrameAnswer(result, None, one.seconds + seconds)

    def _results(self, read: Sequence[_Read], config: RcvConfig) -> list[FrameProposals]:
        seeds = [one.spec.seeds for one in read]
        return propose(
            [one.frame for one in read],
            self.detectors.image,
            self.detectors.view,
            config,
            seeds if any(seeds) else None,
        )


def failure(error: Exception, seconds: float) -> FrameAnswer:
    """Returns the answer of a failed frame; for errors in the program, the reason includes file and line."""
    reason = str(error)
    if not isinstance(error, AnnotatorError):
        place = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
    return FrameAnswer(None, reason, seconds)
