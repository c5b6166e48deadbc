"""Trains one detector from a training set on disk; reports progress, can be stopped and resumed."""

from __future__ import annotations

import hashlib
import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import DatasetManifest, read_manifest
from annotator.detection.edge_errors import with_edge_errors
from annotator.detection.pretrained import check_model_name, check_weights, find_starting_point
from annotator.detection.trained import (
    BEST,
    LAST,
    MODEL_NAME,
    RunRecord,
    TrainedModel,
    TrainingMetrics,
    read_state,
    read_trained,
    read_weights,
    resumable,
)
from annotator.detection.ultralytics_api import api, pick_device
from annotator.detection.weights import write_network
from annotator.files import lock_folder, read_text_file
from annotator.types import DetectorKind
from annotator.types.errors import ConfigError, DetectionError, FormatError


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a training run.

    Attributes:
        losses: mean losses by name, of the current epoch, or of the last one before its first batch.
        map50, map50_95: of the last validation; None before the first.
        seconds: since the run started or was resumed, without pauses.
        seconds_left: an estimate; None before the first batch.
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


@dataclass
class Watch:
    """A run. It reports progress to the caller, checks for a stop request, and adds up the time over resumes.

    Attributes:
        begun: what it started from, and the time before it was resumed.
        weights: those of another detector to start from; None = random ones.
        checkpoint: one of this run, to resume from.
        epochs: of a run of fixed duration, an estimate.
        measure_every: epochs between validations; the last epoch is always validated.
        limit_s: duration of the run; None = until its epochs are done.
    """

    dataset: Path
    manifest: DatasetManifest
    config: TrainingConfig
    role: DetectorKind
    out: Path
    device: Any
    begun: RunRecord
    weights: Path | None = None
    checkpoint: Path | None = None
    progress: Report | None = None
    stop: Callable[[], bool] | None = None

    def __post_init__(self) -> None:
        config = self.config
        self.epochs = config.epochs_for(self.manifest.images["train"])
        self.measure_every = config.measure_every or max(math.ceil(self.epochs / MEASUREMENTS), 1)
        self.limit_s = None if config.epochs else config.seconds
        self._begin, self._paused_s = time.monotonic(), 0.0
        self._batch, self._first_epoch = 0, -1
        self._measured: tuple[float, float] | tuple[None, None] = (None, None)

    @property
    def record(self) -> RunRecord:
        """What it started from, and its time so far."""
        return self.begun.model_copy(update={"seconds": self.begun.seconds + self.seconds})

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
            stopped = self.stop is not None and self.stop()
        if stopped:
            raise TrainingStoppedError(
                f"training was stopped in epoch {trainer.epoch + 1} of {self.epochs}; "
                "train again with the same labels and settings to resume"
            )

    def on_epoch(self, trainer: Any) -> None:
        if trainer.fitness is not None:
            metrics = trainer.metrics
            self._measured = float(metrics["metrics/mAP50(B)"]), float(metrics["metrics/mAP50-95(B)"])
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
        if self.progress is None:
            return
        done = epoch - self._first_epoch + batch / batches
        left = self.seconds / done * (self.epochs - self._first_epoch - done) if done > 0 else None
        if self.limit_s is not None:
            left = max(self.limit_s - self.seconds, 0.0)
        losses = {name: float(value) for name, value in (trainer.tloss or {}).items()}
        known, (map50, map50_95) = (self.role, epoch, self.epochs, batch, batches, losses), self._measured
        note, is_timed = self.begun.note, self.limit_s is not None
        self.progress(TrainingProgress(*known, map50, map50_95, self.seconds, left, note, is_timed))


# Approximate number of validations per run, without `measure_every`.
MEASUREMENTS = 12
DETECTOR = "detector.safetensors"
# Random changes of training images that differ between the detectors: of size, saturation and brightness, shares.
COLOURS_AND_SCALE = {
    DetectorKind.IMAGE: {"scale": 0.3, "hsv_s": 0.5, "hsv_v": 0.4},
    DetectorKind.VIEW: {"scale": 0.2, "hsv_s": 0.2, "hsv_v": 0.2},
}


