"""The code for CUDA devices, as far as it can be tested on the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from annotator.detection.backends import cuda
from annotator.detection.backends.cuda import CudaRunner, anchors_of, decode_in_full_precision
from annotator.detection.backends.raw_network import raw_network
from annotator.detection.ultralytics_api import api
from tests.detection.test_backends import batches, untrained

pytestmark = pytest.mark.slow


def test_batches_are_padded_and_the_number_of_graphs_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = api().torch
    monkeypatch.setattr(cuda, "MAX_GRAPHS", 2)
    recorded: list[tuple[int, ...]] = []

    def record(module: Any, example: Any) -> Any:
        recorded.append(tuple(example.shape))
        buffer = torch.empty(len(example), 1)  # like a CUDA graph, it writes its output to the same memory each time

        def run(pixels: Any) -> Any:
            return buffer.copy_(module(pixels))

        return run

    runner = CudaRunner(lambda pixels: pixels.flatten(1).float().sum(dim=1, keepdim=True), record)
    answers = []
    for number in (3, 4, 5, 70, 3):
        pixels = torch.randint(0, 256, (number, 8, 6, 3), dtype=torch.uint8)
        answers.append((runner(pixels), pixels.flatten(1).float().sum(dim=1, keepdim=True)))
    for answer, expected in answers:  # a later run does not change an earlier answer
        torch.testing.assert_close(answer, expected)
    assert [shape[0] for shape in recorded] == [4, 8, 32, 4]
    assert len(runner._graphs) == 2


def test_decoding_in_full_precision_reduces_the_error(tmp_path: Path) -> None:
    """The error is smaller than with half-precision decoding, and far smaller than that of swapped colour channels."""
    torch, weights = api().torch, untrained(tmp_path / "detector.pt", "yolo11n")

    def network() -> Any:
        return raw_network(weights, torch.device("cpu"))[0]

    pixels = torch.from_numpy(batches()[2])
    with torch.inference_mode():
        expected, swapped, plain = network()(pixels), network()(pixels.flip(-1)), network().half()(pixels)
        half = decode_in_full_precision(network().half())
        answer = half(pixels)
    assert answer.dtype == torch.float32
    off, far, off_plain = ((each - expected).abs() for each in (answer, swapped, plain))
    assert off[:, :4].mean() < off_plain[:, :4].mean()
    assert off[:, :4].mean() < far[:, :4].mean() / 5
    assert off[:, 4:].mean() < far[:, 4:].mean() / 5
    anchors, strides = anchors_of(half)
    assert (anchors.dtype, anchors.shape[-1]) == (torch.float32, expected.shape[-1])
    assert strides.shape[-1] == expected.shape[-1]
