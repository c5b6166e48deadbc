"""Trains the base detector from seeds: generated frames, views of their objects, one detector.

    .venv/bin/python scripts/train_base.py FOLDER [--frames N] [--pictures N] [--install]

An interrupted training continues when the command is repeated. `--install` puts the finished detector and its manifest
into the package. docs/base_detector.md describes the method and its results.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import Annotated

import tyro

from annotator.cli.output import print_line
from annotator.detection import pretrained
from annotator.detection.dataset import (
    MANIFEST_NAME,
    DatasetManifest,
    TrainingSample,
    is_held_out,
    read_manifest,
    write_dataset,
)
from annotator.detection.trained import TrainedModel
from annotator.detection.training import TrainingProgress, train_detector
from annotator.files import NETWORK_BYTES, read_file, write_atomic
from annotator.rcv.config import AGNOSTIC_LABELS
from annotator.types import DetectorKind
from annotator.workflows.training.base_detector import BASE_TRAINING, views_of

# Share of the frames that measures and never trains.
VALIDATION_SHARE = 0.02
# Frames that one task of a worker renders.
TASK_FRAMES = 16


def run(
    folder: Annotated[Path, tyro.conf.Positional],
    frames: int = 6000,
    draws: int = 3,
    pictures: int = BASE_TRAINING.pictures_seen,
    model: str = BASE_TRAINING.model,
    size: int = BASE_TRAINING.image_size_px,
    seed: int = 0,
    install: bool = False,
) -> None:
    """Train the base detector.

    Args:
        folder: for the training images and the run.
        frames: number of generated frames.
        draws: crops per object, each with two views.
        pictures: images shown in training, repetitions included.
        model: an ultralytics detection model.
        size: longer side of the views, pixels.
        seed: first seed of the frames.
        install: put the detector into the package.
    """
    drawn = {"frames": frames, "seed": seed, "draws": draws}
    name = f"{frames}-{draws}-{size}-{seed}"
    views = folder / f"views-{name}"
    if (views / MANIFEST_NAME).is_file():
        manifest = read_manifest(views)
    else:
        classes = tuple(AGNOSTIC_LABELS.values())
        samples = _samples(range(seed, seed + frames), draws, size)
        manifest = write_dataset(views, samples, classes, lambda frame: is_held_out(frame, VALIDATION_SHARE))
    epochs = max(round(pictures / manifest.images["train"]), 1)
    changes = {"pictures_seen": pictures, "model": model, "image_size_px": size, "epochs": epochs, "measure_every": 1}
    config = BASE_TRAINING.model_copy(update=changes)
    trained = train_detector(views, folder / f"run-{name}-{pictures}-{model}", config, _report, DetectorKind.VIEW)
    print_line(f"{trained.weights}: {trained.metrics}")
    if install:
        print_line(_install(trained, manifest, drawn))


def _samples(seeds: range, draws: int, size_px: int) -> Iterator[TrainingSample]:
    """The training images of all generated frames, in the order of their seeds."""
    tasks = [seeds[first : first + TASK_FRAMES] for first in range(0, len(seeds), TASK_FRAMES)]
    with ProcessPoolExecutor() as pool:
        for samples in pool.map(views_of, tasks, repeat(draws), repeat(size_px)):
            yield from samples


def _install(trained: TrainedModel, views: DatasetManifest, drawn: dict[str, int]) -> str:
    """Writes a detector into the package, with `manifest.json`: what it was trained on, and how well it does."""
    content = read_file(trained.weights, NETWORK_BYTES)
    manifest = json.dumps(
        {
            **drawn,
            "views": views.images["train"],
            "views_sha256": views.sha256,
            "pictures_shown": views.images["train"] * trained.epochs,
            "hours": round(trained.seconds / 3600, 2),
            "weights_sha256": hashlib.sha256(content).hexdigest(),
            # on views of generated frames that were not trained on
            "map50": round(trained.metrics.map50, 4),
            "map50_95": round(trained.metrics.map50_95, 4),
            "model": trained.config.model,
            "image_size_px": trained.image_size_px,
        },
        indent=1,
    )
    target = pretrained.FOLDER
    target.mkdir(parents=True, exist_ok=True)
    write_atomic(target / trained.weights.name, content)
    trained.write(target)
    write_atomic(target / "manifest.json", manifest.encode())
    return manifest


def _report(step: TrainingProgress) -> None:
    if step.batch % 200 == 0:
        left = "" if step.seconds_left is None else f", {step.seconds_left / 60:.0f} minutes left"
        print_line(f"epoch {step.epoch + 1}/{step.epochs}, batch {step.batch}/{step.batches}{left}")


if __name__ == "__main__":
    tyro.cli(run)
