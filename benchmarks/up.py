"""The estimated up direction against the known one, on generated rooms and on recordings.

python -m benchmarks.up [RECORDING ...] [--rooms 8] [--snapshots 100] [--drawn 0 1 ...] [--pictures DIR] [--json]

Generated: rooms of each preset of `annotator generate`, and random arrangements as the base detector learns from,
seen by depth cameras and LiDARs. Recordings that know gravity are compared with it; of others, the estimate is shown.
A direction is proposed if it is certain enough; "right" is within 2 degrees.

With --drawn, a simulated operator (`review_operator`) draws the boxes of ten frames of each recording with free
rotation, with a hand of each seed. The axis that these boxes share is compared with gravity, or with the axis that the
true boxes share.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import tyro

from annotator.geometry.oriented_box import common_axis
from annotator.geometry.projection import project as projected
from annotator.geometry.up_direction import UpEstimate, estimate_up
from annotator.project import BoxRotation
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.synthetic.snapshots import snapshot
from annotator.synthetic.writer import PRESETS
from annotator.types import Frame, OrientedBox
from annotator.types.errors import FrameError
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.recorded.up_direction import (
    LEAST_CERTAINTY,
    MOST_BOXES,
    MOST_FRAMES,
    agreed_up,
    up_of_boxes,
)
from annotator.workflows.workbench.review_queue import Order, queue
from benchmarks.report import Table, finish, guarded
from benchmarks.review_operator import Operator
from benchmarks.review_projects import TAUGHT_FRAMES, unlabelled

RIGHT_DEG = 2.0
# Of the drawn boxes: 3D IoU from which one is right, and the hand's error in pixels.
QUALITY, ERROR_PX = 0.7, 2.0
# Not used in training.
VERSION = 7


@dataclass
class Arguments:
    """Measure the estimate of the up direction."""

    recordings: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Recordings to estimate, too."""
    rooms: int = 8
    """Generated rooms of each preset."""
    snapshots: int = 100
    """Generated random arrangements."""
    drawn: tuple[int, ...] = ()
    """Seeds of the hand that draws boxes in the recordings, which must have true boxes."""
    pictures: Path | None = None
    """Folder for a picture of the level on each recording's frames."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def generated(preset: str, rooms: int) -> Iterator[Frame]:
    """One frame of each room of a preset."""
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(rooms):
            path = Path(folder) / str(seed)
            write_generated(path, preset, 1, seed)
            yield open_recording(path).frame(0)


def arrangements(count: int, *, lidar: bool) -> Iterator[Frame]:
    """Random arrangements, seen by a LiDAR or by a depth camera."""
    for seed in range(count):
        frame = snapshot(seed, VERSION).frame
        if len(frame.cloud) and (frame.depth_m is None) == lidar:
            yield frame


def scored(frames: Iterator[Frame]) -> dict[str, Any]:
    """Counts and errors (degrees) of the estimates for single frames that know their up direction."""
    errors, certainties = [], []
    for frame in frames:
        found = estimate_up(frame)
        errors.append(180.0 if found is None else _error_deg(found, frame))
        certainties.append(0.0 if found is None else found.certainty)
    proposed = np.array(certainties) >= LEAST_CERTAINTY
    of_proposed = np.array(errors)[proposed]
    return {
        "frames": len(errors),
        "proposed": int(proposed.sum()),
        "right": int((of_proposed < RIGHT_DEG).sum()),
        "median_deg": float(np.median(of_proposed)) if len(of_proposed) else None,
        "worst_deg": float(of_proposed.max()) if len(of_proposed) else None,
        "refused_though_right": int((np.array(errors)[~proposed] < RIGHT_DEG).sum()),
    }


def of_recording(path: Path, pictures: Path | None) -> dict[str, Any]:
    """The estimate for a recording, and its frames' errors if they know gravity."""
    recording = open_recording(path)
    picked = np.linspace(0, len(recording) - 1, min(MOST_FRAMES, len(recording))).round().astype(int)
    estimates, errors = [], []
    for index in sorted(set(picked.tolist())):
        try:
            frame = recording.frame(index)
        except FrameError:
            continue
        found = estimate_up(frame)
        estimates.append(found)
        if found is not None and frame.up is not None:
            errors.append(_error_deg(found, frame))
        if found is not None and pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            name = f"{path.parent.name}_{path.name}_{frame.key}.jpg"
            cv2.imwrite(str(pictures / name), with_level(frame, found)[..., ::-1])
    agreed = agreed_up(estimates)
    return {
        "recording": f"{path.parent.name}/{path.name}",
        "certainty_by_frame": [None if each is None else round(each.certainty, 3) for each in estimates],
        "error_deg_by_frame": [round(each, 2) for each in errors],
        "up": agreed.up,
        "certainty": agreed.certainty,
        "reason": agreed.reason,
    }


