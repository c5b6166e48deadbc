"""Detection with a trained model; `tiny_model` is trained once for all these tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.detection.trained import TrainedModel
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import load_weights
from annotator.detection.yolo import YoloDetector
from annotator.types import PseudoView
from annotator.types.errors import DetectionError
from tests.detection.test_backends import PlainImage, make

pytestmark = pytest.mark.slow

# A confidence so low that every image has boxes, whatever the network has learned.
ANY = 0.001
BEST = 5


@pytest.fixture(scope="module")
def detector(tiny_model: TrainedModel) -> YoloDetector:
    return make(tiny_model.weights)


def test_the_trained_objects_are_found_and_classified(detector: YoloDetector, scene: Callable[..., Any]) -> None:
    """Red and blue are distinguished only if the colour channels have the same order as in training.

    Other processors give other weights, so the bounds are loose, but far from chance.
    """
    scenes = [scene(seed) for seed in range(100, 116)]
    detected = detector.detect(scenes)
    right = [boxes[0].label == s.boxes[0].label for s, boxes in zip(scenes, detected, strict=True) if boxes]
    assert len(right) >= 8
    assert sum(right) >= 0.8 * len(right)
    errors = [np.subtract(boxes[0].xyxy, s.boxes[0].xyxy) for s, boxes in zip(scenes, detected, strict=True) if boxes]
    assert np.median(np.abs(errors)) < 10


def test_a_view_is_scaled_to_its_own_size(detector: YoloDetector, scene: Callable[..., Any]) -> None:
    rgb = scene(3, (192, 160)).rgb
    view = PseudoView(rgb, np.eye(3), 0.01, np.zeros(2), np.zeros((1, 3), np.float32), look_px=192)
    small, large = (make(detector.weights, confidence=0.001, image_size_px=size) for size in (96, 192))
    (asked,), (plain,), (expected,) = (
        small.detect([view]),
        small.detect([PlainImage(rgb)]),
        large.detect([PlainImage(rgb)]),
    )
    assert asked == expected != plain


def test_detections_agree_with_ultralytics_own_predictor(
    tiny_model: TrainedModel, scene: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    api()
    from ultralytics import YOLO

    api().torch.save({"model": load_weights(tiny_model.weights, "cpu")}, tmp_path / "theirs.pt")
    theirs = YOLO(str(tmp_path / "theirs.pt"))
    ours = make(tiny_model.weights, confidence=ANY, iou=1.0, backend="torch")
    for seed, size in enumerate([(96, 96), (70, 96), (96, 50), (240, 180), (96, 96), (120, 130)]):
        one = scene(seed + 50, size)
        # Ours pads small images to square canvases, theirs to the narrowest ones; so its input is padded here.
        border = (96 - size[1]) // 2 if size[0] == 96 else 0
        padded = np.pad(one.rgb, ((0, 0), (border, border), (0, 0)), constant_values=114)
        result = theirs.predict(
            padded[:, :, ::-1], imgsz=96, conf=ANY, iou=1.0, device="cpu", verbose=False, save=False
        )[0].boxes
        best = ours.detect([one])[0][:BEST]
        assert len(best) == BEST
        # theirs are clipped to the padded image, ours to the image
        low, high = np.full(4, -0.5), np.array([*size[::-1], *size[::-1]]) - 0.5
        detected = np.clip(result.xyxy.numpy() - 0.5 - np.array([border, 0, border, 0]), low, high)
        # compares the best boxes in pairs; the order of boxes with equal scores is not defined
        for box in best:
            alike = (np.abs(detected - box.xyxy) <= 1.0).all(axis=1) & (np.abs(result.conf.numpy() - box.score) <= 0.01)
            assert (alike & (result.cls.numpy() == ours.labels.index(box.label))).any()
    assert list(tmp_path.iterdir()) == [tmp_path / "theirs.pt"]


@pytest.mark.parametrize(
    "rgb", [np.zeros((5, 5), np.uint8), np.zeros((5, 5, 3), np.float32), np.zeros((0, 5, 3), np.uint8)]
)
def test_an_invalid_image_is_an_error(detector: YoloDetector, rgb: np.ndarray) -> None:
    with pytest.raises(DetectionError, match="uint8"):
        detector.detect([PlainImage(rgb)])


def test_the_fingerprint_depends_on_weights_and_settings(
    detector: YoloDetector, tiny_model: TrainedModel, tmp_path: Path
) -> None:
    def fingerprint(weights: Path = tiny_model.weights, size: int = 96, **settings: Any) -> str:
        return make(weights, **{"image_size_px": size, "backend": "torch", **settings}).fingerprint

    assert fingerprint() == detector.fingerprint
    moved = tmp_path / "moved.pt"
    moved.write_bytes(tiny_model.weights.read_bytes())
    assert fingerprint(moved) == detector.fingerprint
    assert (
        fingerprint(backend="openvino", threads=1) == detector.fingerprint
    )  # a batch may be continued on another backend
    assert len({fingerprint(), fingerprint(size=128), fingerprint(confidence=0.2), fingerprint(iou=0.5)}) == 4
