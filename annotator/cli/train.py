"""`annotator train`"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import ValidationError

from annotator.cli.output import print_line
from annotator.cli.progress import progress_bar
from annotator.cli.projects import Root, open_named
from annotator.detection.config import TrainingConfig
from annotator.detection.progress import TrainingProgress
from annotator.project import Role
from annotator.types.errors import ConfigError
from annotator.workflows.samples import SampleConfig
from annotator.workflows.train import IMAGE_DEFAULTS, VIEW_DEFAULTS, Trained, TrainPlan, train


def run(
    project: str,
    /,
    *,
    only: Role | None = None,
    epochs: int | None = None,
    image_epochs: int | None = None,
    size: int | None = None,
    image_size: int | None = None,
    model: str | None = None,
    weights: str = "auto",
    views: int = SampleConfig().views,
    seed: int = 0,
    root: Root = None,
) -> None:
    """Train the two detectors, one for camera images and one for pseudo-views, from the project's boxes.

    An interrupted training of the same labels with the same settings goes on where it was.

    Args:
        project: the project's name.
        only: train this one only.
        epochs: of the pseudo-view detector; default: what measured best.
        image_epochs: of the image detector; default: what measured best.
        size: side of the pseudo-views in training, pixels.
        image_size: longer side of the camera images in training, pixels.
        model: YOLO model by ultralytics' name, such as yolo11n.
        weights: auto (pretrained weights where they are found or can be downloaded, else random ones), never, or a
            file.
        views: about how many pseudo-views are made of objects that are known in 3D.
        seed: of the split and the training.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    start = weights if weights in ("auto", "never") else Path(weights)
    shared = {"model": model, "pretrained": start, "seed": seed}
    with _told_by_flag():
        samples = SampleConfig(views=views, seed=seed)
    plan = TrainPlan(
        image=_with(IMAGE_DEFAULTS, epochs=image_epochs, image_size_px=image_size, **shared),
        view=_with(VIEW_DEFAULTS, epochs=epochs, image_size_px=size, **shared),
        samples=samples,
        seed=seed,
    )
    roles = (Role.IMAGE, Role.VIEW) if only is None else (only,)
    with open_named(project, root) as opened, progress_bar() as bar:
        tasks = {role: bar.add_task(f"{role} detector", total=None, note="") for role in roles}

        def tell(role: Role, step: TrainingProgress) -> None:
            bar.update(tasks[role], completed=step.epochs_done, total=step.epochs, note=_note(step))

        trained = train(opened, plan, roles=roles, progress=tell)
    for result in trained:
        print_line(_told(result))
    print_line(f"next: annotator annotate {project}")


def _with(config: TrainingConfig, **changes: object) -> TrainingConfig:
    """A copy with the settings that were given, checked.

    Raises:
        ConfigError: one of them is out of its range.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    with _told_by_flag(config is IMAGE_DEFAULTS):
        return TrainingConfig.model_validate({**config.model_dump(), **given})


@contextmanager
def _told_by_flag(of_image: bool = False) -> Iterator[None]:
    """A setting that is out of its range, told as what the user wrote.

    Raises:
        ConfigError: there is one.
    """
    try:
        yield
    except ValidationError as error:
        problem = error.errors()[0]
        allowed = problem["msg"].replace("Input should be", "must be")
        flag = _flag(str(problem["loc"][0]), of_image)
        raise ConfigError(f"{flag} {allowed}, not {problem['input']}") from error


def _flag(setting: str, of_image: bool) -> str:
    """What a setting is called on the command line."""
    name = {"image_size_px": "size", "pretrained": "weights"}.get(setting, setting)
    return f"--image-{name}" if of_image and name in ("epochs", "size") else f"--{name}"


def _note(step: TrainingProgress) -> str:
    return "" if step.map50_95 is None else f"mAP50-95 {step.map50_95:.2f}"


def _told(result: Trained) -> str:
    figures = ", ".join(f"{name} {value:.3f}" for name, value in result.model.metrics.items())
    measured = f"on {result.result.metrics.measured_on} pictures"
    return "\n".join(
        [
            f"{result.role} detector: learnt from {result.manifest.images['train']} pictures in "
            f"{result.seconds:.0f} s; {figures} {measured}",
            f"  {result.result.note}",
            f"  {result.model.path}",
            *(f"  left out: {line}" for line in result.left_out),
        ]
    )
