"""Accuracy of a pseudo-view detector's boxes, and the time of its training and inference.

    python -m benchmarks.detector DIR [--model yolo11n] [--epochs N] [--upright | --free] [--json]
    python -m benchmarks.detector DIR --weights FILE --backends torch openvino onnxruntime [--json]

The detector is trained on every second frame of a recording with true 3D boxes, with the projections of those boxes on
pseudo-views along random axes, and tested on views of the other frames. The error of an edge is a share of the view's
extent in its direction, as in `benchmarks.axes --jitter`. With `--backends`, it runs on each of them; with `--weights`,
a trained detector is used.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console

from annotator.detection.config import Backend, DetectorConfig, TrainingConfig
from annotator.detection.dataset import TrainingSample, tiled, write_dataset
from annotator.detection.training import TrainingProgress, train_detector
from annotator.detection.yolo import YoloDetector
from annotator.rcv.config import RcvConfig, ViewConfig
from annotator.rcv.teach import TaughtObject, TaughtView, teach_views
from annotator.recordings import Recording, open_recording
from annotator.types import Box2D, BoxKind
from annotator.workflows.recorded.reading import load_truth
from benchmarks.detector_backends import backend_table, compared
from benchmarks.report import Table, finish, guarded

QUIET = Console(stderr=True)
BATCHES = (1, 8, 24)
REPEATS = 5


@dataclass
class Arguments:
    """Train a view detector on half of a recording, and measure it on the other half."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A recording with true 3D boxes."""
    model: str = "yolo11n"
    """Name of an ultralytics detection model; trained from random weights."""
    size: int = RcvConfig().view.size_px
    """Longer side of a view, rendered and in the network, pixels."""
    epochs: int | None = None
    """Number of epochs; default: that of TrainingConfig."""
    optimizer: str = "MuonSgd"
    """MuonSgd, AdamW (with --learning-rate 0.002) or SGD."""
    learning_rate: float = 0.01
    """Peak learning rate."""
    draws: int = 3
    """Number of random axes per object and frame; each gives two views."""
    upright: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Level views (default if the recording has a gravity direction)."""
    free: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Views along any direction (default for other recordings)."""
    seed: int = 0
    """Seed of the views and the training."""
    weights: Path | None = None
    """Weights of a trained view detector, used instead of training one."""
    backends: tuple[Backend, ...] = ()
    """Backends to compare: torch, openvino, openvino-bf16, onnxruntime; ratios are relative to the first."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def make_views(
    recording: Recording, indices: Sequence[int], args: Arguments, seed: int
) -> list[tuple[str, TaughtView]]:
    """Views of all true objects of the frames, each with the key of its frame."""
    rng, config = np.random.default_rng(seed), RcvConfig(view=ViewConfig(size_px=args.size))
    views: list[tuple[str, TaughtView]] = []
    for index in indices:
        frame = recording.frame(index)
        truths = load_truth(recording, index, frame)
        objects = [TaughtObject(truth.label, truth.box) for truth in truths]
        up = frame.up
        if up is None and args.upright and truths:
            # The third axis of an upright box is its height and can be used as the vertical direction.
            up = truths[0].box.rotation[:, 2]
        taught = teach_views(frame, objects, BoxKind.BOX, args.draws, config, None if args.free else up, rng)
        views.extend((frame.key, view) for view in taught)
    return views


def overlap(a: Box2D, b: Box2D) -> float:
    """Intersection over union of two boxes."""
    width = min(a.x_max, b.x_max) - max(a.x_min, b.x_min)
    height = min(a.y_max, b.y_max) - max(a.y_min, b.y_min)
    shared = max(width, 0.0) * max(height, 0.0)
    return shared / (a.width_px * a.height_px + b.width_px * b.height_px - shared)


def box_accuracy(views: Sequence[TaughtView], detections: Sequence[Sequence[Box2D]]) -> dict[str, float]:
    """Statistics of the IoU and the edge errors of each true box's best detection of its class."""
    ious, errors, objects = [], [], 0
    for taught, boxes in zip(views, detections, strict=True):
        height_px, width_px = taught.view.rgb.shape[:2]
        for truth in taught.boxes:
            objects += 1
            same = [box for box in boxes if box.label == truth.label]
            if not same:
                continue
            best = max(same, key=lambda box: overlap(box, truth)) if len(taught.boxes) > 1 else same[0]
            ious.append(overlap(best, truth))
            errors.append(np.subtract(best.xyxy, truth.xyxy) / np.array([width_px, height_px] * 2))
    error = np.abs(np.array(errors).reshape(-1, 4))
    if not ious:
        return {"objects": objects, "share_found": 0.0}
    return {
        "objects": objects,
        "share_found": len(ious) / objects,
        "mean_iou": float(np.mean(ious)),
        "edge_error_mean": float(error.mean()),
        "edge_error_median": float(np.median(error)),
        "edge_error_rms": float(np.sqrt((error**2).mean())),
    }


