"""The paper's protocol on a real frame, with a perfect detector."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.detection.trained import TrainingMetrics
from annotator.project import Project
from annotator.recordings import open_recording
from annotator.types import BoxKind, DetectorKind
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.training.samples import gather
from benchmarks import paper, paper_protocol


class TrainingStandIn:
    """A stand-in for the training, and a perfect detector for the test frames."""

    def train(self, project: Project, plan: object, *, roles: tuple[DetectorKind, ...], progress: object) -> list[Any]:
        material = gather(project, roles)
        assert material.kind is BoxKind.BOX and not material.labels, "trained on other labels than 2D boxes"
        weights = project.models_folder / f"perfect-{roles[0]}.pt"
        weights.write_bytes(b"perfect")
        model = project.models.register(
            roles[0], weights, labels=project.config.classes, box_kind=BoxKind.BOX, metrics={}, fingerprint="perfect"
        )
        pictures = len(material.images) if roles[0] is DetectorKind.IMAGE else len(material.views)
        metrics = TrainingMetrics(map50=1.0, map50_95=1.0, precision=1.0, recall=1.0, measured_on="train")
        result = SimpleNamespace(epochs=1, seconds=0.5, metrics=metrics, note="perfect")
        manifest = SimpleNamespace(images={"train": pictures, "val": 0})
        return [SimpleNamespace(model=model, manifest=manifest, result=result, left_out=())]

    def detectors(self, project: Project) -> Detectors:
        assert {model.role for model in project.models.all()} == set(DetectorKind)
        recording = open_recording(project.recordings.find("val").path)
        frames = [recording.frame(index) for index in range(len(recording))]
        scenes = [
            Scene.of(frame, [t for t in load_truth(recording, index, frame) if t.label in project.config.classes])
            for index, frame in enumerate(frames)
        ]
        perfect = PerfectDetector(scenes)
        return Detectors(perfect, perfect)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> TrainingStandIn:
    training = TrainingStandIn()
    monkeypatch.setattr(paper_protocol, "train", training.train)
    monkeypatch.setattr(paper_protocol, "active_detectors", training.detectors)
    return training


@pytest.mark.shared
def test_sun_rgbd_on_a_real_frame(shared: Path, stand_in: TrainingStandIn, tmp_path: Path) -> None:
    root = shared / "data" / "sunrgbd" / "sunrgbd_trainval"
    args = paper.Arguments(paper.Dataset.SUNRGBD, root, tmp_path)
    result: Any = paper.run(args)
    assert result["stages"]["import"] == {
        "train": 1,
        "val": 1,
        "divided": "a single frame, for training and testing",
        "lists": "",
    }
    assert result["stages"]["boxes"]["image_boxes"] == {"bed": 1, "night_stand": 1, "dresser": 1, "lamp": 1}
    assert result["axes"] == "consensus"
    assert set(result["ours"]) == {"0.15", "0.25", "0.5"}
    for found in result["ours"].values():
        present = {label: ap for label, ap in found["AP"].items() if ap is not None}
        assert set(present) == {"bed", "night_stand", "dresser", "lamp"}
        assert found["mAP"] == pytest.approx(sum(present.values()) / 4)
    assert result["ours"]["0.25"]["mAP"] == 100.0
    assert result["paper"]["mAP"] == 44.95