def train_detector(
    dataset: Path,
    out: Path,
    config: TrainingConfig,
    progress: Report | None = None,
    role: DetectorKind = DetectorKind.VIEW,
    stop: Callable[[], bool] | None = None,
) -> TrainedModel:
    """Trains a detector, or resumes an interrupted run of the same training set and settings in `out`.

    A complete run is not repeated. With another training set or other settings the training starts again and replaces
    the content of `out`. An interrupt (Ctrl-C, `stop`, a killed process) loses at most the current epoch.

    Args:
        dataset: a folder written by `write_dataset`.
        out: folder of the run; `detector.safetensors`, `model.json` and `curves.csv` are written there.
        progress: called after every batch and every epoch.
        stop: called after every batch; true stops the run.
    """
    if "?" in str(out.resolve()):  # ultralytics would fail, but only after the training
        raise ConfigError(f"{out.resolve()}: a detector cannot be kept in a folder with a question mark; rename it")
    manifest = read_manifest(dataset)
    device = pick_device(config.device)
    fingerprint = _fingerprint(manifest.sha256, config, role)
    with suppress(FormatError):  # not finished, or damaged
        known = read_trained(out)
        if known.weights.is_file() and _fingerprint(known.dataset_sha256, known.config, known.role) == fingerprint:
            return known
    checkpoint, weights = out / "weights" / LAST, None
    state = resumable(checkpoint)
    if state is None or state.run.fingerprint != fingerprint:
        start, state = find_starting_point(config), None
        weights = start.weights
        if weights is not None:
            check_weights(weights)
        _clear(out)
        out.mkdir(parents=True, exist_ok=True)
        begun = RunRecord(fingerprint=fingerprint, pretrained=start.pretrained, note=start.note, seconds=0.0)
    else:
        begun = state.run
    resumed = None if state is None else checkpoint
    watch = Watch(dataset, manifest, config, role, out, device, begun, weights, resumed, progress, stop)
    with lock_folder(out):  # nobody takes this run for one that was killed
        if state is None or state.epoch + 1 < watch.epochs:
            _run(watch, 0 if state is None else state.epoch + 1)
        return _finish(watch)


def _run(watch: Watch, epochs_done: int) -> None:
    from annotator.detection.trainer import make_trainer

    settings = trainer_settings(watch.config, watch.role, watch.epochs, str(watch.device), watch.out)
    settings["model"] = f"{check_model_name(watch.config.model)}.yaml"
    # a checkpoint that somebody else wrote may lack settings, or have others
    failures: tuple[type[Exception], ...] = (RuntimeError, ValueError, OSError, AssertionError)
    if watch.checkpoint is not None:
        settings["resume"] = True  # keeps the curves
        _trim_curves(watch.out / "results.csv", epochs_done)
        failures += (LookupError, TypeError, AttributeError)
    # The trainer checks that this file exists before it calls get_dataset.
    settings["data"] = str(watch.dataset.resolve() / "data.yaml")
    with _unchanged_torch():
        try:
            make_trainer(settings, watch).train()
        except failures as error:
            raise DetectionError(f"training in {watch.out} failed: {error}") from error


