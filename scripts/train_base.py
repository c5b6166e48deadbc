"""Trains the base detector from seeds: generated frames, views of their objects, one detector.

    .venv/bin/python scripts/train_base.py FOLDER [--frames N] [--pictures N] [--install]

An interrupted training continues when the command is repeated. `--install` puts the finished detector and its manifest
into the package. docs/base_detector.md describes the method and its results.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from annotator.detection.progress import TrainingProgress
from annotator.workflows.training.base_detector import BASE_TRAINING, BasePlan, train_base


def run(
    folder: Annotated[Path, tyro.conf.Positional],
    frames: int = BasePlan.frames,
    draws: int = BasePlan.draws,
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
    plan = replace(BasePlan(frames, draws, seed), config=config)
    train_base(folder, plan, _report)
    if install:
        pass


def _report(step: TrainingProgress) -> None:
    if step.batch % 200 == 0:
        "" if step.seconds_left is None else f", {step.seconds_left / 60:.0f} minutes left"


if __name__ == "__main__":
    tyro.cli(run)
