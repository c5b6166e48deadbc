"""One true box followed through a recording, with no other label and no detector; or one size for a track's boxes.

    python -m benchmarks.follow DIR [--upright | --free] [--sizes] [--json]

The first true box of each track is followed to the track's end. A frame for which no box was stored counts as 0.
`silent_errors` is the share of the stored boxes with an IoU below 0.25 whose doubt (`review_priority`) is below
`MARKED`; `marked` is the share of the stored boxes with a higher doubt.

With `--sizes`, the base detector measures each box of a track from its true 2D box, frame by frame; then all get the
size that is fitted to them (`common_size`). The mean error of a side and the mean IoU are before and after.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import box_on_image
from annotator.rcv.axes import with_axes_like
from annotator.rcv.config import RcvConfig
from annotator.recordings import Recording, open_recording
from annotator.tracking.common_size import SizedBox, common_size
from annotator.types import BoxKind, Frame, OrientedBox, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.frame_source import orientation_for
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.follow_objects import Follower
from annotator.workflows.tracks.operations import resized
from annotator.workflows.tracks.timeline import Moment
from annotator.workflows.training.held_out import lifted
from annotator.workflows.workbench.review_queue import doubt
from benchmarks.cold_start import Arguments as ColdStart
from benchmarks.cold_start import base_detector, with_up
from benchmarks.report import BoxOptions, Table, guarded, program

# A box with at least this doubt is marked for the operator.
MARKED = 0.8
WRONG_IOU = 0.25


@dataclass
class Arguments(BoxOptions):
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="dir")]
    """A recording with true 3D boxes and tracks, or with one object in each frame."""
    min_points: int = 20
    """A track begins with its first box of at least so many points."""
    sizes: bool = False
    """Fit one size to a track's boxes in place of following it."""
    base: Path | None = None
    """Weights of a base detector for --sizes; None = the one of the package."""


@dataclass
class TrackScore:
    """The result of one track: IoU and doubt of each stored box, and IoU 0 for the frames without one."""

    label: str
    ious: list[float]
    doubts: list[float]
    missing: int
    stopped_at: str | None = None
    stopped_because: str = "end of the recording"

    @property
    def all_ious(self) -> list[float]:
        return self.ious + [0.0] * self.missing


def true_tracks(recording: Recording) -> dict[tuple[str, int], dict[int, Truth]]:
    """The true boxes of each track by frame index; objects without ids are one track if no frame has two of a class."""
    tracks: dict[tuple[str, int], dict[int, Truth]] = defaultdict(dict)
    for index in range(len(recording)):
        for truth in load_truth(recording, index, recording.frame(index)):
            key = truth.label, -1 if truth.track_id is None else truth.track_id
            if truth.track_id is None and index in tracks[key]:
                raise ConfigError(f"{recording.path}: its labels have no track ids, so their tracks are unknown")
            tracks[key][index] = truth
    return tracks


def follow_track(recording: Recording, label: str, boxes: dict[int, Truth], args: Arguments) -> TrackScore | None:
    """Follows one track; None if no box has enough points, or only its last one."""
    indices = sorted(boxes)
    clouds = ((i, recording.frame(i).cloud.xyz_m) for i in indices[:-1])
    first = next((i for i, xyz_m in clouds if contains(boxes[i].box, xyz_m).sum() >= args.min_points), None)
    if first is None:
        return None

    def moment(index: int) -> Moment:
        truth = boxes.get(index, boxes[first])
        return Moment(index, with_up(recording.frame(index), [truth], args.upright), float(index))

    def settings(frame: Frame) -> RcvConfig:
        return RcvConfig(orientation=orientation_for(args.rotation, frame))

    score = TrackScore(label, [], [], 0)
    follower = Follower(moment(first), boxes[first].box, label, None, settings)
    for index in range(first + 1, indices[-1] + 1):
        followed = follower.step(moment(index))
        if followed.proposal is None:
            score.stopped_at = recording.keys[index]
            score.stopped_because = followed.stop.value if followed.stop is not None else ""
            score.stopped_because += f" ({followed.detail})" if followed.detail else ""
            break
        if index in boxes:
            score.ious.append(iou_3d(followed.proposal.box, boxes[index].box))
            score.doubts.append(doubt(followed.proposal.quality, followed.proposal.score) or 0.0)
    score.missing = sum(index > first for index in indices) - len(score.ious)
    return score


