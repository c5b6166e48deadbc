"""View detectors that need no training, and what a short training needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from annotator.detection import pretrained
from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import DatasetManifest, ManifestEntry
from annotator.detection.trained import TrainedModel, TrainingMetrics
from annotator.project import Project, StoredModel
from annotator.types import Box2D, BoxKind, DetectorKind, Image
from annotator.workflows.detectors import AGNOSTIC
from annotator.workflows.training.held_out import HeldOut
from annotator.workflows.training.samples import SampleConfig, gather
from annotator.workflows.training.train import TrainPlan

WHOLE, SEEN = AGNOSTIC
CONFIG = TrainingConfig(image_size_px=64, epochs=1)
PLAN = TrainPlan(image=CONFIG, view=CONFIG, samples=SampleConfig(views=24))
HELD_OUT = ("000001", "000003")


@dataclass(frozen=True)
class Fixed:
    """A detector with the same boxes on every image."""

    boxes: tuple[Box2D, ...] = ()
    fingerprint: str = "fixed"
    labels: tuple[str, ...] = AGNOSTIC

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        return [list(self.boxes) for _ in images]


def trained_model(weights: Path, **changes: Any) -> TrainedModel:
    """The result of a training of a class-agnostic view detector, with other values where given."""
    metrics = TrainingMetrics(map50=0.5, map50_95=0.25, precision=0.5, recall=0.5, measured_on="val")
    model = TrainedModel(
        role=DetectorKind.VIEW, weights=weights, classes=AGNOSTIC, kind=None, image_size_px=64, metrics=metrics,
        epochs=1, seconds=1.0, pretrained=False, note="from random weights", dataset_sha256="", config=CONFIG,
    )  # fmt: skip
    return model.model_copy(update=changes)


def write_model(folder: Path, size_px: int = 64) -> Path:
    """The files of a finished training."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "detector.safetensors"
    path.write_bytes(b"weights")
    trained_model(path, image_size_px=size_px).write(folder)
    return path


def install_base() -> None:
    write_model(pretrained.FOLDER)


def register(project: Project, name: str, *, active: bool = False, learned: str | None = "000000") -> StoredModel:
    """
    Args:
        learned: key of a frame that it was trained on; None: unknown.
    """
    path = write_model(project.models_folder / "view" / name)
    manifest = path.parent / "manifest.json"
    if learned is not None:
        group = f"{project.recordings.all()[0].id}/{learned}"
        entry = ManifestEntry(image="0.png", split="train", group=group, origin="drawn", boxes=AGNOSTIC[:1])
        written = DatasetManifest(
            sha256="", classes=AGNOSTIC, kind=None, measured_on="train", images={"train": 1, "val": 0},
            entries=(entry,),
        )  # fmt: skip
        manifest.write_text(written.model_dump_json(), encoding="utf-8")
    return project.models.register(
        DetectorKind.VIEW, path, labels=AGNOSTIC, box_kind=BoxKind.BOX, metrics={}, fingerprint=name, activate=active,
        manifest=None if learned is None else manifest,
    )  # fmt: skip


def held(project: Project, objects: int = 6) -> HeldOut:
    """Of the project's labels, with a number of objects as given."""
    measured = HeldOut(project, gather(project).labels)
    if objects < measured.objects:
        measured._frames[:] = []
    return measured