def milliseconds(detector: YoloDetector, views: Sequence[TaughtView], batch: int) -> float:
    """Milliseconds per image: the fastest of several batches after a warm-up."""
    images = [views[i % len(views)].view for i in range(batch)]
    detector.detect(images)
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        detector.detect(images)
        times.append(time.perf_counter() - begin)
    return min(times) / batch * 1e3


def report(progress: TrainingProgress) -> None:
    """Prints one line per epoch to standard error."""
    if progress.batch == 0:
        measured = "" if progress.map50_95 is None else f", mAP50-95 {progress.map50_95:.3f}"
        QUIET.print(f"epoch {progress.epoch} of {progress.epochs}, {progress.seconds:.0f} s{measured}")


def run(args: Arguments) -> dict[str, Any]:
    """Runs the benchmark; returns what `--json` prints."""
    recording = open_recording(args.folder)
    if args.weights is not None:
        return measured(
            args.weights, [view for _, view in make_views(recording, range(1, len(recording), 2), args, 1)], args
        )
    training_views = make_views(recording, range(0, len(recording), 2), args, args.seed)
    test_views = [view for _, view in make_views(recording, range(1, len(recording), 2), args, args.seed + 1)]
    classes = sorted({box.label for _, view in training_views for box in view.boxes})
    config = TrainingConfig.model_validate(
        {
            "model": args.model,
            "pretrained": "never",
            "image_size_px": args.size,
            "epochs": args.epochs,
            "optimizer": args.optimizer,
            "learning_rate": args.learning_rate,
            "free_rotation": args.free,
            "seed": args.seed,
        }
    )
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        samples = (
            TrainingSample(view.view.rgb, view.boxes, key, "projected", look_px=view.view.look_px)
            for key, view in training_views
        )
        write_dataset(folder / "set", tiled(samples, args.size), classes, kind=BoxKind.BOX)
        trained = train_detector(folder / "set", folder / "run", config, report)
        scores = measured(trained.weights, test_views, args)
    return {
        "model": args.model,
        "views_taught": len(training_views),
        "epochs": trained.epochs,
        "seconds": trained.seconds,
        **scores,
    }


def measured(weights: Path, test_views: Sequence[TaughtView], args: Arguments) -> dict[str, Any]:
    """Accuracy and inference time of a trained detector."""
    detector = YoloDetector(weights, DetectorConfig(image_size_px=args.size))
    views = [view.view for view in test_views]
    result: dict[str, Any] = {
        "views_asked": len(test_views),
        **box_accuracy(test_views, detector.detect(views)),
        "backend": detector.backend,
        "ms_per_image": {str(batch): milliseconds(detector, test_views, batch) for batch in BATCHES},
    }
    if args.backends:
        result["backends"] = compared(weights, args.size, views, args.backends)
    return result


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("measure", "value")
    for name, value in result.items():
        if name != "backends":
            table.add(name, value)
    finish(result, args.json, table, *([backend_table(result["backends"])] if "backends" in result else []))


if __name__ == "__main__":
    guarded(main)
