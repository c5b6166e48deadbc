"""Time to evaluate whole validation splits, including reading the files.

python -m benchmarks.evaluation [--kitti-frames 3769] [--sunrgbd-frames 5050] [--repeat 3] [--json]
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import tyro

from annotator.types.errors import ConfigError
from annotator.workflows.evaluating.evaluate_files import Protocol, evaluate_files
from benchmarks.report import Table, finish, guarded

CLASSES = {
    Protocol.KITTI: ("Car", "Pedestrian", "Cyclist", "Van"),
    Protocol.SUNRGBD: (
        "bed",
        "table",
        "sofa",
        "chair",
        "toilet",
        "desk",
        "dresser",
        "night_stand",
        "bookshelf",
        "bathtub",
    ),
}
# Share of the detections that lie on a true box.
MATCHING_SHARE = 0.8


@dataclass
class Arguments:
    """Evaluate splits of the official sizes with random boxes, as many detections as true boxes."""

    kitti_frames: int = 3769
    """Number of frames of the KITTI split."""
    sunrgbd_frames: int = 5050
    """Number of frames of the SUN RGB-D split."""
    boxes: int = 10
    """Number of true boxes and of detections per frame."""
    repeat: int = 3
    """Number of evaluations of each split; the median is reported."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def run(args: Arguments, folder: Path) -> dict[str, float]:
    """Seconds by protocol.

    Raises:
        ConfigError: a number below 1.
    """
    if min(args.kitti_frames, args.sunrgbd_frames, args.boxes, args.repeat) < 1:
        raise ConfigError("--kitti-frames, --sunrgbd-frames, --boxes and --repeat must be 1 or more")
    rng = np.random.default_rng(0)
    kitti = write_kitti(folder, args.kitti_frames, args.boxes, rng)
    sunrgbd = write_sunrgbd(folder, args.sunrgbd_frames, args.boxes, rng)
    return {
        "kitti_s": _median(kitti, Protocol.KITTI, args.repeat),
        "sunrgbd_s": _median(sunrgbd, Protocol.SUNRGBD, args.repeat),
    }


def _median(paths: tuple[Path, Path], protocol: Protocol, repeat: int) -> float:
    times = []
    for _ in range(repeat):
        began = time.perf_counter()
        evaluate_files(*paths, protocol)
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def write_kitti(folder: Path, frames: int, boxes: int, rng: np.random.Generator) -> tuple[Path, Path]:
    """Writes a folder of detections and a folder of labels; returns both."""
    paths = folder / "found", folder / "label_2"
    for path in paths:
        path.mkdir()
    for number in range(frames):
        labels = rng.choice(CLASSES[Protocol.KITTI], boxes)
        # alpha, 2D box (corner and size), height width length, x y z, rotation_y
        low = [-3.0, 0, 100, 30, 26, 1.4, 1.5, 3.5, -20, 1.5, 5, -3]
        true = rng.uniform(low, [3.0, 1000, 180, 150, 140, 1.8, 1.8, 4.5, 20, 2.0, 60, 3], (boxes, 12))
        detections = true + rng.normal(0.0, [0.1, 3, 3, 3, 3, 0.05, 0.05, 0.1, 0.2, 0.05, 0.2, 0.05], (boxes, 12))
        detections[rng.random(boxes) > MATCHING_SHARE, 8] += 100.0
        scores = rng.random(boxes)
        for path, rows in zip(paths, (detections, true), strict=True):
            rows[:, 3:5] += rows[:, 1:3]
            text = [
                f"{label} 0.00 {rng.integers(3)} "
                + " ".join(f"{v:.2f}" for v in row)
                + (f" {score:.4f}" if path is paths[0] else "")
                for label, row, score in zip(labels, rows, scores, strict=True)
            ]
            (path / f"{number:06d}.txt").write_text("\n".join(text) + "\n")
    return paths


def write_sunrgbd(folder: Path, frames: int, boxes: int, rng: np.random.Generator) -> tuple[Path, Path]:
    """Writes a table of detections and a table of true boxes; returns both."""
    paths, head = (folder / "found.csv", folder / "truth.csv"), "image,class,cx,cy,cz,l,w,h,yaw"
    count = frames * boxes
    images, labels = np.repeat(np.arange(frames), boxes), rng.choice(CLASSES[Protocol.SUNRGBD], count)
    true = rng.uniform([-3, 1, -1, 0.4, 0.4, 0.4, -3], [3, 6, 0, 2, 2, 1.5, 3], (count, 7))
    detections = true + rng.normal(0.0, 0.05, (count, 7))
    detections[rng.random(count) > MATCHING_SHARE, 0] += 10.0
    for path, rows, scores in zip(paths, (detections, true), (rng.random(count), None), strict=True):
        text = [
            f"{image},{label}," + ",".join(f"{v:.5f}" for v in row)
            for image, label, row in zip(images, labels, rows, strict=True)
        ]
        if scores is not None:
            text = [f"{line},{score:.6f}" for line, score in zip(text, scores, strict=True)]
        path.write_text("\n".join([head + (",score" if scores is not None else ""), *text]) + "\n")
    return paths


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    with TemporaryDirectory() as temporary:
        result = run(args, Path(temporary))
    table = Table("protocol", "frames", "boxes per frame", "seconds")
    table.add("kitti", args.kitti_frames, args.boxes, result["kitti_s"])
    table.add("sunrgbd", args.sunrgbd_frames, args.boxes, result["sunrgbd_s"])
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
