"""All backends give the same boxes, which are those of the network; expected errors of edges."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from annotator.detection.backends import choose, openvino_network
from annotator.detection.backends.choose import Network, open_network
from annotator.detection.config import Backend, DetectorConfig, EdgeErrors
from annotator.detection.dataset import read_manifest
from annotator.detection.edge_errors import fit_edge_errors, with_edge_errors
from annotator.detection.pretrained import write_seeded_network
from annotator.detection.trained import TrainedModel, read_trained
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import load_weights
from annotator.detection.yolo import YoloDetector, candidates
from annotator.types import PseudoView
from annotator.types.errors import ConfigError, DetectionError
from annotator.workflows.detectors import load_detector

pytestmark = pytest.mark.slow

SHAPES = ((3, 64, 96, 3), (1, 96, 96, 3), (2, 96, 32, 3))


@dataclass(frozen=True)
class PlainImage:
    rgb: np.ndarray


def make(weights: Path, **settings: Any) -> YoloDetector:
    return YoloDetector(weights, DetectorConfig(**{"image_size_px": 96, "device": "cpu", **settings}))


def opened(weights: Path, backend: Backend, **settings: Any) -> Network:
    digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    return open_network(weights, digest, DetectorConfig(image_size_px=96, device="cpu", backend=backend, **settings))


@pytest.fixture(scope="module")
def random_weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("random")
    files = {name: folder / name / "detector.safetensors" for name in ("yolo11n", "yolo26n")}
    for name, path in files.items():
        write_seeded_network(path, name, end2end=name == "yolo26n")
    return files


def batches(seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.integers(0, 256, shape, np.uint8) for shape in SHAPES]


@pytest.mark.parametrize("name", ["yolo11n", "yolo26n"])
def test_raw_predictions_agree_with_torch(random_weights: dict[str, Path], name: str) -> None:
    expected = opened(random_weights[name], "torch")
    references = expected.predict(batches())
    assert references[0][:, 4:7].std() > 0.001  # the scores differ
    assert expected.facts.edge_spread == (name == "yolo11n")
    rows = 11 if expected.facts.edge_spread else 7
    network = opened(random_weights[name], "openvino")
    assert (network.backend, network.facts) == ("openvino", expected.facts)
    assert network.facts.end2end == (name == "yolo26n")
    for answer, reference, shape in zip(network.predict(batches()), references, SHAPES, strict=True):
        anchors = sum(shape[1] * shape[2] // s**2 for s in (8, 16, 32))
        assert answer.shape == reference.shape == (shape[0], rows, anchors)
        np.testing.assert_allclose(answer[:, :4], reference[:, :4], atol=0.1, rtol=1e-3)
        np.testing.assert_allclose(answer[:, 4:7], reference[:, 4:7], atol=2e-3)
        np.testing.assert_allclose(answer[:, 7:], reference[:, 7:], atol=0.1, rtol=1e-3)


def test_openvino_goes_on_after_a_failed_call(random_weights: dict[str, Path]) -> None:
    """Requests that still ran would refuse the next call."""
    network = opened(random_weights["yolo11n"], "openvino")
    images = np.random.default_rng(0).integers(0, 256, (4, 320, 320, 3), np.uint8)
    expected = network.predict([images])
    with pytest.raises(DetectionError, match="OpenVINO cannot run the detector"):
        network.predict([images, np.zeros((1, 96, 96, 3), np.complex128)])
    assert np.array_equal(network.predict([images])[0], expected[0])


def test_the_spread_is_the_standard_deviation_of_the_predicted_distribution(random_weights: dict[str, Path]) -> None:
    torch, batch = api().torch, batches()[0]
    model = load_weights(random_weights["yolo11n"], torch.device("cpu")).fuse(verbose=False).eval()
    with torch.inference_mode():
        logits = model(torch.from_numpy(batch).permute(0, 3, 1, 2) / 255)[1]["boxes"].numpy()
    shares = np.exp(logits.reshape(len(batch), 4, 16, -1).astype(np.float64))
    shares /= shares.sum(axis=2, keepdims=True)
    distances = np.arange(16.0)[:, None]
    mean = (shares * distances).sum(axis=2)
    deviation = np.sqrt((shares * distances**2).sum(axis=2) - mean**2)
    rows, columns = batch.shape[1:3]
    strides = np.repeat([8, 16, 32], [rows * columns // stride**2 for stride in (8, 16, 32)])
    answer = opened(random_weights["yolo11n"], "torch").predict([batch])[0]
    np.testing.assert_allclose(answer[:, 7:], deviation * strides, rtol=1e-3)
    assert answer[:, 7:].std() > 0.1


def test_boxes_tell_the_expected_errors_of_their_edges_in_pixels_of_the_image(random_weights: dict[str, Path]) -> None:
    small = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    picture = PlainImage(np.repeat(np.repeat(small, 2, axis=0), 2, axis=1))  # the network sees it at half its size
    errors = {"0": EdgeErrors(factor=0.25, exponent=1.0, least_px=1e-6, most_px=1e3)}
    settings: dict[str, Any] = {"backend": "torch", "confidence": 1e-3}
    detector = make(random_weights["yolo11n"], edge_errors=errors, **settings)
    plain = make(random_weights["yolo11n"], **settings)
    assert plain.fingerprint != detector.fingerprint
    boxes = detector.detect([picture])[0]
    told = [box for box in boxes if box.edge_sigma_px is not None]
    assert {box.label for box in told} == {"0"} < {box.label for box in boxes}
    raw = opened(random_weights["yolo11n"], "torch").predict([small[None]])[0]
    found = candidates(raw, False, 1e-3, edge_spread=True)
    assert found.spreads is not None
    for box in told:
        nearest = np.abs(2 * 0.25 * found.spreads - np.array(box.edge_sigma_px)).max(axis=1)
        index = int(np.argmin(nearest))
        assert nearest[index] < 2e-3 and found.numbers[index] == 0
        np.testing.assert_allclose(np.clip(2 * found.boxes[index], 0, 192) - 0.5, box.xyxy, atol=1e-3)
    # stored with three decimals, but never as 0, which would weigh infinitely much
    tiny = {"0": EdgeErrors(factor=1e-9, exponent=1.0, least_px=1e-6, most_px=1e3)}
    least = [
        box.edge_sigma_px for box in make(random_weights["yolo11n"], edge_errors=tiny, **settings).detect([picture])[0]
    ]
    assert {errors for errors in least if errors is not None} == {(0.001, 0.001, 0.001, 0.001)}
    # neither without such errors nor from a network without spreads
    for silent in (plain, make(random_weights["yolo26n"], edge_errors=errors, **settings)):
        boxes = silent.detect([picture])[0]
        assert boxes and all(box.edge_sigma_px is None for box in boxes)


def test_end_to_end_predictions_are_ranked_as_in_ultralytics(random_weights: dict[str, Path]) -> None:
    torch, batch = api().torch, batches()[0]
    theirs = load_weights(random_weights["yolo26n"], torch.device("cpu")).fuse(verbose=False).eval()
    with torch.inference_mode():
        references = theirs(torch.from_numpy(batch).permute(0, 3, 1, 2) / 255)[0].numpy()
    answer = opened(random_weights["yolo26n"], "torch").predict([batch])[0]
    selected = candidates(answer, True, 0.0)
    for picture, rows in enumerate(references):
        ours = np.flatnonzero(selected.picture == picture)
        ours = ours[np.argsort(-selected.scores[ours], kind="stable")][:20]
        np.testing.assert_allclose(selected.scores[ours], rows[:20, 4], atol=1e-5)
        np.testing.assert_allclose(selected.boxes[ours], rows[:20, :4], atol=1e-2)
        np.testing.assert_array_equal(selected.numbers[ours], rows[:20, 5])


def test_output_does_not_depend_on_the_batch(random_weights: dict[str, Path]) -> None:
    """Bitwise equal in a batch and alone, with one thread and with two."""
    network, alone = (opened(random_weights["yolo11n"], "openvino", threads=threads) for threads in (2, 1))
    together = network.predict(batches())
    for batch, answer in zip(batches(), together, strict=True):
        np.testing.assert_array_equal(network.predict([batch[:1]])[0], answer[:1])
        np.testing.assert_array_equal(alone.predict([batch])[0], answer)


def test_boxes_have_the_present_names_of_their_classes(own_weights: Path, scene: Any) -> None:
    images = [PlainImage(scene(seed).rgb) for seed in range(6)]
    before = [box for boxes in make(own_weights).detect(images) for box in boxes]
    assert {box.label for box in before} == {"blue", "red"}
    renamed = make(own_weights, names={"blue": "azure", "red": None})
    assert renamed.labels == ("azure",)
    after = [box for boxes in renamed.detect(images) for box in boxes]
    assert after == [replace(box, label="azure") for box in before if box.label == "blue"]
    assert renamed.fingerprint == make(own_weights).fingerprint


@pytest.mark.parametrize("supported", [True, False])
def test_fastest_uses_bfloat16_if_the_processor_supports_it(
    tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch, supported: bool
) -> None:
    monkeypatch.setattr(choose, "has_cuda", lambda: False)
    monkeypatch.setattr(openvino_network, "computes_bfloat16", lambda: supported)
    assert opened(tiny_model.weights, "fastest").backend == ("openvino-bf16" if supported else "openvino")
    assert opened(tiny_model.weights, "auto").backend == "openvino"
    if not supported:
        with pytest.raises(ConfigError, match="no instructions for bfloat16; use the backend openvino"):
            opened(tiny_model.weights, "openvino-bf16")


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


def errors_of(spread: np.ndarray, factor: float, exponent: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).laplace(0, factor * spread**exponent)


@pytest.mark.parametrize(("factor", "exponent"), [(0.3, 1.0), (0.1, 2.0), (1.5, 0.5)])
def test_the_fit_finds_the_law_behind_the_errors_despite_gross_ones(factor: float, exponent: float) -> None:
    spread = np.exp(np.random.default_rng(1).uniform(0, 2, 4000))
    errors = errors_of(spread, factor, exponent)
    errors[:20] = 300.0  # other objects
    fit = fit_edge_errors(spread, errors)
    assert isinstance(fit, EdgeErrors)
    for value in (1.5, 3.0, 6.0):
        assert fit.of(np.array([value])) == pytest.approx(factor * value**exponent, rel=0.2)
    assert (fit.edges, fit.gain > 0.02) == (4000, True)


def test_a_spread_that_tells_nothing_is_refused() -> None:
    rng = np.random.default_rng(0)
    spread, errors = rng.uniform(1, 4, 3000), rng.laplace(0, 1.0, 3000)
    assert isinstance(fit_edge_errors(spread, errors), str)
    # larger errors where the network claims to be certain
    assert isinstance(fit_edge_errors(spread, errors / spread), str)
    few = fit_edge_errors(spread[:50], errors[:50] * spread[:50])
    assert isinstance(few, str) and "50 edges" in few


@pytest.mark.slow
def test_a_training_stores_the_errors_and_the_detector_tells_them(
    tiny_model: TrainedModel, tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fit(spread_px: np.ndarray, error_px: np.ndarray) -> EdgeErrors:
        assert (spread_px > 0).all() and np.median(np.abs(error_px)) < 20
        return EdgeErrors(factor=1.0, exponent=1.0, least_px=0.01, most_px=90.0, edges=len(spread_px))

    # the set is too small for a fit of its own
    monkeypatch.setattr("annotator.detection.edge_errors.fit_edge_errors", fit)
    weights = tmp_path / "detector.safetensors"
    weights.write_bytes(tiny_model.weights.read_bytes())
    plain = tiny_model.model_copy(update={"weights": weights, "edge_errors": {}})
    plain.write(tmp_path)
    manifest = read_manifest(tiny_dataset)
    found = with_edge_errors(read_trained(tmp_path), tiny_dataset, manifest, "cpu")
    images = [entry for entry in manifest.entries if entry.split == "val"]
    assert set(found.edge_errors) == set(manifest.classes)
    for name, errors in found.edge_errors.items():
        assert 1 <= errors.edges <= 4 * sum(entry.boxes.count(name) for entry in images)
    picture = PlainImage(np.full((96, 96, 3), 40, np.uint8))
    assert all(box.edge_sigma_px is None for box in load_detector(weights, "torch").detect([picture])[0])
    found.write(tmp_path)
    assert read_trained(tmp_path).edge_errors == found.edge_errors
    bgr = cv2.imread(str(tiny_dataset / images[0].image))
    boxes = load_detector(weights, "torch").detect([PlainImage(np.ascontiguousarray(bgr[..., ::-1]))])[0]
    assert boxes and all(min(box.edge_sigma_px or (0.0,)) > 0 for box in boxes)
