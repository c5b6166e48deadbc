"""The self-test detects backends with wrong output."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.detection.backends import agreement
from annotator.detection.backends.agreement import Agreements
from annotator.detection.backends.network import Answer, Batch
from annotator.detection.backends.torch_network import TorchNetwork
from annotator.detection.pretrained import write_seeded_network
from annotator.detection.ultralytics_api import api, pick_device
from annotator.types.errors import DetectionError
from annotator.workflows.doctor import State, self_test


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("seeded") / "network.safetensors"
    write_seeded_network(path)
    return path


@pytest.fixture(scope="module")
def agreements(weights: Path) -> Agreements:
    return Agreements(weights, np.random.default_rng(0).integers(0, 256, (2, 64, 96, 3), np.uint8))


@dataclass
class Wrong:
    """Torch on the CPU with changed output, under another backend's name."""

    weights: Path
    change: Callable[[Answer], Answer]
    backend: str = "onnxruntime"
    device: str = "cpu"
    facts: Any = None
    network: TorchNetwork = field(init=False)

    def __post_init__(self) -> None:
        self.network = TorchNetwork(self.weights, pick_device("cpu"))

    def predict(self, batches: Sequence[Batch]) -> list[Answer]:
        return [self.change(answer) for answer in self.network.predict(batches)]


def moved(by_px: float) -> Callable[[Answer], Answer]:
    return lambda answer: np.concatenate([answer[:, :4] + np.float32(by_px), answer[:, 4:]], axis=1)


def test_equal_seeds_give_equal_networks_and_keep_torchs_random_state(weights: Path, tmp_path: Path) -> None:
    torch = api().torch
    state = torch.random.get_rng_state()
    write_seeded_network(tmp_path / "new" / "again.safetensors")
    write_seeded_network(tmp_path / "other.safetensors", seed=1)
    assert torch.equal(state, torch.random.get_rng_state())
    picture = np.random.default_rng(0).integers(0, 256, (1, 64, 64, 3), np.uint8)
    same, again, other = (
        TorchNetwork(path, pick_device("cpu")).predict([picture])[0]
        for path in (weights, tmp_path / "new" / "again.safetensors", tmp_path / "other.safetensors")
    )
    np.testing.assert_array_equal(same, again)
    assert np.abs(same - other).max() > 1
    # the scores differ between anchors, so a comparison is meaningful
    assert same[:, 4:].std() > 0.01


def test_correct_output_agrees_and_wrong_output_does_not(agreements: Agreements) -> None:
    assert agreements.of(lambda path: Wrong(path, lambda answer: answer)).holds
    for wrong in (
        moved(0.5),
        lambda answer: answer[:, [0, 1, 2, 3, 5, 4, *range(6, answer.shape[1])]],  # classes in another order
        lambda answer: answer[:, [*range(answer.shape[1] - 4), -3, -4, -2, -1]],  # spreads in another order
        lambda answer: answer[::-1].copy(),  # pictures in another order
        lambda answer: np.where(np.arange(answer.shape[2]) == 0, np.float32(np.nan), answer),
    ):
        assert not agreements.of(lambda path, wrong=wrong: Wrong(path, wrong)).holds
    with pytest.raises(DetectionError, match="shape"):
        agreements.of(lambda path: Wrong(path, lambda answer: answer[:, :, 1:]))


@pytest.mark.parametrize(("name", "precision"), [("openvino-bf16", "bfloat16"), ("torch", "float16")])
def test_half_precision_has_a_larger_but_limited_tolerance(agreements: Agreements, name: str, precision: str) -> None:
    device = "cuda:0" if precision == "float16" else "cpu"
    small = agreements.of(lambda path: Wrong(path, moved(0.5), name, device))
    assert small.holds and small.reference == precision
    assert not agreements.of(lambda path: Wrong(path, moved(100.0), name, device)).holds


def test_a_wrong_or_broken_backend_is_a_failed_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fails(_: Path) -> None:
        raise DetectionError("no such operation")

    made = {
        "right": lambda path: Wrong(path, lambda answer: answer),
        "wrong": lambda path: Wrong(path, moved(0.5)),
        "broken": fails,
    }
    monkeypatch.setattr(agreement, "openers", lambda _: made)
    found = {line.name: line for line in self_test.backends(tmp_path)}
    assert {name: line.state.value for name, line in found.items()} == {
        "right": "ok",
        "wrong": "failed",
        "broken": "failed",
    }
    assert found["wrong"].figures["boxes_px"] == pytest.approx(0.5, rel=0.01)
    assert found["wrong"].figures["boxes_bound_px"] < 0.1
    assert "no such operation" in found["broken"].found


@pytest.mark.slow
def test_the_backends_of_this_machine_agree(tmp_path: Path) -> None:
    found = {line.name: line for line in self_test.backends(tmp_path)}
    assert set(found) >= {"openvino", "openvino-bf16", "onnxruntime"}
    assert all(line.state is State.OK for line in found.values()), found
    assert "boxes_px" in found["onnxruntime"].figures


def test_without_the_detectors_package_backends_are_not_tested(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from annotator.detection import pretrained

    def missing() -> None:
        raise DetectionError("no ultralytics")

    monkeypatch.setattr(pretrained, "api", missing)
    (line,) = self_test.backends(tmp_path)
    assert (line.state, line.found) == (State.WARNING, "not tested (no ultralytics)")
