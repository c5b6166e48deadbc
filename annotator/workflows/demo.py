"""The whole loop on a generated recording: room, drawn boxes, training, proposals, scores, dataset."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from annotator.detection.progress import TrainingProgress
from annotator.project import BoxRotation, Project, ProjectSettings, Role, create_project
from annotator.recordings import open_recording
from annotator.recordings.generated import write_generated
from annotator.types import BoxKind
from annotator.types.errors import ConfigError
from annotator.workflows.annotate import annotate
from annotator.workflows.batch_book import AnnotateSummary
from annotator.workflows.detectors import active_detectors
from annotator.workflows.exporting import ExportReport, export_project
from annotator.workflows.rcv_settings import rcv_config
from annotator.workflows.recordings import register_recording
from annotator.workflows.samples import SampleConfig
from annotator.workflows.score import Scores, score_project
from annotator.workflows.simulate import Drawn, simulate_recording
from annotator.workflows.train import IMAGE_DEFAULTS, VIEW_DEFAULTS, Trained, TrainPlan, train

RECORDING, PROJECT = "recording", "demo"
LABELS = {"people": "person", "hands": "hand"}
# The room knows gravity, but hands turn as they like.
ROTATIONS = {"people": BoxRotation.UPRIGHT, "hands": BoxRotation.FREE}

Tell = Callable[[str, float, float], None]
"""Told of progress: stage, how much is done, of how much."""


@dataclass(frozen=True)
class DemoPlan:
    """What the demo does.

    Attributes:
        preset: people or hands.
        frames: of the recording; every `every`-th is labelled, the others are proposed.
        image_pictures, view_pictures: lengths of the two trainings, pictures shown.
    """

    preset: str = "people"
    frames: int = 48
    every: int = 2
    seed: int = 0
    image_pictures: int = 1500
    view_pictures: int = 19000


@dataclass(frozen=True)
class DemoResult:
    """What came out of it, stage by stage."""

    drawn: Drawn
    trained: list[Trained]
    annotated: AnnotateSummary
    scores: list[Scores]
    dataset: ExportReport
    seconds: dict[str, float]


def run_demo(root: Path, plan: DemoPlan, tell: Tell) -> DemoResult:
    """Runs the loop in the folder `root`: `recording`, the project `demo`, and the dataset `3D_*`.

    Raises:
        ConfigError, ProjectError: something of that name is there already.
    """
    out = root / f"3D_{LABELS.get(plan.preset, plan.preset).upper()}"
    for path in (root / RECORDING, root / PROJECT, out):  # before minutes of work
        if path.exists():
            raise ConfigError(f"{path}: is there already; choose another folder for the demo")
    seconds: dict[str, float] = {}
    begin = time.perf_counter()

    def stage(name: str) -> None:
        nonlocal begin
        now = time.perf_counter()
        seconds[name] = now - begin
        begin = now

    write_generated(root / RECORDING, plan.preset, plan.frames, plan.seed, report=_counted(tell, "ray-cast a room"))
    stage("generate")
    settings = ProjectSettings(rotation=ROTATIONS[plan.preset])
    with create_project(root, PROJECT, (LABELS[plan.preset],), settings=settings) as project:
        stored = register_recording(project, open_recording(root / RECORDING))
        report = _counted(tell, "draw 2D boxes")
        drawn = simulate_recording(project, stored.id, BoxKind.BOX, rcv_config(project), plan.every, report)
        stage("label")
        trained = train(project, _training(plan), progress=lambda role, step: tell(*_epochs(role, step)))
        stage("train")
        annotated = _propose(project, tell)
        stage("propose")
        unlabelled = {f.id for n, f in enumerate(project.frames.of([stored.id])) if n % plan.every}
        scores = score_project(project, stored.id, unlabelled)
        dataset = export_project(project, out, progress=_counted(tell, "write the dataset"))
        stage("score and export")
    return DemoResult(drawn, trained, annotated, scores, dataset, seconds)


def _training(plan: DemoPlan) -> TrainPlan:
    return TrainPlan(
        image=IMAGE_DEFAULTS.model_copy(update={"pictures_seen": plan.image_pictures}),
        view=VIEW_DEFAULTS.model_copy(update={"pictures_seen": plan.view_pictures}),
        samples=SampleConfig(views=320),
    )


def _propose(project: Project, tell: Tell) -> AnnotateSummary:
    detectors = active_detectors(project)
    config = rcv_config(project).model_copy(update={"box_kind": detectors.box_kind})
    return annotate(project, detectors, config, progress=_counted(tell, "propose 3D boxes"))


def _counted(tell: Tell, stage: str) -> Callable[[int, int], None]:
    return lambda done, total: tell(stage, float(done), float(total))


def _epochs(role: Role, step: TrainingProgress) -> tuple[str, float, float]:
    return f"train the {role} detector", float(step.epochs_done), float(step.epochs)
