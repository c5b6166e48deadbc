"""Trains the base detector from seeds: generated frames, views of their objects, one detector.

    .venv/bin/python scripts/train_base.py FOLDER [--frames N] [--pictures N] [--install]

An interrupted training continues when the command is repeated. `--install` puts the finished detector and its manifest
into the package. docs/base_detector.md describes the method and its results.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from annotator.cli.output import print_line
from annotator.detection.training import TrainingProgress
from annotator.workflows.training.base_detector import BASE_TRAINING, BasePlan, install_base, train_base

DEFAULTS = BasePlan()


def run(
    folder: Annotated[Path, tyro.conf.Positional],
    frames: int = DEFAULTS.frames,
    draws: int = DEFAULTS.draws,
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
    config = BASE_TRAINING.model_copy(update={"pictures_seen": pictures, "model": model, "image_size_px": size})
    plan = BasePlan(frames=frames, draws=draws, seed=seed, config=config)
    trained = train_base(folder, plan, _report)
    print_line(f"{trained.weights}: {trained.metrics}")
    if install:
        print_line(install_base(folder).model_dump_json(indent=1))


def _report(step: TrainingProgress) -> None:
    if step.batch % 200 == 0:
        left = "" if step.seconds_left is None else f", {step.seconds_left / 60:.0f} minutes left"
        print_line(f"epoch {step.epoch + 1}/{step.epochs}, batch {step.batch}/{step.batches}{left}")


if __name__ == "__main__":
    tyro.cli(run)
