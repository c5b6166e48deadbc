"""Upper bound of each axes strategy: the recursion with perfect (or jittered) 2D boxes, compared with true 3D boxes.

python -m benchmarks.axes DIR [--jitter 0.02] [--upright | --free] [--json]
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from scipy.optimize import linear_sum_assignment

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.iou import iou_3d_matrix
from annotator.geometry.oriented_box import contains
from annotator.rcv.config import RcvConfig, Strategy
from annotator.rcv.propose import propose
from annotator.recordings import open_recording
from annotator.types import BoxKind, Frame, Proposal, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.frame_source import orientation_for
from annotator.workflows.recorded.reading import load_truth
from benchmarks.report import BoxOptions, Table, guarded, program, require

# A proposal is false if its IoU with every true box is below this.
FALSE_IOU = 0.1


@dataclass
class Arguments(BoxOptions):
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A recording with true 3D boxes."""
    jitter: float = 0.0
    """Standard deviation of the error of each 2D box edge, share of the view's extent."""
    min_points: int = 20
    """Objects with fewer points are skipped."""
    seed: int = 0
    """Seed of the jitter."""
    strategies: tuple[Strategy, ...] = tuple(Strategy)
    """Strategies to measure."""


@dataclass
class Tally:
    """Results of one class with one strategy; `best_ious` are those with the true box that a proposal overlaps most."""

    ious: list[float] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    best_ious: list[float] = field(default_factory=list)


def measure(
    frame: Frame, truths: Sequence[Truth], detector: PerfectDetector, config: RcvConfig, tallies: dict[str, Tally]
) -> None:
    """Runs one frame and adds its results to the tallies, by class."""
    begin = time.perf_counter()
    proposals = propose([frame], detector, detector, config)[0].proposals
    seconds_per_object = (time.perf_counter() - begin) / len(truths)
    for label in sorted({t.label for t in truths}):
        found, true = [p for p in proposals if p.label == label], [t for t in truths if t.label == label]
        ious = np.zeros(len(true))
        if found:
            overlap = iou_3d_matrix([p.box for p in found], [t.box for t in true])
            rows, columns = linear_sum_assignment(-overlap)
            ious[columns] = overlap[rows, columns]
        tallies[label].ious.extend(ious.tolist())
        tallies[label].steps.extend(len(p.trace) for p in found)
        tallies[label].seconds.extend([seconds_per_object] * len(ious))
        tallies[label].best_ious.extend(best_ious(found, true))


def best_ious(proposals: Sequence[Proposal], truths: Sequence[Truth]) -> list[float]:
    """For each proposal the IoU with the true box of its class that it overlaps most."""
    if not proposals or not truths:
        return [0.0] * len(proposals)
    return iou_3d_matrix([p.box for p in proposals], [t.box for t in truths]).max(axis=1).tolist()


def run(args: Arguments) -> dict[str, Any]:
    require(args, 0, math.inf, "jitter", "min_points", "seed")
    if not args.strategies:
        raise ConfigError(f"--strategies needs at least one of {', '.join(Strategy)}")
    recording = open_recording(args.folder)
    tallies: dict[Strategy, dict[str, Tally]] = {s: defaultdict(Tally) for s in args.strategies}
    for index in range(len(recording)):
        frame = recording.frame(index)
        xyz_m, truths = frame.cloud.xyz_m, load_truth(recording, index, frame)
        truths = [truth for truth in truths if contains(truth.box, xyz_m).sum() >= args.min_points]
        if not truths:
            continue
        detector = PerfectDetector.for_frame(frame, truths, kind=BoxKind.BOX, jitter=args.jitter, seed=args.seed)
        for strategy in args.strategies:
            config = RcvConfig(strategy=strategy, orientation=orientation_for(args.rotation, frame))
            measure(frame, truths, detector, config, tallies[strategy])
    return {
        "results": [
            {
                "label": label,
                "axes": strategy.value,
                "objects": len(tally.ious),
                "mean_iou": float(np.mean(tally.ious)),
                "share_50": float(np.mean(np.array(tally.ious) >= 0.5)),
                "share_70": float(np.mean(np.array(tally.ious) >= 0.7)),
                "false_positives": float(np.mean(np.array(tally.best_ious) < FALSE_IOU)) if tally.best_ious else 0.0,
                "steps": float(np.mean(tally.steps)) if tally.steps else 0.0,
                "ms_per_object": float(np.median(tally.seconds) * 1e3),
            }
            for strategy, by_label in tallies.items()
            for label, tally in sorted(by_label.items())
        ],
        "default_axes": RcvConfig().strategy.value,
    }


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    heads = ("class", "axes", "objects", "mean IoU", ">= 0.5", ">= 0.7", "false", "steps", "ms/object")
    return [Table(*heads, rows=(row.values() for row in result["results"]))]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
