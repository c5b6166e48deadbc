"""The demo with training: drawn boxes, two trained detectors, proposals, scores, exported dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from annotator.demo.stages import (
    Progress,
    Stopwatch,
    add_recording,
    counted,
    dataset_folder,
    generate,
    new_project,
    require_free,
)
from annotator.detection.training import TrainingProgress
from annotator.types import BoxKind, DetectorKind
from annotator.workflows.detectors import active_detectors
from annotator.workflows.evaluating.demo_scores import Scores, score_project
from annotator.workflows.exporting import ExportReport, export_project
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.proposing.batch_store import AnnotateSummary
from annotator.workflows.settings import rcv_config
from annotator.workflows.simulate import Drawn, simulate_recording
from annotator.workflows.training.samples import SampleConfig
from annotator.workflows.training.train import IMAGE_DEFAULTS, VIEW_DEFAULTS, Trained, TrainPlan, train


@dataclass(frozen=True)
class TrainedPlan:
    """Settings of the demo with training.

    Attributes:
        preset: people, hands or objects.
        frames: length of the recording.
        every: every `every`-th frame is labelled; boxes are proposed on the others.
        image_pictures, view_pictures: number of images shown in each training.
    """

    preset: str = "people"
    frames: int = 48
    every: int = 2
    seed: int = 0
    image_pictures: int = 2600
    view_pictures: int = 19000


@dataclass(frozen=True)
class TrainedResult:
    """The result of each stage, and its duration by name."""

    drawn: Drawn
    trained: list[Trained]
    annotated: AnnotateSummary
    scores: list[Scores]
    dataset: ExportReport
    seconds: dict[str, float]


def run_trained(root: Path, plan: TrainedPlan, progress: Progress) -> TrainedResult:
    """Runs the loop in the folder `root`: `recording`, the project `demo`, and the dataset `3D_*`.

    Raises:
        ConfigError, ProjectError: a file or folder of that name exists.
    """
    require_free(root, plan.preset)
    watch = Stopwatch()
    generate(root, plan.preset, plan.frames, plan.seed, progress)
    watch.end("generate")
    with new_project(root, plan.preset) as project:
        recording = add_recording(project, root)
        config = rcv_config(project)
        report = counted(progress, "draw 2D boxes")
        drawn = simulate_recording(project, recording, BoxKind.BOX, config, plan.every, report)
        watch.end("label")
        trained = train(project, _training(plan), progress=lambda role, step: progress(*_training_progress(role, step)))
        watch.end("train")
        annotated = annotate(project, active_detectors(project), config, progress=counted(progress, "propose 3D boxes"))
        watch.end("propose")
        unlabelled = {f.id for n, f in enumerate(project.frames.of([recording])) if n % plan.every}
        scores = score_project(project, recording, unlabelled)
        dataset = export_project(
            project, dataset_folder(root, plan.preset), progress=counted(progress, "write the dataset")
        )
        watch.end("score and export")
    return TrainedResult(drawn, trained, annotated, scores, dataset, watch.seconds)


def _training(plan: TrainedPlan) -> TrainPlan:
    return TrainPlan(
        image=IMAGE_DEFAULTS.model_copy(update={"pictures_seen": plan.image_pictures}),
        view=VIEW_DEFAULTS.model_copy(update={"pictures_seen": plan.view_pictures}),
        samples=SampleConfig(views=320),
    )


def _training_progress(role: DetectorKind, step: TrainingProgress) -> tuple[str, float, float]:
    return f"train the {role} detector", float(step.epochs_done), float(step.epochs)
