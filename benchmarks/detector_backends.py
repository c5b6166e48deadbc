"""Compares backends in one run: time per image, and differences between their boxes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.yolo import YoloDetector
from annotator.types import Box2D, Image
from benchmarks.report import Table

# Images per call: a live camera image; the views of the first step, of a later step, and of the step with the most
# axes.
CALLS = (1, 2, 6, 24)
ROUNDS = 9


def compared(
    weights: Path, size_px: int, pictures: Sequence[Image], backends: Sequence[Backend]
) -> dict[str, dict[str, Any]]:
    """Measures each backend.

    The backends are measured in turn, so that other work on the machine slows all of them equally.

    Returns:
        By backend: `load_s`, the time to load a network that has already been exported; `ms_per_picture`, the median by
        images per call; `speed_up`, the first backend's median divided by this one's; `off_px` and `off_score`,
        the largest differences from the first backend's boxes.
    """
    detectors, load_s = {}, {}
    for backend in backends:
        config = DetectorConfig(image_size_px=size_px, device="cpu", backend=backend)
        YoloDetector(weights, config)  # exports the network
        begin = time.perf_counter()
        detectors[backend] = YoloDetector(weights, config)
        load_s[backend] = time.perf_counter() - begin
    medians: dict[Backend, dict[str, float]] = {backend: {} for backend in backends}
    for number in CALLS:
        call = [pictures[i % len(pictures)] for i in range(number)]
        times: dict[Backend, list[float]] = {backend: [] for backend in backends}
        for turn in range(ROUNDS + 1):
            for backend, detector in detectors.items():
                begin = time.perf_counter()
                detector.detect(call)
                if turn:  # the first turn compiles the sizes
                    times[backend].append(time.perf_counter() - begin)
        for backend in backends:
            medians[backend][str(number)] = float(np.median(times[backend])) / number * 1e3
    boxes = {backend: detector.detect(pictures) for backend, detector in detectors.items()}
    first = backends[0]
    return {
        backend: {
            "load_s": load_s[backend],
            "ms_per_picture": medians[backend],
            "speed_up": {call: medians[first][call] / ms for call, ms in medians[backend].items()},
            **differences(boxes[first], boxes[backend]),
        }
        for backend in backends
    }


def differences(expected: Sequence[Sequence[Box2D]], actual: Sequence[Sequence[Box2D]]) -> dict[str, object]:
    """Largest differences of edges and scores between boxes of the same rank.

    Images with different numbers of boxes are left out.
    """
    pairs = [
        (a, b)
        for first, second in zip(expected, actual, strict=True)
        if len(first) == len(second)
        for a, b in zip(first, second, strict=True)
    ]
    return {
        "boxes": len(pairs),
        "pictures_with_other_numbers": sum(len(a) != len(b) for a, b in zip(expected, actual, strict=True)),
        "off_px": max((float(np.abs(np.subtract(a.xyxy, b.xyxy)).max()) for a, b in pairs), default=float("nan")),
        "off_score": max((abs(a.score - b.score) for a, b in pairs), default=float("nan")),
    }


def backend_table(figures: dict[str, dict[str, Any]]) -> Table:
    """One row per backend: milliseconds per image and speed-up over the first backend, by images per call."""
    table = Table("backend", "load s", *(f"{number} per call" for number in CALLS), "off px", "off score")
    for backend, row in figures.items():
        cells = [f"{row['ms_per_picture'][str(n)]:.1f} ms, x {row['speed_up'][str(n)]:.2f}" for n in CALLS]
        table.add(backend, row["load_s"], *cells, f"{row['off_px']:.1e}", f"{row['off_score']:.1e}")
    return table
