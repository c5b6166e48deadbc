"""Trains the base detector: a class-agnostic view detector, from generated frames only.

Every frame, view and training image follows from seeds. No real recording is used.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.detection.base_detector import FOLDER
from annotator.detection.config import Augmentation, TrainingConfig
from annotator.detection.dataset import TrainingSample, write_dataset
from annotator.detection.manifest import MANIFEST_NAME, DatasetManifest, read_manifest
from annotator.detection.progress import Report
from annotator.detection.trained import TrainedModel, read_trained
from annotator.detection.training import train_detector
from annotator.files import write_atomic
from annotator.rcv.config import AGNOSTIC_LABELS, Orientation, RcvConfig, ViewConfig
from annotator.rcv.recursion import held_direction
from annotator.rcv.teach import TaughtObject, teach_agnostic_views
from annotator.synthetic.snapshots import Snapshot, snapshot
from annotator.types import DetectorKind, Frame, OrientedBox

# Frames that one task of a worker renders.
TASK_FRAMES = 16
# An upright view is drawn of objects with an axis within this angle of the vertical, radians.
UPRIGHT_RAD = 0.06
VIEWS, RUN = "views", "run"
MANIFEST_FILE = "manifest.json"


# Random hues, because the colours of generated objects mean nothing.
BASE_TRAINING = TrainingConfig(
    pretrained="never",
    image_size_px=64,
    pictures_seen=400_000,
    batch=32,
    warmup_epochs=0.1,
    augmentation=Augmentation(flip_horizontal=0.5, scale=0.25, hue=0.5, saturation=0.5, brightness=0.4),
)


@dataclass(frozen=True)
class BasePlan:
    """How the base detector is trained.

    Attributes:
        frames: number of generated frames.
        draws: crops per object, each with two views.
        seed: first seed of the frames.
        config: settings of the training.
        processes: processes that render frames; None = one per core.
    """

    frames: int = 6000
    draws: int = 3
    seed: int = 0
    config: TrainingConfig = BASE_TRAINING
    processes: int | None = None


def train_base(folder: Path, plan: BasePlan, progress: Report | None = None) -> TrainedModel:
    """Draws the training images, unless an earlier run has, and trains the detector; an interrupted run continues.

    Args:
        folder: for the training images and the run.
        progress: called after each step of the training.

    Raises:
        DetectionError: the training failed.
        FormatError: the folder cannot be written.
    """
    views = folder / VIEWS
    manifest = _existing(views) or write_dataset(
        views, samples(plan), tuple(AGNOSTIC_LABELS.values()), val_share=0.02, seed=plan.seed
    )
    epochs = plan.config.epochs or max(round(plan.config.pictures_seen / manifest.images["train"]), 1)
    config = plan.config.model_copy(update={"epochs": epochs, "measure_every": 1})
    return train_detector(views, folder / RUN, config, progress, DetectorKind.VIEW)


class BaseManifest(BaseModel):
    """`manifest.json` beside the base detector's weights: what it was trained on, and how well it does.

    Attributes:
        frames, seed: number of generated frames, and the first seed.
        draws: crops per object.
        views: training images.
        views_sha256: hash of the training images and their boxes.
        pictures_shown: images shown in training, repetitions included.
        hours: duration of the training.
        weights_sha256: hash of the weights file.
        map50, map50_95: on views of generated frames that were not trained on.
        model: name of the architecture.
        image_size_px: size of the views.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames: int
    seed: int
    draws: int
    views: int
    views_sha256: str
    pictures_shown: int
    hours: float
    weights_sha256: str
    map50: float
    map50_95: float
    model: str
    image_size_px: int


def install_base(folder: Path, plan: BasePlan, target: Path = FOLDER) -> BaseManifest:
    """Writes a finished base detector with its manifest into the package, in place of an earlier one.

    Args:
        folder: as for `train_base`, which has finished.
        plan: of that training.
        target: the package's folder.

    Raises:
        FormatError: the training has not finished.
        OSError: the files cannot be written.
    """
    trained, views = read_trained(folder / RUN), read_manifest(folder / VIEWS)
    content = trained.weights.read_bytes()
    manifest = BaseManifest(
        frames=plan.frames,
        seed=plan.seed,
        draws=plan.draws,
        views=views.images["train"],
        views_sha256=views.sha256,
        pictures_shown=views.images["train"] * trained.epochs,
        hours=round(trained.seconds / 3600, 2),
        weights_sha256=hashlib.sha256(content).hexdigest(),
        map50=round(trained.metrics.map50, 4),
        map50_95=round(trained.metrics.map50_95, 4),
        model=trained.config.model,
        image_size_px=trained.image_size_px,
    )
    target.mkdir(parents=True, exist_ok=True)
    write_atomic(target / trained.weights.name, content)
    trained.write(target)
    write_atomic(target / MANIFEST_FILE, manifest.model_dump_json(indent=1).encode())
    return manifest


def _existing(views: Path) -> DatasetManifest | None:
    return read_manifest(views) if (views / MANIFEST_NAME).is_file() else None


def samples(plan: BasePlan) -> Iterator[TrainingSample]:
    """The training images of all generated frames, in the order of their seeds."""
    seeds = range(plan.seed, plan.seed + plan.frames)
    tasks = [seeds[first : first + TASK_FRAMES] for first in range(0, plan.frames, TASK_FRAMES)]
    size = plan.config.image_size_px
    with ProcessPoolExecutor(plan.processes or os.cpu_count()) as pool:
        for drawn in pool.map(_draw_task, tasks, [plan.draws] * len(tasks), [size] * len(tasks)):
            yield from drawn


def _draw_task(seeds: range, draws: int, size_px: int) -> list[TrainingSample]:
    return [sample for seed in seeds for sample in _of_frame(snapshot(seed), seed, draws, size_px)]


def _of_frame(shot: Snapshot, seed: int, draws: int, size_px: int) -> Iterator[TrainingSample]:
    """Views of each object; those of upright objects are level in half of the crops."""
    random = np.random.default_rng([seed, draws])
    objects = [TaughtObject(item.label, item.box, item.points) for item in shot.objects]
    config = RcvConfig(view=ViewConfig(size_px=size_px))
    for index, item in enumerate(objects):
        for _ in range(draws):
            upright = random.random() < 0.5 and _is_upright(item.box, shot.frame)
            orientation = Orientation.UPRIGHT if upright else Orientation.FREE
            up = held_direction(shot.frame.up, config.model_copy(update={"orientation": orientation}))
            for taught in teach_agnostic_views(shot.frame, objects, [index], 1, config, up, random):
                yield TrainingSample(taught.view.rgb, taught.boxes, f"snapshot/{seed}", "generated")


def _is_upright(box: OrientedBox, frame: Frame) -> bool:
    return frame.up is not None and bool(np.abs(frame.up @ box.rotation).max() > np.cos(UPRIGHT_RAD))
