"""Detects clear slowdowns of the hot path by ratios of times within one run.

    python -m benchmarks.ratios [--json]

Each part of the hot path is timed relative to a reference on the same machine at the same time: sorting numbers,
drawing six views, or the same work in another way. Both are timed in turns. The best of several rounds counts, because
other programs can only increase a ratio. The exit code is 1 if a ratio is above its bound, which is about 1.5 times the
measured value (docs/benchmarks.md). Ratios depend on the processor (another one may sort ten times as fast, but render
at the same speed), so this benchmark is not part of `scripts/test`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.perfect import PerfectDetector
from annotator.detection.ultralytics_api import api
from annotator.detection.weights import NetworkDescription, build, write_network
from annotator.detection.yolo import YoloDetector
from annotator.geometry.oriented_box import box_corners
from annotator.project.config import BoxRotation
from annotator.rcv.config import AGNOSTIC_LABELS, RcvConfig, TypicalSize
from annotator.rcv.interval_fit import Intervals, fit_box
from annotator.rcv.pseudo_view import render_pairs
from annotator.rcv.recursion import plan_step, start
from annotator.rcv.rotations import near_axes, wide_axes
from annotator.rcv.starts import start_rivals
from annotator.types import Box2D, BoxKind, Camera, Detector, Image, OrientedBox, PointCloud, Truth
from annotator.workflows.detectors import Detectors
from annotator.workflows.live.detection import LiveDetection, Taken
from annotator.workflows.warm_up import BOX, warm_frame
from benchmarks.report import Options, Table, guarded, program, seconds_of

POINTS = 50_000
VIEW_PX = 64
SORTED = 50_000
# Camera and image box of `frustum`.
CAMERA, ON_IMAGE = Camera(640, 480, 500.0, 500.0, 319.5, 239.5), Box2D("object", 269.5, 189.5, 369.5, 289.5)
TYPICAL = TypicalSize(label="object", size_m=(0.4, 0.3, 0.2), spread=(0.1, 0.1, 0.1))


def frustum(points: int, rng: np.random.Generator) -> PointCloud:
    """A coloured cloud as from a depth camera: a wavy surface two metres away, in pixel order."""
    side = int(np.ceil(np.sqrt(points)))
    v, u = np.divmod(np.arange(points), side)
    x, y = (u / side - 0.5) * 1.2, (v / side - 0.5) * 1.2
    z = 2.0 + 0.2 * np.sin(6 * x) * np.cos(5 * y) + rng.normal(0, 0.003, points)
    return PointCloud(np.stack([x, y, z], axis=1).astype(np.float32), rng.integers(0, 255, (points, 3), np.uint8))


@dataclass
class Arguments(Options):
    rounds: int = 5
    """Maximum number of rounds for each ratio; the first round within the bound is enough."""


@dataclass(frozen=True)
class Ratio:
    """A piece of work, a reference, and the upper bound of the ratio of their times.

    In a round both run `repeats` times in turns, and their medians are compared.
    """

    name: str
    work: Callable[[], object]
    reference: Callable[[], object]
    most: float
    repeats: int = 7


@dataclass(frozen=True)
class Outcome:
    """The best round of a ratio."""

    name: str
    ratio: float
    most: float

    @property
    def is_worse(self) -> bool:
        return self.ratio > self.most


def measured(ratio: Ratio, rounds: int) -> Outcome:
    """The smallest ratio over the rounds; stops at the first round within the bound."""
    best = float("inf")
    for _ in range(rounds):
        best = min(best, _round(ratio))
        if best <= ratio.most:
            break
    return Outcome(ratio.name, best, ratio.most)


def _round(ratio: Ratio) -> float:
    ratio.work(), ratio.reference()
    seconds = np.array([[seconds_of(ratio.work), seconds_of(ratio.reference)] for _ in range(ratio.repeats)])
    work, reference = np.median(seconds, axis=0)
    return float(work / reference)


def cpu_ratios() -> list[Ratio]:
    """The work without detectors, compared with sorting numbers or with drawing six views."""
    rng = np.random.default_rng(0)
    numbers = rng.random(SORTED, np.float32)
    cloud = frustum(POINTS, rng)
    config = RcvConfig(view_px=VIEW_PX)
    true = OrientedBox.from_parts(np.array([0.1, 0.0, 2.0]), np.eye(3), np.array([0.6, 0.4, 0.3]))
    intervals = _measured_intervals(true, [*wide_axes(None), *near_axes(true.rotation, None)], rng)
    axes = near_axes(true.rotation, None)
    agnostic = config.for_detector(BoxKind.BOX, class_agnostic=True)
    sized = agnostic.model_copy(update={"typical_sizes": (TYPICAL,)})
    unknown = start(0, ON_IMAGE, cloud, None, config)

    def first_look() -> object:
        return [plan_step(state, agnostic) for state in start_rivals(CAMERA, unknown, agnostic)]

    def six_views() -> object:
        return render_pairs(cloud, axes, VIEW_PX)

    def sort() -> object:
        return np.argsort(numbers, kind="stable")  # numpy's stable sort does not depend on special CPU instructions

    return [
        Ratio("six views of a cloud of 50,000 / sorting", six_views, sort, 0.7),
        Ratio("box through 60 intervals / sorting", lambda: fit_box(intervals, None), sort, 0.55),
        Ratio("the same with a start rotation / sorting", lambda: fit_box(intervals, None, true.rotation), sort, 0.55),
        Ratio("views of a first look / six views", first_look, six_views, 30.0),
        Ratio("placement by size / six views", lambda: start_rivals(CAMERA, unknown, sized), six_views, 100.0),
    ]


def _measured_intervals(box: OrientedBox, axes: list[np.ndarray], rng: np.random.Generator) -> Intervals:
    """The intervals that front and side views along the axes measure of a box, with noise."""
    directions = np.concatenate([rows[[0, 1]] for rows in axes] + [rows[[2, 1]] for rows in axes])
    along = box_corners(box) @ directions.T
    ends = np.stack([along.min(axis=0), along.max(axis=0)], axis=1)
    return Intervals(directions, ends + rng.normal(0, 0.01, ends.shape), np.full(ends.shape, 0.01))


def detector_ratios(folder: Path) -> list[Ratio]:
    """An untrained network: the default backend of this machine, compared with torch, and in live detection."""
    weights = folder / "untrained.safetensors"
    api().torch.manual_seed(0)
    write_network(weights, build(NetworkDescription(architecture="yolo11n", labels=("object",))))
    config = RcvConfig(view_px=VIEW_PX)
    cloud = frustum(20_000, np.random.default_rng(1))
    views = render_pairs(cloud, near_axes(np.eye(3), None), config.view_px)

    def loaded(backend: Backend) -> Detector:
        return YoloDetector(weights, DetectorConfig(image_size_px=VIEW_PX, backend=backend, device="cpu"))

    default, torch = loaded("auto"), loaded("torch")
    backends = Ratio(
        "six views by the default backend / torch", lambda: default.detect(views), lambda: torch.detect(views), 0.5
    )
    return [backends, *live_ratios(default)]


class _Known:
    """A network whose answers are replaced by the true boxes."""

    labels = tuple(AGNOSTIC_LABELS.values())
    fingerprint = "known"

    def __init__(self, network: Detector, truth: Detector) -> None:
        self._network, self._truth = network, truth

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        self._network.detect(images)
        return self._truth.detect(images)


def live_ratios(network: Detector) -> list[Ratio]:
    """Live detection of one object by a trained view detector, each frame by itself, compared with warm starts."""
    frame = warm_frame()
    truth = PerfectDetector.for_frame(frame, [Truth(AGNOSTIC_LABELS[BoxKind.BOX], BOX)])
    image = PerfectDetector.for_frame(frame, [Truth(TYPICAL.label, BOX)])
    detectors = Detectors(image, _Known(network, truth), class_agnostic=True, trained=True)
    config = RcvConfig(view_px=VIEW_PX, typical_sizes=(TYPICAL,))

    def live(warm_start: bool) -> Callable[[], object]:
        detection = LiveDetection(detectors, config, BoxRotation.FREE, warm_start=warm_start)
        detection.detect(Taken(frame, 0.0, 0.0))
        return lambda: detection.detect(Taken(frame, 0.0, 0.0))

    return [Ratio("live, each frame by itself / warm starts", live(False), live(True), 6.0)]


def run(args: Arguments) -> dict[str, Any]:
    cv2.setNumThreads(1)
    with TemporaryDirectory() as folder:
        ratios = [*cpu_ratios(), *detector_ratios(Path(folder))]
        outcomes = [measured(ratio, max(args.rounds, 1)) for ratio in ratios]
    return {
        "ratios": [{**vars(outcome), "is_worse": outcome.is_worse} for outcome in outcomes],
        "worse": [outcome.name for outcome in outcomes if outcome.is_worse],
    }


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    return [Table("work / reference", "ratio", "at most", "worse", rows=(row.values() for row in result["ratios"]))]


def main() -> None:
    if program(Arguments, run, tables, __doc__)()["worse"]:
        sys.exit(1)


if __name__ == "__main__":
    guarded(main)
