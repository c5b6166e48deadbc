"""All backends give the same boxes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.detection.backends import choose, openvino_network
from annotator.detection.backends.choose import Network, open_network
from annotator.detection.config import Backend, DetectorConfig, EdgeErrors
from annotator.detection.pretrained import write_seeded_network
from annotator.detection.trained import TrainedModel
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import load_weights
from annotator.detection.yolo import YoloDetector, candidates
from annotator.types.errors import ConfigError, DetectionError

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
