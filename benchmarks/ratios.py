"""Has something got clearly slower? Ratios within one run, so that any machine can tell.

    python -m benchmarks.ratios [--json]

Each part of the hot path is compared with something that costs the same on the same machine in the same moment: sorting
numbers, or the same work done without what makes it fast. The two are timed in turns, and of several rounds the best
counts, since other programs can only make a ratio worse. The exit code is 1 where a ratio is beyond its bound, which is
about one and a half times what was measured (docs/benchmarks.md). `scripts/test` runs this.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import cv2
import numpy as np
import tyro

from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.ultralytics_api import api
from annotator.detection.yolo import YoloDetector
from annotator.geometry.oriented_box import box_corners
from annotator.rcv.config import RcvConfig, ViewConfig
from annotator.rcv.hypotheses import near_frames, wide_frames
from annotator.rcv.interval_fit import Intervals, fit_box
from annotator.rcv.pseudo_view import render_pairs
from annotator.types import OrientedBox, PseudoView
from benchmarks.pseudo_view import frustum
from benchmarks.report import Table, finish, guarded

WORSE = 1
POINTS = 50_000
PICTURE_PX = 64
SORTED = 50_000


@dataclass
class Arguments:
    """Compares the parts of the hot path with yardsticks."""

    rounds: int = 5
    """How often each is measured, at most; the best round counts, and one that is within the bound is enough."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Ratio:
    """Two pieces of work, and how long the first may take, as a multiple of the second.

    Attributes:
        name: what is compared with what.
        work, yardstick: each does its work once.
        most: the bound.
        repeats: of the two, in turns, a round; their medians are compared.
    """

    name: str
    work: Callable[[], object]
    yardstick: Callable[[], object]
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
    """The least ratio of some rounds; ends with the first that is within the bound."""
    best = float("inf")
    for _ in range(rounds):
        best = min(best, _round(ratio))
        if best <= ratio.most:
            break
    return Outcome(ratio.name, best, ratio.most)


def _round(ratio: Ratio) -> float:
    ratio.work(), ratio.yardstick()
    seconds = np.array([[_timed(ratio.work), _timed(ratio.yardstick)] for _ in range(ratio.repeats)])
    work, yardstick = np.median(seconds, axis=0)
    return float(work / yardstick)


def _timed(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def cpu_ratios() -> list[Ratio]:
    """What needs no detector, compared with sorting numbers."""
    rng = np.random.default_rng(0)
    numbers = rng.random(SORTED, np.float32)
    cloud, view = frustum(POINTS, rng), ViewConfig(size_px=PICTURE_PX)
    config = RcvConfig(view=view)
    true = OrientedBox.from_parts(np.array([0.1, 0.0, 2.0]), np.eye(3), np.array([0.6, 0.4, 0.3]))
    intervals = _seen(true, [*wide_frames(None, config), *near_frames(true.rotation, None, config)], rng)
    frames = near_frames(true.rotation, None, config)

    def sort() -> object:
        return np.argsort(numbers, kind="stable")  # which no processor has a special way of doing

    return [
        Ratio("six views of a cloud of 50,000 / sorting", lambda: render_pairs(cloud, frames, view), sort, 0.7),
        Ratio("box through 60 intervals / sorting", lambda: fit_box(intervals, None), sort, 0.55),
        Ratio("the same near a known one / sorting", lambda: fit_box(intervals, None, true.rotation), sort, 0.55),
    ]


def _seen(box: OrientedBox, frames: list[np.ndarray], rng: np.random.Generator) -> Intervals:
    """What views along frames measure of a box, a little off."""
    directions = np.concatenate([frame[[0, 1]] for frame in frames] + [frame[[2, 1]] for frame in frames])
    along = box_corners(box) @ directions.T
    ends = np.stack([along.min(axis=0), along.max(axis=0)], axis=1)
    return Intervals(directions, ends + rng.normal(0, 0.01, ends.shape), np.full(ends.shape, 0.01))


def detector_ratios(folder: Path) -> list[Ratio]:
    """The default backend of this machine, compared with torch, on a network that has learnt nothing."""
    weights = folder / "untrained.pt"
    parts = api()
    parts.torch.manual_seed(0)
    parts.torch.save({"model": parts.DetectionModel("yolo11n.yaml", nc=1, verbose=False)}, weights)
    views = _views()

    def asked(backend: Backend) -> Callable[[], object]:
        detector = YoloDetector(weights, DetectorConfig(image_size_px=PICTURE_PX, backend=backend, device="cpu"))
        return lambda: detector.detect(views)

    return [Ratio("six pictures by the default backend / torch", asked("auto"), asked("torch"), 0.5)]


def _views() -> list[PseudoView]:
    rng = np.random.default_rng(1)
    config = RcvConfig(view=ViewConfig(size_px=PICTURE_PX))
    return render_pairs(frustum(20_000, rng), near_frames(np.eye(3), None, config), config.view)


def run(args: Arguments) -> dict[str, object]:
    """The benchmark; what `--json` prints.

    Raises:
        DetectionError: the detectors' packages are missing.
    """
    cv2.setNumThreads(1)
    with TemporaryDirectory() as folder:
        ratios = [*cpu_ratios(), *detector_ratios(Path(folder))]
        outcomes = [measured(ratio, max(args.rounds, 1)) for ratio in ratios]
    return {
        "ratios": [{**vars(outcome), "is_worse": outcome.is_worse} for outcome in outcomes],
        "worse": [outcome.name for outcome in outcomes if outcome.is_worse],
    }


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("work / yardstick", "ratio", "at most", "worse")
    for row in result["ratios"]:  # type: ignore[attr-defined]
        table.add(*row.values())
    finish(result, args.json, table)
    if result["worse"]:
        sys.exit(WORSE)


if __name__ == "__main__":
    guarded(main)
