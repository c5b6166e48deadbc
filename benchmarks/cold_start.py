"""3D boxes before anything was taught: 2D boxes on the image, the base detector, and nothing else.

    python -m benchmarks.cold_start DIR [--upright | --free] [--image-box projected|label] [--seed N] [--json]

`projected` takes the true 3D boxes' outlines, clipped to the image; `label` takes the labels' own 2D boxes, or the
extents of the masks. Both get an error of 2 px on every edge. The rows "<class> (clusters)" guess from geometry alone:
the cluster of points in the middle of the image box, and the tightest box around it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from annotator.detection.base_detector import base_weights
from annotator.detection.config import Backend
from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import box_on_image
from annotator.rcv.config import Orientation, RcvConfig, ViewConfig
from annotator.rcv.propose import propose_from_boxes
from annotator.recordings import Recording, open_recording
from annotator.types import Box2D, Detector, Frame, OrientedBox, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.detectors import load_detector
from annotator.workflows.recorded.reading import has_masks, load_mask, load_truth, own_image_box
from benchmarks.clusters import cluster_box
from benchmarks.report import Table, finish, guarded

JITTER_PX = 2.0
MIN_SIDE_PX = 2.0
LEVELS = {"recall_25": 0.25, "recall_50": 0.5, "recall_70": 0.7}


@dataclass
class Arguments:
    """Measure 3D boxes from 2D boxes on the image, with a detector that never saw the recording's classes."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A recording with true 3D boxes."""
    image_box: Literal["projected", "label"] = "projected"
    """Where the 2D boxes come from."""
    upright: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Upright boxes (default if the recording has a gravity direction)."""
    free: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Freely rotated boxes (default for other recordings)."""
    base: Path | None = None
    """Weights of a base detector; None = the one of the package."""
    min_points: int = 20
    """Objects with fewer points are skipped."""
    every: int = 1
    """Use every n-th frame."""
    seed: int = 0
    """Seed of the 2D boxes' errors."""
    backend: Backend = "auto"
    """Backend of the detector."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Given:
    """An object, and the 2D box from which it is lifted."""

    truth: Truth
    image_box: Box2D


def given_boxes(
    recording: Recording, frame: Frame, truths: Sequence[Truth], args: Arguments, rng: np.random.Generator
) -> list[Given]:
    """The objects with enough points, with their 2D boxes.

    Raises:
        ConfigError: a label has no 2D box.
    """
    mask = load_mask(recording, frame) if args.image_box == "label" and has_masks(recording) else None
    objects = []
    for number, truth in enumerate(truths):
        if args.image_box == "projected":
            box = box_on_image(frame.camera, truth.box, truth.label)
        else:
            box = own_image_box(truth, number, mask)
            if box is None and mask is None:
                raise ConfigError(f"{recording.path}: its labels have no 2D boxes; use --image-box projected")
        given = with_error(frame, truth, box, args.min_points, rng)
        if given is not None:
            objects.append(given)
    return objects


def with_error(
    frame: Frame, truth: Truth, box: Box2D | None, min_points: int, rng: np.random.Generator
) -> Given | None:
    """The object with an inaccurate 2D box; None if it has too few points, or is not on the image."""
    shift = rng.normal(0, JITTER_PX, 4)
    if contains(truth.box, frame.cloud.xyz_m).sum() < min_points or box is None:
        return None
    right, bottom = frame.camera.width_px - 0.5, frame.camera.height_px - 0.5
    x_min, y_min, x_max, y_max = np.clip(
        np.array(box.xyxy) + shift, [-0.5, -0.5, -0.5, -0.5], [right, bottom, right, bottom]
    ).tolist()
    if min(x_max - x_min, y_max - y_min) < MIN_SIDE_PX:
        return None
    return Given(truth, Box2D(truth.label, x_min, y_min, x_max, y_max))


def settings(frame: Frame, args: Arguments, size_px: int) -> RcvConfig:
    upright = args.upright or (frame.up is not None and not args.free)
    orientation = Orientation.UPRIGHT if upright else Orientation.FREE
    return RcvConfig(orientation=orientation, class_agnostic=True, view=ViewConfig(size_px=size_px))


def with_up(frame: Frame, truths: Sequence[Truth], upright: bool) -> Frame:
    """With `--upright`, a frame without a known gravity direction gets that of its first true box's third axis."""
    if not upright or frame.up is not None or not truths:
        return frame
    up = truths[0].box.rotation[:, 2]
    return replace(frame, up=up if up[1] < 0 else -up)


def lift(frame: Frame, objects: Sequence[Given], detector: Detector, config: RcvConfig) -> list[OrientedBox | None]:
    """The proposal of each 2D box, or None."""
    result = propose_from_boxes([frame], [[item.image_box for item in objects]], detector, config)[0]
    found = {id(proposal.image_box): proposal.box for proposal in result.proposals}
    return [found.get(id(item.image_box)) for item in objects]


def run(args: Arguments) -> dict[str, object]:
    """Runs the benchmark; returns what `--json` prints.

    Raises:
        ConfigError: invalid arguments.
        DetectionError: there is no base detector.
        RecordingError: the folder is not a recording.
    """
    if args.upright and args.free:
        raise ConfigError("--upright and --free contradict each other; give at most one")
    recording: Recording = open_recording(args.folder)
    detector = load_detector(args.base or base_weights(), args.backend)
    ious: dict[str, list[float]] = defaultdict(list)
    for index in range(0, len(recording), args.every):
        frame = recording.frame(index)
        truths = load_truth(recording, index, frame)
        frame = with_up(frame, truths, args.upright)
        objects = given_boxes(recording, frame, truths, args, np.random.default_rng([args.seed, index]))
        if not objects:
            continue
        config = settings(frame, args, 64)
        for item, box in zip(objects, lift(frame, objects, detector, config), strict=True):
            ious[item.truth.label].append(0.0 if box is None else iou_3d(box, item.truth.box))
        up = frame.up if config.orientation is Orientation.UPRIGHT else None
        for item in objects:
            guess = cluster_box(frame, item.image_box, up)
            ious[f"{item.truth.label} (clusters)"].append(0.0 if guess is None else iou_3d(guess, item.truth.box))
    rows = [
        {
            "label": label,
            "taught": 0,
            "objects": len(values),
            "mean_iou": float(np.mean(values)),
            **{name: float(np.mean(np.array(values) >= level)) for name, level in LEVELS.items()},
            "seconds_training": 0.0,
        }
        for label, values in sorted(ious.items())
    ]
    return {"results": rows}


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__, config=(tyro.conf.EnumChoicesFromValues,))
    result = run(args)
    table = Table("class", "taught", "objects", "mean IoU", ">= 0.25", ">= 0.5", ">= 0.7", "training s")
    for row in result["results"]:  # type: ignore[attr-defined]
        table.add(*row.values())
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
