"""Backends side by side: what a picture takes on each, in one run, and how far their boxes are apart."""

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

# Pictures a call: the camera image of a live frame, the first step's views, a later step's, and the widest step's.
CALLS = (1, 2, 6, 24)
ROUNDS = 9


def compared(
    weights: Path, size_px: int, pictures: Sequence[Image], backends: Sequence[Backend]
) -> dict[str, dict[str, Any]]:
    """Figures of each backend.

    Backends take turns, so that other work on the machine disturbs all of them alike.

    Returns:
        a backend: `load_s`, of a network that has been exported before; `ms_per_picture`, median, by pictures a call;
        `speed_up`, the first backend's medians in this run over its own; `off_px` and `off_score`, the largest
        differences from the first backend's boxes.
    """
    detectors, load_s = {}, {}
    for backend in backends:
        config = DetectorConfig(image_size_px=size_px, device="cpu", backend=backend)
        YoloDetector(weights, config)  # exports it
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
                if turn:  # sizes are compiled in the first
                    times[backend].append(time.perf_counter() - begin)
        for backend in backends:
            medians[backend][str(number)] = float(np.median(times[backend])) / number * 1e3
    found = {backend: detector.detect(pictures) for backend, detector in detectors.items()}
    first = backends[0]
    return {
        backend: {
            "load_s": load_s[backend],
            "ms_per_picture": medians[backend],
            "speed_up": {call: medians[first][call] / own for call, own in medians[backend].items()},
            **apart(found[first], found[backend]),
        }
        for backend in backends
    }


def apart(wanted: Sequence[Sequence[Box2D]], found: Sequence[Sequence[Box2D]]) -> dict[str, object]:
    """Largest differences of edges and scores, between boxes of the same rank."""
    pairs = [
        (a, b)
        for some, others in zip(wanted, found, strict=True)
        if len(some) == len(others)
        for a, b in zip(some, others, strict=True)
    ]
    return {
        "boxes": len(pairs),
        "pictures_with_other_numbers": sum(len(a) != len(b) for a, b in zip(wanted, found, strict=True)),
        "off_px": max((float(np.abs(np.subtract(a.xyxy, b.xyxy)).max()) for a, b in pairs), default=float("nan")),
        "off_score": max((abs(a.score - b.score) for a, b in pairs), default=float("nan")),
    }


def backend_table(figures: dict[str, dict[str, Any]]) -> Table:
    """A row a backend: milliseconds a picture and the ratio to the first, by pictures a call."""
    table = Table("backend", "load s", *(f"{number} a call" for number in CALLS), "off px", "off score")
    for backend, own in figures.items():
        cells = [f"{own['ms_per_picture'][str(n)]:.1f} ms, x {own['speed_up'][str(n)]:.2f}" for n in CALLS]
        table.add(backend, own["load_s"], *cells, f"{own['off_px']:.1e}", f"{own['off_score']:.1e}")
    return table
