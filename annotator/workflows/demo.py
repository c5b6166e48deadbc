"""Runs the whole loop on a generated recording: drawn boxes, training, proposals, scores, exported dataset."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from annotator.detection.progress import TrainingProgress
from annotator.project import BoxRotation, Project, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import active_detectors
from annotator.workflows.evaluating.demo_scores import Scores, score_project
from annotator.workflows.exporting import ExportReport, export_project
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.proposing.batch_store import AnnotateSummary
from annotator.workflows.settings import rcv_config
from annotator.workflows.simulate import Drawn, simulate_recording
from annotator.workflows.training.samples import SampleConfig
from annotator.workflows.training.train import IMAGE_DEFAULTS, VIEW_DEFAULTS, Trained, TrainPlan, train

RECORDING, PROJECT = "recording", "demo"
LABELS = {"people": "person", "hands": "hand", "objects": "object"}
# People and objects stand upright; hands may be turned in any way.
ROTATIONS = {"people": BoxRotation.UPRIGHT, "hands": BoxRotation.FREE, "objects": BoxRotation.UPRIGHT}

Progress = Callable[[str, float, float], None]
"""Called with (stage, amount done, total amount)."""


@dataclass(frozen=True)
class DemoPlan:
    """Settings of the demo.

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
    image_pictures: int = 1500
    view_pictures: int = 19000


@dataclass(frozen=True)
class DemoResult:
    """The result of each stage, and its duration by name."""

    drawn: Drawn
    trained: list[Trained]
    annotated: AnnotateSummary
    scores: list[Scores]
    dataset: ExportReport
    seconds: dict[str, float]


def run_demo(root: Path, plan: DemoPlan, progress: Progress) -> DemoResult:
    """Runs the loop in the folder `root`: `recording`, the project `demo`, and the dataset `3D_*`.

    Raises:
        ConfigError, ProjectError: a file or folder of that name exists.
    """
    out = root / f"3D_{LABELS.get(plan.preset, plan.preset).upper()}"
    for path in (root / RECORDING, root / PROJECT, out):  # before minutes of work
        if path.exists():
            raise ConfigError(f"{path}: exists already; choose another folder for the demo")
    seconds: dict[str, float] = {}
    begin = time.perf_counter()

    def stage(name: str) -> None:
        nonlocal begin
        now = time.perf_counter()
        seconds[name] = now - begin
        begin = now

    write_generated(
        root / RECORDING, plan.preset, plan.frames, plan.seed, report=_stage_progress(progress, "ray-cast a room")
    )
    stage("generate")
    settings = ProjectSettings(rotation=ROTATIONS[plan.preset])
    with create_project(root, PROJECT, (LABELS[plan.preset],), settings=settings) as project:
        stored = register_recording(project, open_recording(root / RECORDING))
        report = _stage_progress(progress, "draw 2D boxes")
        drawn = simulate_recording(project, stored.id, BoxKind.BOX, rcv_config(project), plan.every, report)
        stage("label")
        trained = train(project, _training(plan), progress=lambda role, step: progress(*_training_progress(role, step)))
        stage("train")
        annotated = _propose(project, progress)
        stage("propose")
        unlabelled = {f.id for n, f in enumerate(project.frames.of([stored.id])) if n % plan.every}
        scores = score_project(project, stored.id, unlabelled)
        dataset = export_project(project, out, progress=_stage_progress(progress, "write the dataset"))
        stage("score and export")
    return DemoResult(drawn, trained, annotated, scores, dataset, seconds)


def _training(plan: DemoPlan) -> TrainPlan:
    return TrainPlan(
        image=IMAGE_DEFAULTS.model_copy(update={"pictures_seen": plan.image_pictures}),
        view=VIEW_DEFAULTS.model_copy(update={"pictures_seen": plan.view_pictures}),
        samples=SampleConfig(views=320),
    )


def _propose(project: Project, progress: Progress) -> AnnotateSummary:
    report = _stage_progress(progress, "propose 3D boxes")
    return annotate(project, active_detectors(project), rcv_config(project), progress=report)


def _stage_progress(progress: Progress, stage: str) -> Callable[[int, int], None]:
    return lambda done, total: progress(stage, float(done), float(total))


def _training_progress(role: DetectorKind, step: TrainingProgress) -> tuple[str, float, float]:
    return f"train the {role} detector", float(step.epochs_done), float(step.epochs)
