"""Whether a detector's expected edge errors make better boxes, and whether the doubt finds the wrong ones.

    python -m benchmarks.uncertainty DIR [--upright | --free] [--base FILE] [--json]
    python -m benchmarks.uncertainty --generated N [--base FILE] [--json]

2D boxes on the image are given, as in `benchmarks.cold_start`; the base detector measures the objects. Boxes are
proposed without and with the expected errors of edges. A box with an IoU below 0.5 is wrong. The last columns order the
boxes in three ways; each is the share of wrong boxes in the first tenth.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from annotator.detection.config import Backend
from annotator.geometry.iou import iou_3d
from annotator.geometry.outline import box_on_image
from annotator.rcv.config import RcvConfig
from annotator.rcv.propose import propose_from_boxes
from annotator.recordings import open_recording
from annotator.synthetic.snapshots import snapshot
from annotator.types import Detector, Frame, Proposal, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.workbench.review_queue import doubt
from benchmarks import cold_start
from benchmarks.report import Table, finish, guarded

WRONG = 0.5
# Seeds of generated frames; far from those that a base detector is trained on.
FIRST_SEED = 900_000


@dataclass
class Arguments:
    """Measure boxes with and without the expected errors of edges, and how well the doubt finds wrong boxes."""

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(name="dir")] = None
    """A recording with true 3D boxes."""
    generated: int | None = None
    """Number of generated frames to use in place of a recording."""
    upright: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Upright boxes (default if the recording has a gravity direction)."""
    free: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Freely rotated boxes (default for other recordings)."""
    base: Path | None = None
    """Weights of a base detector; None = the one of the package."""
    seed: int = 0
    """Seed of the 2D boxes' errors."""
    backend: Backend = "auto"
    """Backend of the detector."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True, eq=False)
class Scored:
    """A proposal and its IoU with the true box."""

    proposal: Proposal
    iou: float


def frames(args: Arguments, base: cold_start.BaseDetector) -> Iterator[tuple[Frame, list[cold_start.Given], RcvConfig]]:
    """The frames, their given 2D boxes, and the settings.

    Raises:
        ConfigError: neither a recording nor a number of frames, or both; or contradicting rotations.
        RecordingError: the folder is not a recording.
    """
    if (args.folder is None) == (args.generated is None):
        raise ConfigError("give either the folder of a recording or --generated N")
    given = cold_start.Arguments(args.folder or Path(), upright=args.upright, free=args.free or args.folder is None)
    if args.folder is None:
        for seed in range(FIRST_SEED, FIRST_SEED + (args.generated or 0)):
            shot = snapshot(seed)
            rng = np.random.default_rng([args.seed, seed])
            drawn = [
                cold_start.given(
                    shot.frame,
                    Truth("object", item.box),
                    box_on_image(shot.frame.camera, item.box, "object"),
                    number,
                    given.min_points,
                    rng,
                )
                for number, item in enumerate(shot.objects)
            ]
            objects = [item for item in drawn if item is not None]
            yield shot.frame, objects, base.settings(shot.frame)
        return
    recording = open_recording(args.folder)
    for index in range(len(recording)):
        frame = recording.frame(index)
        truths = load_truth(recording, index, frame)
        frame = cold_start.with_up(frame, truths, args.upright)
        random = np.random.default_rng([args.seed, index])
        yield frame, list(cold_start.given_boxes(recording, frame, truths, given, random)), base.settings(frame)


def proposed(
    frame: Frame, objects: Sequence[cold_start.Given], detector: Detector, config: RcvConfig
) -> list[Scored | None]:
    """The proposal of each 2D box, or None."""
    result = propose_from_boxes([frame], [[item.image_box for item in objects]], detector, config)[0]
    found = {id(proposal.image_box): proposal for proposal in result.proposals}
    scored: list[Scored | None] = []
    for item in objects:
        proposal = found.get(id(item.image_box))
        scored.append(None if proposal is None else Scored(proposal, iou_3d(proposal.box, item.truth.box)))
    return scored


def wrong_first(scored: Sequence[Scored]) -> dict[str, float]:
    """The share of wrong boxes among the tenth that each order puts first."""
    orders: dict[str, list[float]] = {"before": [], "doubt": [], "expected_loss": []}
    for item in scored:
        quality, score = item.proposal.quality, item.proposal.score
        orders["before"].append(doubt(replace(quality, expected_iou_loss=None), score) or 0.0)
        orders["doubt"].append(doubt(quality, score) or 0.0)
        orders["expected_loss"].append(1.0 if quality.expected_iou_loss is None else quality.expected_iou_loss)
    wrong = np.array([item.iou < WRONG for item in scored])
    count = max(len(scored) // 10, 1)
    return {
        name: float(wrong[np.argsort(-np.array(values), kind="stable")[:count]].mean()) if len(scored) else np.nan
        for name, values in orders.items()
    }


def run(args: Arguments) -> dict[str, object]:
    """Runs the benchmark; returns what `--json` prints.

    Raises:
        AnnotatorError: as `frames`; or there is no base detector.
    """
    base = cold_start.BaseDetector.load(args.base, args.backend, args.upright, args.free or args.folder is None)
    found: dict[tuple[bool, str], list[Scored | None]] = defaultdict(list)
    for frame, objects, config in frames(args, base):
        for uses in (False, True) if objects else ():
            fit = config.fit.model_copy(update={"use_edge_errors": uses})
            scored = proposed(frame, objects, base.detector, config.model_copy(update={"fit": fit}))
            for given, item in zip(objects, scored, strict=True):
                found[uses, given.truth.label].append(item)
    labels = sorted({label for _, label in found})
    return {"results": [_row(uses, {label: found[uses, label] for label in labels}) for uses in (False, True)]}


def _row(uses: bool, by_class: dict[str, list[Scored | None]]) -> dict[str, object]:
    """The figures of all objects, without or with the expected errors."""
    ious = {label: [0.0 if item is None else item.iou for item in items] for label, items in by_class.items()}
    every = np.array([iou for values in ious.values() for iou in values])
    scored = [item for items in by_class.values() for item in items if item is not None]
    losses = [item.proposal.quality.expected_iou_loss for item in scored]
    return {
        "edge_errors": uses,
        "objects": len(every),
        "mean_iou": float(every.mean()) if len(every) else np.nan,
        "recall_50": float((every >= WRONG).mean()) if len(every) else np.nan,
        "mean_iou_by_class": {label: float(np.mean(values)) for label, values in ious.items()},
        "expected_iou": 1 - float(np.mean([1.0 if loss is None else loss for loss in losses])) if scored else np.nan,
        "wrong": float(np.mean([item.iou < WRONG for item in scored])) if scored else np.nan,
        "wrong_in_first_tenth": wrong_first(scored),
    }


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    heads = ("edge errors", "objects", "mean IoU", ">= 0.5", "expected IoU", "wrong", "first: before", "doubt", "fit")
    table = Table(*heads)
    for row in result["results"]:  # type: ignore[attr-defined]
        figures = (row["mean_iou"], row["recall_50"], row["expected_iou"], row["wrong"])
        table.add(row["edge_errors"], row["objects"], *figures, *row["wrong_in_first_tenth"].values())
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
