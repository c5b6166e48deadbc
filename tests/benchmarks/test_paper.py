"""The paper's protocol on a data set in KITTI's layout, with a perfect detector."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.detection.trained import TrainingMetrics
from annotator.project import Project, open_project
from annotator.recordings import open_recording
from annotator.types import BoxKind, DetectorKind
from annotator.workflows.detectors import Detectors
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.training.samples import gather
from benchmarks import paper, paper_protocol

WIDTH, HEIGHT, FOCAL = 620, 188, 360.0
MIDDLE = np.array([WIDTH, HEIGHT]) / 2
STAGES = ["import", "boxes", "train-image", "train-view", "propose", "evaluate"]
# Height, width, length, metres.
SIZES = {"Pedestrian": (1.8, 0.6, 0.8), "Cyclist": (1.7, 0.6, 1.8), "Car": (1.5, 1.6, 4.0)}


def write_frame(root: Path, key: str, rng: np.random.Generator) -> None:
    """Upright boxes side by side on the ground, with points on all faces, along the camera's axes."""
    rows, points = [], []
    x = -6.0
    for label in SIZES:
        height, width, length = SIZES[label]
        rotation_y = rng.choice([0.0, np.pi / 2])
        across, along = (length, width) if rotation_y == 0 else (width, length)
        x += across / 2
        size, center = np.array([across, height, along]), np.array([x, 1.6 - height / 2, 13 + rng.uniform(0, 1)])
        x += across / 2 + 0.8
        face = rng.uniform(-0.5, 0.5, (300, 3))
        face[np.arange(300), rng.integers(3, size=300)] = rng.choice([-0.5, 0.5], 300)
        # the corners, so that each side has its full length
        corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
        points.append(np.concatenate([face, corners]) * size * 0.999 + center)
        px = FOCAL * (corners * size + center)[:, :2] / (corners * size + center)[:, 2:]
        left, top = px.min(axis=0) + MIDDLE
        right, bottom = px.max(axis=0) + MIDDLE
        place = f"{left:.2f} {top:.2f} {right:.2f} {bottom:.2f} {height} {width} {length}"
        rows.append(f"{label} 0.00 0 0.00 {place} {center[0]:.4f} 1.6 {center[2]:.4f} {rotation_y:.6f}")
    xyz = np.concatenate(points)
    scan = np.c_[xyz[:, 2], -xyz[:, 0], -xyz[:, 1], np.ones(len(xyz))].astype("<f4")
    P2 = np.array([[FOCAL, 0, WIDTH / 2, 0], [0, FOCAL, HEIGHT / 2, 0], [0, 0, 1, 0]])
    Tr = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
    matrices = {"P2": P2, "R0_rect": np.eye(3), "Tr_velo_to_cam": Tr}
    calib = "".join(f"{name}: {' '.join(f'{v:.9e}' for v in m.ravel())}\n" for name, m in matrices.items())
    image = rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    (root / "image_2" / f"{key}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    (root / "velodyne" / f"{key}.bin").write_bytes(scan.tobytes())
    (root / "calib" / f"{key}.txt").write_text(calib)
    (root / "label_2" / f"{key}.txt").write_text("\n".join(rows) + "\n")


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames: 0 to 3 for training, 4 and 5 for testing, 6 and 7 in neither list."""
    root = tmp_path_factory.mktemp("kitti")
    for folder in ("image_2", "velodyne", "calib", "label_2"):
        (root / "training" / folder).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for number in range(8):
        write_frame(root / "training", f"{number:06d}", rng)
    (root / "ImageSets").mkdir()
    for side, numbers in (("train", range(4)), ("val", range(4, 6))):
        (root / "ImageSets" / f"{side}.txt").write_text("".join(f"{number:06d}\n" for number in numbers))
    return root


@dataclass
class TrainingStandIn:
    """A stand-in for the training, and a perfect detector for the test frames."""

    trainings: int = 0

    def train(self, project: Project, plan: object, *, roles: tuple[DetectorKind, ...], progress: object) -> list[Any]:
        self.trainings += 1
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


def test_the_kitti_protocol_and_a_repeated_run(
    kitti: Path,
    stand_in: TrainingStandIn,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(*words: str) -> tuple[dict[str, Any], list[str]]:
        arguments = ["kitti", "--root", kitti, "--work", tmp_path / "work", "--axes", "camera", *words, "--json"]
        monkeypatch.setattr(sys, "argv", ["paper", *map(str, arguments)])
        paper.main()
        lines = capsys.readouterr().out.splitlines()
        return json.loads(lines[-1]), lines[:-1]

    first, lines = run("--fraction", "0.5")
    assert first["skipped"] == []
    assert list(first["seconds"]) == STAGES
    assert first["stages"]["import"] == {
        "train": 4,
        "val": 2,
        "divided": str(kitti / "ImageSets" / "train.txt"),
        "lists": "6 of 6 listed frames are present",
    }
    boxes = first["stages"]["boxes"]
    assert (boxes["frames"], boxes["objects"]) == (2, {"Pedestrian": 2, "Cyclist": 2, "Car": 2})
    assert (boxes["views"], first["stages"]["train-view"]["pictures"]["train"]) == (24, 24)
    assert first["stages"]["train-image"]["pictures"]["train"] == 2
    assert (first["stages"]["propose"]["frames"], first["stages"]["propose"]["proposals"]) == (2, 6)
    assert set(first["ours"]) == {"Car", "Pedestrian", "Cyclist"}
    for metrics in first["ours"].values():
        assert all(metrics[metric]["R11"][0] > 0 for metric in ("bbox", "bev", "3d"))
    assert "paper, 50%, test set" in "\n".join(lines)
    with open_project(Path(first["project"])) as project:
        train_id = project.recordings.find("train").id
        assert not [x for x in project.labels.select() if project.frames.get(x.frame_id).recording_id == train_id]

    again, _ = run("--fraction", "0.5")
    assert again["skipped"] == STAGES
    assert again == {**first, "skipped": STAGES}
    assert stand_in.trainings == 2
    other, _ = run("--fraction", "0.5", "--axes", "eigenvectors")
    assert other["skipped"] == STAGES[:4]
    little, _ = run("--fraction", "0.5", "--limit", "1")
    assert little["stages"]["import"]["train"] == little["stages"]["import"]["val"] == 1
    assert stand_in.trainings == 4
