"""`annotator train`"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from pydantic import ValidationError
from tyro.conf import arg

from annotator.cli.options import Seed
from annotator.cli.output import print_line, print_lines, progress_bar
from annotator.detection.config import MOST_MINUTES, TrainingConfig
from annotator.detection.training import TrainingProgress
from annotator.project import Project
from annotator.types import DetectorKind
from annotator.types.errors import ConfigError
from annotator.types.messages import amount
from annotator.workflows.training import train as training
from annotator.workflows.training.held_out import Decision, measured_ious
from annotator.workflows.training.samples import SampleConfig


def run(
    project: Project,
    /,
    *,
    only: DetectorKind | None = None,
    minutes: float | None = None,
    epochs: int | None = None,
    image_epochs: int | None = None,
    size: Annotated[int | None, arg(help_behavior_hint=f"(default: {training.VIEW_DEFAULTS.image_size_px})")] = None,
    image_size: Annotated[
        int | None, arg(help_behavior_hint=f"(default: {training.IMAGE_DEFAULTS.image_size_px})")
    ] = None,
    model: Annotated[str | None, arg(help_behavior_hint=f"(default: {training.VIEW_DEFAULTS.model})")] = None,
    weights: str = "auto",
    views: int = SampleConfig().views,
    seed: Seed = 0,
) -> None:
    """Train the two detectors, one for camera images and one for pseudo-views, from the project's boxes.

    The pseudo-view detector starts from the best one so far: the project's own or the base detector. A fifth of the
    frames never trains: the 3D boxes found on them decide which detector the project uses afterwards.

    Args:
        only: train only this detector; default: both.
        minutes: how long to train the pseudo-view detector; after three minutes, and at intervals after that, the new
            detector is used if it is better. The image detector then learns longer in proportion. Default: three
            minutes, or by the number of images if there is no detector to start from.
        epochs: epochs of the pseudo-view detector; default: depends on the number of training images.
        image_epochs: epochs of the image detector; default: depends on the number of training images.
        size: side of the pseudo-views in training, pixels.
        image_size: longer side of the camera images in training, pixels.
        model: name of an ultralytics YOLO model.
        weights: initial weights: auto = the best view detector so far, else pretrained ones if found or downloadable,
            else random; never = random; or a path.
        views: approximate number of pseudo-views to generate from objects with 3D boxes.
    """
    if minutes is not None and not 0 < minutes <= MOST_MINUTES:
        raise ConfigError(f"--minutes must be above 0 and at most {MOST_MINUTES}, not {minutes}")
    start = weights if weights in ("auto", "never") else Path(weights)
    shared = {"model": model, "pretrained": start, "seed": seed}
    with _errors_by_option(epochs="--image-epochs", image_size_px="--image-size"):
        image = _with(training.image_defaults(minutes), {"epochs": image_epochs, "image_size_px": image_size, **shared})
    with _errors_by_option(image_size_px="--size"):
        view = _with(training.VIEW_DEFAULTS, {"epochs": epochs, "image_size_px": size, **shared})
        plan = training.TrainPlan(image, view, SampleConfig(views=views, seed=seed), minutes=minutes)
    roles = (DetectorKind.IMAGE, DetectorKind.VIEW) if only is None else (only,)
    with progress_bar() as bar:
        tasks = {role: bar.add_task(f"{role} detector", total=None, note="") for role in roles}

        def progress(role: DetectorKind, step: TrainingProgress) -> None:
            # a run of fixed duration has no known number of epochs
            done, total = (round(100 * step.share_done), 100) if step.is_timed else (step.epochs_done, step.epochs)
            bar.update(tasks[role], completed=done, total=total, note=_note(step))

        trained = training.train(project, plan, roles=roles, progress=progress)
    print_lines([*trained[0].learned, *map(_summary, trained)])
    print_line(f"next: annotator annotate {project.path.name}")


def _with(config: TrainingConfig, changes: Mapping[str, object]) -> TrainingConfig:
    """A checked copy with the settings that are not None."""
    given = {name: value for name, value in changes.items() if value is not None}
    return TrainingConfig.model_validate(config.model_dump() | given)


@contextmanager
def _errors_by_option(**options: str) -> Iterator[None]:
    """Turns validation errors into errors that name the command line's option.

    Args:
        options: those that are not called like the setting.
    """
    try:
        yield
    except ValidationError as error:
        problem = error.errors()[0]
        setting, allowed = str(problem["loc"][0]), problem["msg"].replace("Input should be", "must be")
        option = (options | {"pretrained": "--weights"}).get(setting, f"--{setting}")
        raise ConfigError(f"{option} {allowed}, not {problem['input']}") from error


def _decision_lines(decision: Decision) -> list[str]:
    """What held-out frames decided, as lines for people."""
    lines = [f"  {decision.started_from}", f"  {decision.outcome}"]
    if decision.mean_iou is not None:
        lines.append(f"  mean IoU on {decision.objects} held-out objects: {measured_ious(decision)}")
    return lines


def _note(step: TrainingProgress) -> str:
    return "" if step.map50_95 is None else f"mAP50-95 {step.map50_95:.2f}"


def _summary(result: training.Trained) -> str:
    figures = ", ".join(f"{name} {value:.3f}" for name, value in result.model.metrics.items())
    measured = f"on {result.result.metrics.measured_on} images"
    return "\n".join(
        [
            f"{result.role} detector: trained on {amount(result.manifest.images['train'], 'image')} in "
            f"{result.seconds:.0f} s; {figures} {measured}",
            *([f"  {result.result.note}"] if result.decision is None else _decision_lines(result.decision)),
            f"  {result.model.path}",
            *(f"  left out: {line}" for line in result.left_out),
        ]
    )