def trainer_settings(config: TrainingConfig, role: DetectorKind, epochs: int, device: str, out: Path) -> dict[str, Any]:
    """The settings under ultralytics' names."""
    # Unlike ultralytics' other mixed precision, bfloat16 needs no trial run with downloaded weights.
    mixed = "bf16" if device.startswith("cuda") and api().torch.cuda.is_bf16_supported() else False
    return {
        "task": "detect",
        "save_dir": str(out.resolve()),
        "exist_ok": True,
        "epochs": epochs,
        # hours
        "time": None if config.epochs or config.seconds is None else config.seconds / 3600,
        "imgsz": config.image_size_px,
        "batch": config.batch,
        "nbs": config.batch,
        "patience": 0,  # never stops early
        "optimizer": "MuonSgd",
        "lr0": 0.01,  # the peak, and the share of it that is left at the end
        "lrf": 0.01,
        "momentum": 0.9,
        "weight_decay": 0.0005,
        "warmup_epochs": 1.0,
        "warmup_bias_lr": 0.0,
        # weights of the losses on the overlap of boxes, on classes and on edges
        "box": 7.5,
        "cls": 0.5,
        "dfl": 1.5,
        # No rotation, shear or perspective: the box around a rotated box is larger than that of the rotated object, so
        # the detector would learn boxes that are too large. Mirroring pseudo-views reduces overfitting on small sets,
        # although real views are never mirrored (docs/detector_training.md).
        **dict.fromkeys(("flipud", "degrees", "shear", "perspective", "mosaic"), 0.0),
        "close_mosaic": 0,
        "fliplr": 0.5,
        "translate": 0.1,
        "hsv_h": 0.015,
        **COLOURS_AND_SCALE[role],
        "seed": config.seed,
        "deterministic": False,
        "device": device.removeprefix("cuda:") if device != "cuda" else "0",
        "workers": 0,
        "cache": "ram",
        "amp": mixed,
        "plots": False,
        "verbose": False,
        **config.recipe,
    }


@contextmanager
def _unchanged_torch() -> Iterator[None]:
    """Restores torch's number of threads, which the trainer changes for the whole process."""
    torch = api().torch
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _fingerprint(dataset_sha256: str, config: TrainingConfig, role: DetectorKind) -> str:
    """Hash of all that determines a run: training set, settings, detector kind."""
    settings = config.model_dump_json(exclude={"device"})
    return hashlib.sha256(f"{dataset_sha256} {role} {settings}".encode()).hexdigest()


def _clear(out: Path) -> None:
    """Removes the files of an earlier run, and no others."""
    for name in (MODEL_NAME, DETECTOR, "curves.csv", "results.csv", "args.yaml"):
        (out / name).unlink(missing_ok=True)
    shutil.rmtree(out / "weights", ignore_errors=True)


def _trim_curves(path: Path, epochs_done: int) -> None:
    """Drops the rows of epochs that will be repeated."""
    if not path.is_file():
        return
    lines = read_text_file(path).splitlines(keepends=True)
    path.write_text("".join(lines[: epochs_done + 1]), encoding="utf-8")


def _finish(watch: Watch) -> TrainedModel:
    """Writes the best weights, the curves and `model.json`; removes the files that only a resume needs."""
    role, out, manifest, record = watch.role, watch.out, watch.manifest, watch.record
    best = out / "weights" / BEST
    if not best.is_file():
        raise DetectionError(f"{best}: the training wrote no weights; train again")
    model, metrics = read_weights(best)
    measured = {name: value for name, value in metrics.items() if value is not None}
    write_network(out / DETECTOR, model)
    (out / "results.csv").replace(out / "curves.csv")
    trained = TrainedModel(
        role=role,
        weights=out / DETECTOR,
        classes=manifest.classes,
        kind=manifest.kind,
        image_size_px=watch.config.image_size_px,
        metrics=TrainingMetrics(
            map50=measured["metrics/mAP50(B)"],
            map50_95=measured["metrics/mAP50-95(B)"],
            precision=measured["metrics/precision(B)"],
            recall=measured["metrics/recall(B)"],
            measured_on=manifest.measured_on,
        ),
        epochs=read_state(out / "weights" / LAST).epoch + 1,
        seconds=record.seconds,
        pretrained=record.pretrained,
        note=record.note,
        dataset_sha256=manifest.sha256,
        config=watch.config,
    )
    if role is DetectorKind.VIEW:
        trained = with_edge_errors(trained, watch.dataset, manifest, watch.config.device)
    trained.write(out)
    shutil.rmtree(out / "weights", ignore_errors=True)
    (out / "args.yaml").unlink(missing_ok=True)
    return trained
