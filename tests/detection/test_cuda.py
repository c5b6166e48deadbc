"""What is done differently on a graphics processor, as far as it can be seen without one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from annotator.detection.backends import cuda
from annotator.detection.backends.cuda import CudaRunner, anchors_of, decode_in_full_precision
from annotator.detection.backends.raw_network import raw_network
from annotator.detection.trained import TrainedModel
from annotator.detection.ultralytics_api import api

pytestmark = pytest.mark.slow


def test_batches_are_filled_up_to_a_few_sizes_and_few_graphs_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = api().torch
    monkeypatch.setattr(cuda, "MAX_GRAPHS", 2)
    recorded: list[tuple[int, ...]] = []

    def record(module: Any, example: Any) -> Any:
        recorded.append(tuple(example.shape))
        held = torch.empty(len(example), 1)  # as a graph, it answers into the same memory each time

        def run(pixels: Any) -> Any:
            return held.copy_(module(pixels))

        return run

    runner = CudaRunner(lambda pixels: pixels.flatten(1).float().sum(dim=1, keepdim=True), record)
    answers = []
    for number in (3, 4, 5, 70, 3):
        pixels = torch.randint(0, 256, (number, 8, 6, 3), dtype=torch.uint8)
        answers.append((runner(pixels), pixels.flatten(1).float().sum(dim=1, keepdim=True)))
    for answer, wanted in answers:  # a later run does not change an earlier answer
        torch.testing.assert_close(answer, wanted)
    assert [shape[0] for shape in recorded] == [4, 8, 32, 4]
    assert len(runner._graphs) == 2


def test_half_precision_keeps_boxes_and_scores(tiny_model: TrainedModel) -> None:
    torch = api().torch
    pixels = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (2, 96, 640, 3), np.uint8))
    with torch.inference_mode():
        wanted = raw_network(tiny_model.weights, torch.device("cpu"))[0](pixels)
        half = decode_in_full_precision(raw_network(tiny_model.weights, torch.device("cpu"))[0].half())
        answer = half(pixels)
    assert answer.dtype == torch.float32
    assert (answer[:, :4] - wanted[:, :4]).abs().max() < 1
    assert (answer[:, 4:] - wanted[:, 4:]).abs().max() < 0.01
    anchors, strides = anchors_of(half)
    assert (anchors.dtype, anchors.shape[-1]) == (torch.float32, wanted.shape[-1])
    assert strides.shape[-1] == wanted.shape[-1]