def fit_sizes(recording: Recording, args: Arguments) -> dict[str, Any]:
    """The mean error of a side and the mean IoU of each track: with the sizes of its frames, and with its own."""
    detector, view_px = base_detector(ColdStart(args.folder, base=args.base))
    config = RcvConfig(view_px=view_px).for_detector(BoxKind.BOX, True)
    found: dict[tuple[str, int], list[tuple[Truth, OrientedBox, SizedBox]]] = defaultdict(list)
    for (label, track), truths in true_tracks(recording).items():
        for index, truth in truths.items():
            frame = with_up(recording.frame(index), [truth], args.upright)
            drawn = box_on_image(frame.camera, truth.box, label)
            if drawn is None or contains(truth.box, frame.cloud.xyz_m).sum() < args.min_points:
                continue
            (box,) = lifted(frame, [drawn], detector, config, args.rotation)
            if box is not None:
                box = with_axes_like(box, truth.box)
                found[label, track].append((truth, box, SizedBox.of(box, frame.cloud.xyz_m)))
    rows = []
    for (label, _), each in sorted(found.items()):
        size_m = common_size([sized for _, _, sized in each])
        ways = [(box, resized(box, size_m.tolist())) for _, box, _ in each]
        row: dict[str, Any] = {"label": label, "frames": len(each)}
        for way, boxes in zip(("frame", "track"), zip(*ways, strict=True), strict=True):
            pairs = [(truth.box, box) for (truth, _, _), box in zip(each, boxes, strict=True)]
            row[f"side_error_m_{way}"] = float(np.mean([np.abs(box.size_m - true.size_m) for true, box in pairs]))
            row[f"mean_iou_{way}"] = float(np.mean([iou_3d(true, box) for true, box in pairs]))
        rows.append(row)
    return {"sizes": rows}


def run(args: Arguments) -> dict[str, Any]:
    recording = open_recording(args.folder)
    if args.sizes:
        return fit_sizes(recording, args)
    scores = []
    for (label, _), boxes in sorted(true_tracks(recording).items()):
        score = follow_track(recording, label, boxes, args)
        if score is not None:
            scores.append(score)
    ious = np.array([iou for score in scores for iou in score.all_ious])
    stored = np.array([iou for score in scores for iou in score.ious])
    doubts = np.array([value for score in scores for value in score.doubts])
    wrong = stored < WRONG_IOU
    return {
        "tracks": [
            {
                "label": score.label,
                "frames": len(score.all_ious),
                "mean_iou": float(np.mean(score.all_ious)),
                "share_50": float(np.mean(np.array(score.all_ious) >= 0.5)),
                "stopped_at": score.stopped_at,
                "stopped_because": score.stopped_because,
            }
            for score in scores
        ],
        "mean_iou": float(ious.mean()) if len(ious) else 0.0,
        "silent_errors": float((wrong & (doubts < MARKED)).mean()) if len(stored) else 0.0,
        "marked": float((doubts >= MARKED).mean()) if len(stored) else 0.0,
    }


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    if "sizes" in result:
        heads = ("class", "boxes", "error of a side, m: frame", "IoU", "track", "IoU")
        return [Table(*heads, rows=(row.values() for row in result["sizes"]))]
    table = Table(
        "class", "frames", "mean IoU", ">= 0.5", "stopped at", "because", rows=(r.values() for r in result["tracks"])
    )
    for name in ("mean_iou", "silent_errors", "marked"):
        table.add(name, "", result[name], "", "", "")
    return [table]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
