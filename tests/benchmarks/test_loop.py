"""The loop benchmark with perfect detectors instead of trainings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.project import Project
from annotator.recordings import open_recording
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ConfigError
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.training.samples import gather
from benchmarks import loop
from benchmarks.loop import Arguments, run


class TrainingStandIn:
    """A stand-in for the training that registers models; its detectors are perfect on the original recording."""

    def __init__(self, folder: Path, label: str) -> None:
        self.recording, self.label = open_recording(folder), label

    def train(self, project: Project, plan: Any, progress: Any) -> list[Any]:
        weights = project.models_folder / "weights.pt"
        weights.write_bytes(b"")
        kind, classes = gather(project).kind, project.config.classes
        for role in DetectorKind:
            project.models.register(role, weights, labels=classes, box_kind=kind, metrics={}, fingerprint=role)
        return []

    def detectors(self, project: Project, backend: str = "auto") -> Detectors:
        model = project.models.active(DetectorKind.VIEW)
        assert model is not None
        scenes = []
        for index in range(1, len(self.recording), 2):
            frame = self.recording.frame(index)
            truths = load_truth(self.recording, index, frame)
            scenes.append(Scene.of(frame, [replace(truth, label=self.label) for truth in truths]))
        perfect = PerfectDetector(scenes, model.box_kind, min_points=50)
        return Detectors(perfect, perfect, model.box_kind)


def test_without_true_boxes_only_mask_scores_are_computed(
    generated: Path, own_copy: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Labelled by silhouettes and scored by the masks; scores that need true boxes are NaN."""
    folder = own_copy("people")
    (folder / "truth" / "boxes.json").unlink()
    stand_in = TrainingStandIn(generated / "people", "thing")
    monkeypatch.setattr(loop, "train", stand_in.train)
    monkeypatch.setattr(loop, "active_detectors", stand_in.detectors)
    result = run(Arguments(folder, label="thing"))
    assert (result["frames"], result["operator"]) == (2, "silhouette")
    assert all(math.isnan(float(str(result[key]))) for key in ("mean_iou", "ap25", "ap50"))
    assert float(str(result["mask_recall"])) > 0.8
    assert float(str(result["mask_precision"])) > 0.5  # a box also contains some floor
    with pytest.raises(ConfigError, match="needs true boxes"):
        run(Arguments(folder, operator=BoxKind.BOX))
