"""Progress of a training run, and the request to stop it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from annotator.detection.trained import RunRecord
from annotator.types import DetectorKind
from annotator.types.errors import DetectionError


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a training run.

    Attributes:
        role: the detector's kind.
        epoch, epochs: number of finished epochs, and of all epochs.
        batch, batches: number of finished batches of the current epoch, and of all its batches.
        losses: mean losses by name, of the current epoch, or of the last one before its first batch.
        map50, map50_95: of the last validation; None before the first.
        seconds: since the run started or was resumed, without pauses.
        seconds_left: an estimate; None before the first batch.
        note: what the run started from.
        is_timed: whether the run has a fixed duration, and `epochs` is an estimate.
        part, parts: number of this run, from 1, and of all runs, of a training in several parts.
    """

    role: DetectorKind
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
    is_timed: bool = False
    part: int = 1
    parts: int = 1

    @property
    def epochs_done(self) -> float:
        """Finished epochs, including the finished fraction of the current one."""
        if self.epoch >= self.epochs or self.batches == 0:
            return float(self.epoch)
        return self.epoch + (self.batch % self.batches) / self.batches

    @property
    def share_done(self) -> float:
        """Finished share of the training, all parts counted alike, 0 to 1."""
        share = self.epochs_done / self.epochs
        if self.is_timed and self.seconds_left is not None:
            share = self.seconds / max(self.seconds + self.seconds_left, 1e-9)
        return (self.part - 1 + min(share, 1.0)) / self.parts


class TrainingStoppedError(DetectionError):
    """The caller stopped the training; the weights so far are kept and the run can be resumed."""


Report = Callable[[TrainingProgress], None]


class Watch:
    """Reports progress to the caller, checks for a stop request, and adds up the time over resumes."""

    def __init__(
        self,
        role: DetectorKind,
        run: RunRecord,
        out: Path,
        epochs: int,
        progress: Report | None,
        stop: Callable[[], bool] | None,
        limit_s: float | None = None,
    ) -> None:
        """
        Args:
            epochs: of the run; a first guess for a run of fixed duration.
            limit_s: duration of the run; None = until its epochs are done.
        """
        self._limit_s = limit_s
        self.role, self.run, self.out, self.epochs = role, run, out, epochs
        self._progress, self._stop = progress, stop
        self._begin, self._paused_s = time.monotonic(), 0.0
        self._batch, self._first_epoch = 0, -1
        self._map50: float | None = None
        self._map50_95: float | None = None

    @property
    def seconds(self) -> float:
        """Since the run started or was resumed, without pauses."""
        return time.monotonic() - self._begin - self._paused_s

    def on_batch(self, trainer: Any) -> None:
        if self._first_epoch < 0:
            self._first_epoch = trainer.start_epoch
        self.epochs = trainer.epochs  # a run of fixed duration estimates it anew after each epoch
        batches = len(trainer.train_loader)
        self._batch = self._batch % batches + 1
        with self._clock_stopped(trainer):
            self._send(trainer, trainer.epoch, self._batch, batches)
            stopped = self._stop is not None and self._stop()
        if stopped:
            raise TrainingStoppedError(
                f"training was stopped in epoch {trainer.epoch + 1} of {self.epochs}; "
                "train again with the same labels and settings to resume"
            )

    def on_epoch(self, trainer: Any) -> None:
        if trainer.fitness is not None:
            self._map50 = float(trainer.metrics["metrics/mAP50(B)"])
            self._map50_95 = float(trainer.metrics["metrics/mAP50-95(B)"])
        self.run.model_copy(update={"seconds": self.run.seconds + self.seconds}).write(self.out)
        with self._clock_stopped(trainer):
            self._send(trainer, trainer.epoch + 1, 0, len(trainer.train_loader))

    @contextmanager
    def _clock_stopped(self, trainer: Any) -> Iterator[None]:
        """The caller's functions block while the training is paused; that time is no training time."""
        begin = time.monotonic()
        yield
        paused_s = time.monotonic() - begin
        self._paused_s += paused_s
        trainer.train_time_start += paused_s

    def _send(self, trainer: Any, epoch: int, batch: int, batches: int) -> None:
        if self._progress is None:
            return
        done = epoch - self._first_epoch + batch / batches
        left = self.seconds / done * (self.epochs - self._first_epoch - done) if done > 0 else None
        if self._limit_s is not None:
            left = max(self._limit_s - self.seconds, 0.0)
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
                self._limit_s is not None,
            )
        )
