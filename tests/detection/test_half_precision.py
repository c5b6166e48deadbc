"""OpenVINO in bfloat16: how far its answers are off, what it computes in single precision, where it is chosen."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from annotator.detection.backends import choose, openvino_api
from annotator.detection.backends import export as export_module
from annotator.detection.backends.choose import open_network
from annotator.detection.backends.export import export
from annotator.detection.backends.half_precision import marked
from annotator.detection.backends.network import Network
from annotator.detection.backends.openvino_network import OpenVinoNetwork
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.trained import TrainedModel
from annotator.detection.yolo import YoloDetector
from annotator.types.errors import ConfigError
from tests.detection.test_backends import untrained

pytestmark = pytest.mark.slow

SIZE_PX = 96
SURE = 0.25


@pytest.fixture
def bfloat16() -> None:
    """Only where the processor computes in it."""
    pytest.importorskip("openvino")
    if not openvino_api.computes_bfloat16():
        pytest.skip("a processor without bfloat16")


def config(backend: Backend, **settings: Any) -> DetectorConfig:
    return DetectorConfig(**{"image_size_px": SIZE_PX, "device": "cpu", "backend": backend, **settings})


def opened(weights: Path, backend: Backend, threads: int | None = None) -> Network:
    return open_network(weights, "digest", config(backend, threads=threads))


@pytest.mark.usefixtures("bfloat16")
def test_a_trained_detectors_boxes_are_nearly_those_of_torch(
    tiny_model: TrainedModel, scene: Callable[..., Any]
) -> None:
    pictures = [scene(seed) for seed in range(100, 140)]
    exact, half, torch = (
        YoloDetector(tiny_model.weights, config(backend, iou=1.0)).detect(pictures)  # nothing is suppressed
        for backend in ("openvino", "openvino-bf16", "torch")
    )
    assert half != exact  # it is really computed in another way
    off_px, off_score = [], []
    for boxes, wanted in zip(half, torch, strict=True):
        for box in (box for box in wanted if box.score > SURE):
            alike = [other for other in boxes if other.label == box.label]
            edges = [float(np.abs(np.subtract(other.xyxy, box.xyxy)).max()) for other in alike]
            nearest = int(np.argmin(edges))
            off_px.append(edges[nearest])
            off_score.append(abs(alike[nearest].score - box.score))
    assert len(off_px) >= len(pictures)
    assert max(off_px) < 1
    assert max(off_score) < 0.01
    assert np.mean(off_score) < 0.003


@pytest.mark.parametrize("name", ["yolo11n", "yolo26n", "yolov10n", "yolov8n", "yolov5n"])
def test_only_the_detecting_layers_convolutions_are_marked(tmp_path: Path, name: str) -> None:
    _, parts = export(untrained(tmp_path / name / "detector.pt", name), "openvino")
    layers = list(ElementTree.fromstring(parts["network.xml"]).iterfind("layers/layer"))
    precise = {
        layer for layer in layers if any(m.get("name") == "precise" for m in layer.iterfind("rt_info/attribute"))
    }
    convolutions = [layer for layer in layers if "Convolution" in str(layer.get("type"))]
    head = max(
        int(number) for layer in layers for number in re.findall(r"model\.model\.(\d+)\.", str(layer.get("name")))
    )
    for layer in layers:
        place = str(layer.get("name"))
        is_edge = re.search(r"cv2\.\d\.[01]\.", place)
        wanted = layer in convolutions and f"model.model.{head}." in place and not is_edge
        assert (layer in precise) == wanted, place
    # of each of three scales: the last one of the edges, and at least three of the classes
    assert 12 <= len(precise) < len(convolutions) - 30


def test_a_detecting_layer_that_is_not_found_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    _, parts = export(untrained(tmp_path / "yolo11n" / "detector.pt", "yolo11n"), "openvino")
    assert not caplog.records
    assert marked(parts["network.xml"], 99) == parts["network.xml"]
    assert "the detecting layer is not found" in caplog.text


@pytest.mark.usefixtures("bfloat16")
@pytest.mark.parametrize("name", ["yolo11n", "yolo26n"])
def test_what_edges_and_scores_come_from_is_computed_in_single_precision(tmp_path: Path, name: str) -> None:
    network = opened(untrained(tmp_path / name / "detector.pt", name), "openvino-bf16")
    assert isinstance(network, OpenVinoNetwork)
    network.predict([np.zeros((1, SIZE_PX, SIZE_PX, 3), np.uint8)])
    ((request, *_),) = network._compiled.values()
    precisions: dict[str, str] = {}
    for layer in request.request.get_compiled_model().get_runtime_model().get_ops():
        facts = layer.get_rt_info()
        if facts["layerType"].astype(str) == "Convolution":
            for own in facts["originalLayersNames"].astype(str).split(","):
                precisions[own] = facts["runtimePrecision"].astype(str)
    last = {k: v for k, v in precisions.items() if "cv2.0.2" in k or ("cv3.0" in k and "/aten::_convolution" in k)}
    assert last
    assert set(last.values()) == {"f32"}
    assert {v for k, v in precisions.items() if "model.model.0.conv" in k or "cv2.0.0" in k} == {"bf16"}


@pytest.mark.usefixtures("bfloat16")
def test_a_pictures_answer_is_its_own(tiny_model: TrainedModel) -> None:
    many = np.random.default_rng(0).integers(0, 256, (19, 64, 64, 3), np.uint8)
    two, one = (opened(tiny_model.weights, "openvino-bf16", threads) for threads in (2, 1))
    together = two.predict([many])[0]
    np.testing.assert_array_equal(one.predict([many])[0], together)
    np.testing.assert_array_equal(two.predict([many[4:5]])[0], together[4:5])


@pytest.mark.parametrize("has_it", [True, False])
def test_fastest_takes_it_where_the_processor_has_it(
    tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch, has_it: bool
) -> None:
    monkeypatch.setattr(choose.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(choose, "has_cuda", lambda: False)
    monkeypatch.setattr(openvino_api, "computes_bfloat16", lambda: has_it)
    assert opened(tiny_model.weights, "fastest").backend == ("openvino-bf16" if has_it else "openvino")
    assert opened(tiny_model.weights, "auto").backend == "openvino"
    if not has_it:
        with pytest.raises(ConfigError, match="no instructions for bfloat16; use the backend openvino"):
            opened(tiny_model.weights, "openvino-bf16")


def test_fastest_passes_over_what_cannot_run_the_network(
    own_weights: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tried = []

    def fail(*_: object) -> None:
        tried.append(1)
        raise ValueError("an operation that nobody knows")

    monkeypatch.setattr(choose.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(export_module, "_WRITERS", dict.fromkeys(("openvino", "onnxruntime"), fail))
    assert opened(own_weights, "fastest").backend == "torch"
    assert len(tried) == 2
    assert "an operation that nobody knows" in caplog.text


def test_fastest_passes_over_an_openvino_that_cannot_use_the_processor(
    tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Broken:
        def get_property(self, *_: object) -> None:
            raise RuntimeError("Device with CPU name is not registered")

    monkeypatch.setattr(choose.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(openvino_api, "openvino", lambda: SimpleNamespace(Core=Broken))
    assert opened(tiny_model.weights, "fastest").backend == "onnxruntime"
    assert "OpenVINO cannot use the processor (Device with CPU name is not registered)" in caplog.text


def test_fastest_without_openvino_is_the_next_one(tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choose, "find_spec", lambda name: None if name == "openvino" else name)
    assert opened(tiny_model.weights, "fastest").backend == "onnxruntime"
    monkeypatch.setattr(choose, "has_cuda", lambda: True)
    assert choose._choices(DetectorConfig(image_size_px=SIZE_PX, backend="fastest")) == ("torch",)
