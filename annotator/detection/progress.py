"""How far a training run is, and the wish to stop it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from annotator.detection.config import Role
from annotator.detection.trained import RunRecord
from annotator.types.errors import DetectionError


@dataclass(frozen=True)
class TrainingProgress:
    """How far a run is.

    Attributes:
        role: which detector.
        epoch, epochs: epochs that are finished, of how many.
        batch, batches: batches of the running epoch that are finished, of how many.
        losses: the running epoch's mean losses by name, or the last one's.
        map50, map50_95: of the last measurement; None before the first.
        seconds: since the run began (this time, where it was resumed).
        seconds_left: an estimate; None before there is anything to estimate from.
        note: what it started from.
    """

    role: Role
    epoch: int
    epochs: int
    batch: int
    batches: int
    losses: dict[str, float]
    map50: float | None
    map50_95: float | None
    seconds: float
    seconds_left: float | None
    note: str

    @property
    def epochs_done(self) -> float:
        """Epochs with the part of the running one."""
        if self.epoch >= self.epochs or self.batches == 0:
            return float(self.epoch)
        return self.epoch + (self.batch % self.batches) / self.batches


class TrainingStoppedError(DetectionError):
    """The caller's `stop` said so; what was learnt so far is kept and the run can go on."""


Report = Callable[[TrainingProgress], None]


class Watch:
    """Carries progress to the caller, asks whether to stop, and keeps the time over resumes."""

    def __init__(
        self,
        role: Role,
        run: RunRecord,
        out: Path,
        epochs: int,
        progress: Report | None,
        stop: Callable[[], bool] | None,
    ) -> None:
        self.role, self.run, self.out, self.epochs = role, run, out, epochs
        self._progress, self._stop = progress, stop
        self._begin = time.monotonic()
        self._batch, self._first_epoch = 0, -1
        self._map50: float | None = None
        self._map50_95: float | None = None

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._begin

    def on_batch(self, trainer: Any) -> None:
        if self._first_epoch < 0:
            self._first_epoch = trainer.start_epoch
        batches = len(trainer.train_loader)
        self._batch = self._batch % batches + 1
        self._tell(trainer, trainer.epoch, self._batch, batches)
        if self._stop is not None and self._stop():
            raise TrainingStoppedError(
                f"training was stopped in epoch {trainer.epoch + 1} of {self.epochs}; "
                "train again with the same labels and settings to go on from there"
            )

    def on_epoch(self, trainer: Any) -> None:
        if trainer.fitness is not None:
            self._map50 = float(trainer.metrics["metrics/mAP50(B)"])
            self._map50_95 = float(trainer.metrics["metrics/mAP50-95(B)"])
        self.run.model_copy(update={"seconds": self.run.seconds + self.seconds}).write(self.out)
        self._tell(trainer, trainer.epoch + 1, 0, len(trainer.train_loader))

    def _tell(self, trainer: Any, epoch: int, batch: int, batches: int) -> None:
        if self._progress is None:
            return
        done = epoch - self._first_epoch + batch / batches
        left = self.seconds / done * (self.epochs - self._first_epoch - done) if done > 0 else None
        losses = {name: float(value) for name, value in (trainer.tloss or {}).items()}
        self._progress(
            TrainingProgress(
                self.role,
                epoch,
                self.epochs,
                batch,
                batches,
                losses,
                self._map50,
                self._map50_95,
                self.seconds,
                left,
                self.run.note,
            )
        )
