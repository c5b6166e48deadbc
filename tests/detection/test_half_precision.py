"""OpenVINO in bfloat16: accuracy, the layers in single precision, and when it is chosen."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from annotator.detection.backends import choose, openvino_network
from annotator.detection.backends import export as export_module
from annotator.detection.backends.export import export
from annotator.detection.backends.openvino_network import OpenVinoNetwork
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.trained import TrainedModel
from annotator.types.errors import ConfigError


SIZE_PX = 96


@pytest.fixture
def bfloat16() -> None:
    """Skips the test on processors without bfloat16."""
    pytest.importorskip("openvino")
    if not openvino_network.computes_bfloat16():
        pytest.skip("a processor without bfloat16")


def config(backend: Backend, **settings: Any) -> DetectorConfig:
    return DetectorConfig(**{"image_size_px": SIZE_PX, "device": "cpu", "backend": backend, **settings})


@pytest.mark.usefixtures("bfloat16")
@pytest.mark.parametrize("name", ["yolo11n", "yolo26n"])
def test_output_agrees_with_torch_up_to_rounding(tmp_path: Path, name: str) -> None:
    """The rounding error depends on weights and processor; it must be far below that of swapped colour channels.

    Torch, which rounds all layers including the last, has an eighth of that error.
    """
    weights, pictures = untrained(tmp_path / name / "detector.pt", name), batches()[2]
    torch, exact, half = (opened(weights, backend) for backend in ("torch", "openvino", "openvino-bf16"))
    (expected,), (swapped,) = torch.predict([pictures]), torch.predict([np.ascontiguousarray(pictures[..., ::-1])])
    (whole,), (rounded,) = exact.predict([pictures]), half.predict([pictures])
    assert not np.array_equal(rounded, whole)  # bfloat16 was really used
    for rows in (slice(0, 4), slice(4, None)):
        off, far = (np.abs(each - expected)[:, rows].mean() for each in (rounded, swapped))
        assert off < far / 2


@pytest.mark.parametrize("name", ["yolo11n", "yolo26n", "yolov10n", "yolov8n", "yolov5n"])
def test_only_convolutions_of_the_detection_head_are_marked(tmp_path: Path, name: str) -> None:
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
        expected = layer in convolutions and f"model.model.{head}." in place and not is_edge
        assert (layer in precise) == expected, place
    # at each of three scales: the last convolution of the edges, and at least three of the classes
    assert 12 <= len(precise) < len(convolutions) - 30


@pytest.mark.usefixtures("bfloat16")
@pytest.mark.parametrize("name", ["yolo11n", "yolo26n"])
def test_the_last_convolutions_are_computed_in_single_precision(tmp_path: Path, name: str) -> None:
    network = opened(untrained(tmp_path / name / "detector.pt", name), "openvino-bf16")
    assert isinstance(network, OpenVinoNetwork)
    network.predict([np.zeros((1, SIZE_PX, SIZE_PX, 3), np.uint8)])
    ((request, *_),) = network._compiled.values()
    precisions: dict[str, str] = {}
    for layer in request.request.get_compiled_model().get_runtime_model().get_ops():
        facts = layer.get_rt_info()
        if facts["layerType"].astype(str) == "Convolution":
            for original in facts["originalLayersNames"].astype(str).split(","):
                precisions[original] = facts["runtimePrecision"].astype(str)
    last = {k: v for k, v in precisions.items() if "cv2.0.2" in k or ("cv3.0" in k and "/aten::_convolution" in k)}
    assert last
    assert set(last.values()) == {"f32"}
    # which other layers use bfloat16 depends on the processor
    assert "bf16" in precisions.values()


@pytest.mark.usefixtures("bfloat16")
def test_output_in_bfloat16_does_not_depend_on_the_batch(tiny_model: TrainedModel) -> None:
    many = np.random.default_rng(0).integers(0, 256, (19, 64, 64, 3), np.uint8)
    two, one = (opened(tiny_model.weights, "openvino-bf16", threads=threads) for threads in (2, 1))
    together = two.predict([many])[0]
    np.testing.assert_array_equal(one.predict([many])[0], together)
    np.testing.assert_array_equal(two.predict([many[4:5]])[0], together[4:5])


@pytest.mark.parametrize("supported", [True, False])
def test_fastest_uses_bfloat16_if_the_processor_supports_it(
    tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch, supported: bool
) -> None:
    monkeypatch.setattr(choose.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(choose, "has_cuda", lambda: False)
    monkeypatch.setattr(openvino_network, "computes_bfloat16", lambda: supported)
    assert opened(tiny_model.weights, "fastest").backend == ("openvino-bf16" if supported else "openvino")
    assert opened(tiny_model.weights, "auto").backend == "openvino"
    if not supported:
        with pytest.raises(ConfigError, match="no instructions for bfloat16; use the backend openvino"):
            opened(tiny_model.weights, "openvino-bf16")


def test_fastest_skips_backends_that_cannot_run_the_network(
    own_weights: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tried = []

    def fail(*_: object) -> None:
        tried.append(1)
        raise ValueError("unknown operation")

    monkeypatch.setattr(choose.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(export_module, "_WRITERS", dict.fromkeys(("openvino", "onnxruntime"), fail))
    assert opened(own_weights, "fastest").backend == "torch"
    assert len(tried) == 2
    assert "unknown operation" in caplog.text
