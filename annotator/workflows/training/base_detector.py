"""Trains the base detector: a class-agnostic view detector, from generated frames only.

Every frame, view and training image follows from seeds. No real recording is used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from annotator.detection import pretrained
from annotator.detection.config import Augmentation, TrainingConfig
from annotator.detection.dataset import (
    GENERATED,
    MANIFEST_NAME,
    DatasetManifest,
    TrainingSample,
    is_held_out,
    read_manifest,
    write_dataset,
)
from annotator.detection.trained import TrainedModel, read_trained
from annotator.detection.training import Report, train_detector
from annotator.files import NETWORK_BYTES, read_file, write_atomic
from annotator.formats.reading import read_model
from annotator.rcv.config import AGNOSTIC_LABELS, Orientation, RcvConfig, ViewConfig
from annotator.rcv.recursion import held_direction
from annotator.rcv.teach import TaughtObject, teach_views
from annotator.synthetic.snapshots import Snapshot, snapshot
from annotator.types import DetectorKind, Frame, OrientedBox
from annotator.types.errors import ConfigError

# Share of the frames that measures and never trains.
VALIDATION_SHARE = 0.02
# Frames that one task of a worker renders.
TASK_FRAMES = 16
# An upright view is drawn of objects with an axis within this angle of the vertical, radians.
UPRIGHT_RAD = 0.06
VIEWS, RUN = "views", "run"
MANIFEST_FILE, PLAN_FILE = "manifest.json", "plan.json"


# Random hues, because the colours of generated objects mean nothing.
BASE_TRAINING = TrainingConfig(
    pretrained="never",
    image_size_px=64,
    pictures_seen=400_000,
    batch=32,
    warmup_epochs=0.1,
    augmentation=Augmentation(flip_horizontal=0.5, scale=0.25, hue=0.5, saturation=0.5, brightness=0.4),
)


class BasePlan(BaseModel):
    """How the base detector is trained; stored as `plan.json` in the folder of the training.

    Attributes:
        frames: number of generated frames.
        draws: crops per object, each with two views.
        seed: first seed of the frames.
        config: settings of the training.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames: int = Field(6000, ge=1)
    draws: int = Field(3, ge=1)
    seed: int = Field(0, ge=0)
    config: TrainingConfig = BASE_TRAINING


def train_base(folder: Path, plan: BasePlan, progress: Report | None = None) -> TrainedModel:
    """Draws the training images, unless an earlier run has, and trains the detector; an interrupted run continues.

    Args:
        folder: for the training images and the run.
        progress: called after each step of the training.

    Raises:
        ConfigError: the folder belongs to another plan.
        DetectionError: the training failed.
        FormatError: the folder cannot be written.
    """
    _claim(folder, plan)
    views = folder / VIEWS
    manifest = _existing(views) or write_dataset(
        views, samples(plan), tuple(AGNOSTIC_LABELS.values()), lambda frame: is_held_out(frame, VALIDATION_SHARE)
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
        views_sha256: hash of the training images and their boxes; empty if it was not recorded.
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


def install_base(folder: Path, target: Path | None = None) -> BaseManifest:
    """Writes a finished base detector with its manifest into the package, in place of an earlier one.

    Args:
        folder: as for `train_base`, which has finished.
        target: None = the package's folder.

    Raises:
        FormatError: the training has not finished.
        OSError: the files cannot be written.
    """
    trained, views, plan = read_trained(folder / RUN), read_manifest(folder / VIEWS), _read_plan(folder)
    content = read_file(trained.weights, NETWORK_BYTES)
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
    target = target or pretrained.FOLDER
    target.mkdir(parents=True, exist_ok=True)
    write_atomic(target / trained.weights.name, content)
    trained.write(target)
    write_atomic(target / MANIFEST_FILE, manifest.model_dump_json(indent=1).encode())
    return manifest


def _claim(folder: Path, plan: BasePlan) -> None:
    """Stores the plan in a new folder; in an existing one, requires the same plan."""
    if (folder / PLAN_FILE).is_file():
        if _read_plan(folder) != plan:
            raise ConfigError(f"{folder / PLAN_FILE}: belongs to a training with other settings; use another folder")
        return
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / PLAN_FILE, plan.model_dump_json(indent=1).encode())


def _read_plan(folder: Path) -> BasePlan:
    return read_model(folder / PLAN_FILE, BasePlan)


def _existing(views: Path) -> DatasetManifest | None:
    return read_manifest(views) if (views / MANIFEST_NAME).is_file() else None


def samples(plan: BasePlan) -> Iterator[TrainingSample]:
    """The training images of all generated frames, in the order of their seeds."""
    seeds = range(plan.seed, plan.seed + plan.frames)
    tasks = [seeds[first : first + TASK_FRAMES] for first in range(0, plan.frames, TASK_FRAMES)]
    size = plan.config.image_size_px
    with ProcessPoolExecutor() as pool:
        for drawn in pool.map(_draw_task, tasks, [plan.draws] * len(tasks), [size] * len(tasks)):
            yield from drawn


def _draw_task(seeds: range, draws: int, size_px: int) -> list[TrainingSample]:
    return [sample for seed in seeds for sample in generated_views(seed, draws, size_px)]


def generated_views(seed: int, draws: int, size_px: int) -> Iterator[TrainingSample]:
    """The labelled views of one generated frame.

    Args:
        draws: crops per object, each with two views.
        size_px: longer side of the views.
    """
    return _of_frame(snapshot(seed), seed, draws, size_px)


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
            for taught in teach_views(shot.frame, objects, None, 1, config, up, random, targets=[index]):
                yield TrainingSample(taught.view.rgb, taught.boxes, f"snapshot/{seed}", GENERATED)


def _is_upright(box: OrientedBox, frame: Frame) -> bool:
    return frame.up is not None and bool(np.abs(frame.up @ box.rotation).max() > np.cos(UPRIGHT_RAD))