def of_drawn(path: Path, seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
    """What boxes tell that are drawn with free rotation on ten frames, by each hand."""
    recording = open_recording(path)
    true = [
        truth.box for index in range(len(recording)) for truth in load_truth(recording, index, recording.frame(index))
    ]
    gravity = recording.frame(0).up
    expected = common_axis(_rotations(true[:: max(1, len(true) // 60)])).axis if gravity is None else gravity
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder, unlabelled(path, Path(folder), BoxRotation.FREE) as project:
            frames = [item.frame for item in queue(project, Order.TEACH, most=TAUGHT_FRAMES).items]
            frames.sort(key=lambda frame: frame.index or 0)
            Operator(project, frames, QUALITY, ERROR_PX, seed).review(False)
            boxes = project.labels.recent_boxes(MOST_BOXES)
        shared, found = common_axis(_rotations([each.box for each in boxes])), up_of_boxes(boxes)
        yield {
            "recording": path.name,
            "seed": seed,
            "boxes": len(boxes),
            "spread_deg": float(np.degrees(shared.spread_rad)),
            "alike": shared.alike,
            "error_deg": float(np.degrees(np.arccos(min(1.0, abs(shared.axis @ expected))))),
            "proposed": found is not None,
        }


def _rotations(boxes: Sequence[OrientedBox]) -> np.ndarray:
    return np.stack([box.pose[:3, :3] for box in boxes])


def with_level(frame: Frame, found: UpEstimate) -> np.ndarray:
    """The image with a level grid below the camera's optical axis, and plumb lines on some points."""
    picture = frame.rgb.copy()
    near_m = float(np.median(np.linalg.norm(frame.cloud.xyz_m, axis=1)))
    ahead = np.array([0.0, 0.0, 1.0]) - found.up[2] * found.up
    ahead /= np.linalg.norm(ahead)
    aside = np.cross(ahead, found.up)
    steps = np.linspace(-1, 1, 9)
    center = near_m * ahead - 0.5 * near_m * found.up
    lines = [center + near_m * (s * ahead + np.linspace(-1, 1, 60)[:, None] * aside) for s in steps]
    lines += [center + near_m * (s * aside + np.linspace(-1, 1, 60)[:, None] * ahead) for s in steps]
    for point in frame.cloud.xyz_m[:: max(1, len(frame.cloud) // 40)]:
        lines.append(point + 0.08 * near_m * np.linspace(0, 1, 10)[:, None] * found.up)
    colour = (0, 255, 0) if found.certainty >= LEAST_CERTAINTY else (255, 60, 0)
    for line in lines:
        px = projected(frame.camera, line)
        px = px[np.isfinite(px).all(axis=1) & (np.abs(px) < 1e4).all(axis=1)]
        cv2.polylines(picture, [px.round().astype(np.int32)], False, colour, 1, cv2.LINE_AA)
    cv2.putText(picture, f"{found.certainty:.2f}", (8, 28), cv2.FONT_HERSHEY_SIMPLEX, 1, colour, 2)
    return picture


def _error_deg(found: UpEstimate, frame: Frame) -> float:
    assert frame.up is not None  # of frames that know gravity
    return float(np.degrees(np.arccos(np.clip(found.up @ frame.up, -1, 1))))


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    groups = {preset: scored(generated(preset, arguments.rooms)) for preset in PRESETS}
    groups["arrangements, depth camera"] = scored(arrangements(arguments.snapshots, lidar=False))
    groups["arrangements, LiDAR"] = scored(arrangements(arguments.snapshots, lidar=True))
    recordings = [of_recording(path, arguments.pictures) for path in arguments.recordings]
    drawn = (
        [each for path in arguments.recordings for each in of_drawn(path, arguments.drawn)] if arguments.drawn else []
    )
    table = Table("generated", *next(iter(groups.values())))
    for name, row in groups.items():
        table.add(name, *row.values())
    listed = Table("recording", "certainty", "errors", "up, or why not")
    for each in recordings:
        up = each["reason"] if each["up"] is None else " ".join(f"{x:.3f}" for x in each["up"])
        listed.add(each["recording"], f"{each['certainty']:.2f}", str(each["error_deg_by_frame"]), up)
    by_hand = Table("drawn in", "seed", "boxes", "spread, degrees", "alike", "error, degrees", "proposed")
    for each in drawn:
        by_hand.add(*each.values())
    shown = (table, listed, by_hand) if drawn else (table, listed)
    finish({"generated": groups, "recordings": recordings, "drawn": drawn}, arguments.json, *shown)


if __name__ == "__main__":
    guarded(main)
