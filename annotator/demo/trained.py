"""The demo with training: drawn boxes, two trained detectors, proposals, scores, exported dataset."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

from annotator.detection.training import TrainingProgress
from annotator.project import BoxRotation, Project, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import active_detectors
from annotator.workflows.evaluating.evaluate_project import Scores, score_project
from annotator.workflows.exporting import ExportReport, export_project
from annotator.workflows.proposing.annotate import AnnotateSummary, annotate
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


@dataclass
class Stopwatch:
    """The duration of each stage, seconds, by name."""

    seconds: dict[str, float] = field(default_factory=dict)
    _begin: float = field(default_factory=time.perf_counter)

    def end(self, stage: str) -> None:
        """Ends a stage, and begins the next."""
        now = time.perf_counter()
        self.seconds[stage] = now - self._begin
        self._begin = now


def counted(progress: Progress, stage: str) -> Callable[[int, int], None]:
    """The progress of a stage whose steps are counted."""
    return lambda done, total: progress(stage, float(done), float(total))


def dataset_folder(root: Path, preset: str) -> Path:
    return root / f"3D_{LABELS.get(preset, preset).upper()}"


def require_free(root: Path, preset: str) -> None:
    """Checks that the demo overwrites nothing, before minutes of work."""
    for path in (root / RECORDING, root / PROJECT, dataset_folder(root, preset)):
        if path.exists():
            raise ConfigError(f"{path}: exists already; choose another folder for the demo")


def generate(root: Path, preset: str, frames: int, seed: int, progress: Progress) -> None:
    write_generated(root / RECORDING, preset, frames, seed, report=counted(progress, "ray-cast the recording"))


def new_project(root: Path, preset: str) -> AbstractContextManager[Project]:
    return create_project(root, PROJECT, (LABELS[preset],), settings=ProjectSettings(rotation=ROTATIONS[preset]))


def add_recording(project: Project, root: Path) -> int:
    """Adds the recording to the project, without its labels; returns its id."""
    return register_recording(project, open_recording(root / RECORDING)).id


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
    """Runs the loop in the folder `root`: `recording`, the project `demo`, and the dataset `3D_*`."""
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
