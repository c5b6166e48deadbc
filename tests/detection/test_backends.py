"""The backends give the same boxes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.detection.backends import openvino_network
from annotator.detection.backends.choose import open_network
from annotator.detection.backends.network import Network
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.selection import candidates
from annotator.detection.ultralytics_api import api, load_weights
from annotator.detection.yolo import YoloDetector
from annotator.types import Box2D

pytestmark = pytest.mark.slow

EXPORTED: tuple[Backend, Backend] = ("openvino", "onnxruntime")
SHAPES = ((3, 64, 96, 3), (1, 96, 96, 3), (2, 96, 32, 3))


def make(weights: Path, **settings: Any) -> YoloDetector:
    return YoloDetector(weights, DetectorConfig(**{"image_size_px": 96, "device": "cpu", **settings}))


def opened(weights: Path, backend: Backend, digest: str = "digest", **settings: Any) -> Network:
    return open_network(weights, digest, DetectorConfig(image_size_px=96, device="cpu", backend=backend, **settings))


def untrained(path: Path, name: str) -> Path:
    """A weights file of random weights whose scores are spread over 0 to 1, so that they can be compared."""
    torch = api().torch
    torch.manual_seed(0)
    model = api().DetectionModel(f"{name}.yaml", nc=3, verbose=False)
    model.end2end = name == "yolo26n"  # one object, one box; without it, it is like the others
    head = model.model[-1]
    with torch.no_grad():
        for branch in ("cv2", "cv3", "one2one_cv2", "one2one_cv3"):
            for layers in getattr(head, branch, None) or ():
                layers[-1].weight.mul_(0.1)  # neither boxes nor scores beyond all bounds
                if "cv3" in branch:
                    layers[-1].bias.zero_()  # else every score is next to none
        for module in model.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.momentum = 1.0
        model.train()(torch.rand(8, 3, 64, 64))  # as if it had been trained: what is measured once is normalised
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
    wanted = expected.predict(batches())
    assert wanted[0][:, 4:].std() > 0.001  # there is something to compare
    for backend in EXPORTED:
        network = opened(random_weights[name], backend)
        assert (network.backend, network.facts) == (backend, expected.facts)
        assert network.facts.end2end == (name == "yolo26n")
        for answer, want, shape in zip(network.predict(batches()), wanted, SHAPES, strict=True):
            assert answer.shape == want.shape == (shape[0], 7, sum(shape[1] * shape[2] // s**2 for s in (8, 16, 32)))
            np.testing.assert_allclose(answer[:, :4], want[:, :4], atol=0.1, rtol=1e-3)
            np.testing.assert_allclose(answer[:, 4:], want[:, 4:], atol=2e-3)


def test_objects_answered_once_are_ranked_as_ultralytics_does(random_weights: dict[str, Path]) -> None:
    torch, batch = api().torch, batches()[0]
    theirs = load_weights(random_weights["yolo26n"], torch.device("cpu")).fuse(verbose=False).eval()
    with torch.inference_mode():
        wanted = theirs(torch.from_numpy(batch).permute(0, 3, 1, 2) / 255)[0].numpy()
    answer = opened(random_weights["yolo26n"], "torch").predict([batch])[0]
    found = candidates(answer, True, 0.0)
    for picture, rows in enumerate(wanted):
        mine = np.flatnonzero(found.picture == picture)
        mine = mine[np.argsort(-found.scores[mine], kind="stable")][:20]
        np.testing.assert_allclose(found.scores[mine], rows[:20, 4], atol=1e-5)
        np.testing.assert_allclose(found.boxes[mine], rows[:20, :4], atol=1e-2)
        np.testing.assert_array_equal(found.numbers[mine], rows[:20, 5])


@pytest.mark.parametrize("backend", EXPORTED)
def test_a_pictures_answer_is_its_own(random_weights: dict[str, Path], backend: Backend) -> None:
    """To the bit, with others or alone, on one core or more: frames that are shared out give what one process gives."""
    network, alone = (
        opened(random_weights["yolo11n"], backend, threads=2),
        opened(random_weights["yolo11n"], backend, threads=1),
    )
    together = network.predict(batches())
    for batch, answer in zip(batches(), together, strict=True):
        np.testing.assert_array_equal(network.predict([batch[:1]])[0], answer[:1])
        np.testing.assert_array_equal(alone.predict([batch])[0], answer)


def test_pictures_are_computed_alone_where_together_they_have_other_answers(
    random_weights: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    network = opened(random_weights["yolo11n"], "openvino", threads=2)
    many = [np.random.default_rng(0).integers(0, 256, (19, 64, 32, 3), np.uint8)]
    wanted = network.predict(many)[0]
    assert isinstance(network, openvino_network.OpenVinoNetwork)
    assert network._lengths(many[0], 2) == [6, 6, 3, 3, 1]
    assert network._lengths(many[0], 4) == [3, 3, 3, 3, 1, 1, 1, 1, 1, 1, 1]
    assert {shape[0] for shape, _ in network._compiled} == {1, *openvino_network.TOGETHER}

    network._joins.clear()
    plain = network._run
    monkeypatch.setattr(
        network, "_run", lambda parts, n: (a if len(a) == 1 else np.nextafter(a, 1) for a in plain(parts, n))
    )
    np.testing.assert_array_equal(network.predict(many)[0], wanted)


def test_few_compiled_sizes_are_kept(random_weights: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openvino_network, "MAX_COMPILED", 2)
    network = opened(random_weights["yolo11n"], "openvino", threads=1)
    assert isinstance(network, openvino_network.OpenVinoNetwork)
    first = network.predict(batches())
    assert len(network._compiled) == 2
    for answer, again in zip(first, network.predict(batches()), strict=True):
        np.testing.assert_array_equal(answer, again)


@pytest.mark.shared
def test_boxes_on_real_pseudo_views_agree_with_torch(shared: Path, random_weights: dict[str, Path]) -> None:
    from annotator.rcv.config import RcvConfig, ViewConfig
    from annotator.rcv.teach import TaughtObject, teach_views
    from annotator.recordings import open_recording
    from annotator.types import BoxKind
    from annotator.workflows.truth import load_truth

    recording = open_recording(shared / "data" / "hand_gesture")
    frame = recording.frame(0)
    objects = [TaughtObject(truth.label, truth.box) for truth in load_truth(recording, 0, frame)]
    config = RcvConfig(view=ViewConfig(size_px=128))
    taught = teach_views(frame, objects, BoxKind.BOX, 4, config, None, np.random.default_rng(0))
    views = [view.view for view in taught]
    assert len({view.rgb.shape for view in views}) > 3
    for weights in random_weights.values():
        # Networks that have learnt nothing are sure of nothing: the better half of their scores, nothing suppressed.
        settings: dict[str, Any] = {"confidence": 1e-3, "iou": 1.0, "image_size_px": 160}
        scores = [box.score for boxes in make(weights, backend="torch", **settings).detect(views) for box in boxes]
        settings["confidence"] = float(np.median(np.unique(scores)))
        wanted = make(weights, backend="torch", **settings).detect(views)
        assert sum(map(len, wanted)) > 50
        for backend in EXPORTED:
            found = make(weights, backend=backend, **settings).detect(views)
            for boxes, want in zip(found, wanted, strict=True):
                assert_same(boxes, want, settings["confidence"])


def assert_same(boxes: Sequence[Box2D], wanted: Sequence[Box2D], confidence: float) -> None:
    """Each box has its like, within 1 px and 0.01, but for those at the edge of being none."""
    for some, others in ((boxes, wanted), (wanted, boxes)):
        for box in some:
            if box.score < confidence + 0.01:
                continue
            assert any(
                other.label == box.label
                and abs(other.score - box.score) <= 0.01
                and np.abs(np.subtract(other.xyxy, box.xyxy)).max() <= 1
                for other in others
            )
