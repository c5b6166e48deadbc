"""All backends give the same boxes."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from annotator.detection.backends import choose, openvino_network
from annotator.detection.backends import export as export_module
from annotator.detection.backends.choose import open_network
from annotator.detection.backends.export import export
from annotator.detection.backends.network import Network
from annotator.detection.backends.openvino_network import OpenVinoNetwork
from annotator.detection.config import Backend, DetectorConfig, EdgeErrors
from annotator.detection.trained import TrainedModel
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import load_weights
from annotator.detection.yolo import YoloDetector, candidates
from annotator.types import Box2D
from annotator.types.errors import ConfigError

pytestmark = pytest.mark.slow

EXPORTED: tuple[Backend, Backend] = ("openvino", "onnxruntime")
SHAPES = ((3, 64, 96, 3), (1, 96, 96, 3), (2, 96, 32, 3))


@dataclass(frozen=True)
class PlainImage:
    rgb: np.ndarray


def make(weights: Path, **settings: Any) -> YoloDetector:
    return YoloDetector(weights, DetectorConfig(**{"image_size_px": 96, "device": "cpu", **settings}))


def opened(weights: Path, backend: Backend, **settings: Any) -> Network:
    digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    return open_network(weights, digest, DetectorConfig(image_size_px=96, device="cpu", backend=backend, **settings))


def untrained(path: Path, name: str) -> Path:
    """A file of random weights whose scores are spread over 0 to 1, so that they can be compared."""
    torch = api().torch
    torch.manual_seed(0)
    model = api().DetectionModel(f"{name}.yaml", nc=3, verbose=False)
    model.end2end = name == "yolo26n"  # predicts one box per object; otherwise yolo26n behaves like the others
    head = model.model[-1]
    with torch.no_grad():
        for branch in ("cv2", "cv3", "one2one_cv2", "one2one_cv3"):
            for layers in getattr(head, branch, None) or ():
                layers[-1].weight.mul_(0.1)  # keeps boxes and scores in a plausible range
                if "cv3" in branch:
                    layers[-1].bias.zero_()  # otherwise all scores are almost 0
        for module in model.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.momentum = 1.0
        model.train()(torch.rand(8, 3, 64, 64))  # sets the statistics of batch normalisation
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"model": model.eval()}, path)
    return path


@pytest.fixture(scope="module")
def random_weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("random")
    return {name: untrained(folder / name / "detector.pt", name) for name in ("yolo11n", "yolo26n")}


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
    for backend in EXPORTED:
        network = opened(random_weights[name], backend)
        assert (network.backend, network.facts) == (backend, expected.facts)
        assert network.facts.end2end == (name == "yolo26n")
        for answer, reference, shape in zip(network.predict(batches()), references, SHAPES, strict=True):
            assert (
                answer.shape
                == reference.shape
                == (shape[0], rows, sum(shape[1] * shape[2] // s**2 for s in (8, 16, 32)))
            )
            np.testing.assert_allclose(answer[:, :4], reference[:, :4], atol=0.1, rtol=1e-3)
            np.testing.assert_allclose(answer[:, 4:7], reference[:, 4:7], atol=2e-3)
            np.testing.assert_allclose(answer[:, 7:], reference[:, 7:], atol=0.1, rtol=1e-3)


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


@pytest.mark.parametrize("backend", EXPORTED)
def test_output_does_not_depend_on_the_batch(random_weights: dict[str, Path], backend: Backend) -> None:
    """Bitwise equal in a batch and alone, with one thread and with two."""
    network, alone = (
        opened(random_weights["yolo11n"], backend, threads=2),
        opened(random_weights["yolo11n"], backend, threads=1),
    )
    together = network.predict(batches())
    for batch, answer in zip(batches(), together, strict=True):
        np.testing.assert_array_equal(network.predict([batch[:1]])[0], answer[:1])
        np.testing.assert_array_equal(alone.predict([batch])[0], answer)


def test_images_run_alone_if_batches_change_the_output(
    random_weights: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    network = opened(random_weights["yolo11n"], "openvino", threads=2)
    many = [np.random.default_rng(0).integers(0, 256, (19, 64, 32, 3), np.uint8)]
    # whether batches are used depends on the processor
    references = network.predict(many)[0]
    assert isinstance(network, openvino_network.OpenVinoNetwork)
    assert {shape[0] for shape, _ in network._compiled} == {1, *openvino_network.TOGETHER}
    for streams, lengths in ((2, [6, 6, 3, 3, 1]), (4, [3, 3, 3, 3, 1, 1, 1, 1, 1, 1, 1])):
        network._joins[many[0].shape[1:], streams] = True
        assert network._lengths(many[0], streams) == lengths
        network._joins[many[0].shape[1:], streams] = False
        assert network._lengths(many[0], streams) == [1] * 19

    network._joins.clear()
    plain = network._run
    monkeypatch.setattr(
        network, "_run", lambda parts, n: (a if len(a) == 1 else np.nextafter(a, 1) for a in plain(parts, n))
    )
    np.testing.assert_array_equal(network.predict(many)[0], references)


@pytest.mark.shared
def test_boxes_on_real_pseudo_views_agree_with_torch(shared: Path, random_weights: dict[str, Path]) -> None:
    from annotator.rcv.config import RcvConfig, ViewConfig
    from annotator.rcv.teach import TaughtObject, teach_views
    from annotator.recordings import open_recording
    from annotator.types import BoxKind
    from annotator.workflows.recorded.reading import load_truth

    recording = open_recording(shared / "data" / "hand_gesture")
    frame = recording.frame(0)
    objects = [TaughtObject(truth.label, truth.box) for truth in load_truth(recording, 0, frame)]
    config = RcvConfig(view=ViewConfig(size_px=128))
    taught = teach_views(frame, objects, BoxKind.BOX, 4, config, None, np.random.default_rng(0))
    views = [view.view for view in taught]
    assert len({view.rgb.shape for view in views}) > 3
    for weights in random_weights.values():
        # Untrained networks have low scores: compare the upper half of the scores, without suppression.
        settings: dict[str, Any] = {"confidence": 1e-3, "iou": 1.0, "image_size_px": 160}
        scores = [box.score for boxes in make(weights, backend="torch", **settings).detect(views) for box in boxes]
        settings["confidence"] = float(np.median(np.unique(scores)))
        references = make(weights, backend="torch", **settings).detect(views)
        assert sum(map(len, references)) > 50
        for backend in EXPORTED:
            detected = make(weights, backend=backend, **settings).detect(views)
            for boxes, expected in zip(detected, references, strict=True):
                assert_same(boxes, expected, settings["confidence"])


def assert_same(boxes: Sequence[Box2D], expected: Sequence[Box2D], confidence: float) -> None:
    """Each box has a counterpart within 1 px and 0.01, except boxes near the confidence threshold."""
    for some, others in ((boxes, expected), (expected, boxes)):
        for box in some:
            if box.score < confidence + 0.01:
                continue
            assert any(
                other.label == box.label
                and abs(other.score - box.score) <= 0.01
                and np.abs(np.subtract(other.xyxy, box.xyxy)).max() <= 1
                for other in others
            )


def test_boxes_have_the_present_names_of_their_classes(own_weights: Path, scene: Any) -> None:
    images = [PlainImage(scene(seed).rgb) for seed in range(6)]
    before = [box for boxes in make(own_weights).detect(images) for box in boxes]
    assert {box.label for box in before} == {"blue", "red"}
    renamed = make(own_weights, names={"blue": "azure", "red": None})
    assert renamed.labels == ("azure",)
    after = [box for boxes in renamed.detect(images) for box in boxes]
    assert after == [replace(box, label="azure") for box in before if box.label == "blue"]
    assert renamed.fingerprint == make(own_weights).fingerprint


# OpenVINO in bfloat16: accuracy, the layers in single precision, and when it is chosen.


@pytest.fixture
def bfloat16() -> None:
    """Skips the test on processors without bfloat16."""
    pytest.importorskip("openvino")
    if not openvino_network.computes_bfloat16():
        pytest.skip("a processor without bfloat16")


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
    network.predict([np.zeros((1, 96, 96, 3), np.uint8)])
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
