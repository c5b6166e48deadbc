"""Quality of the tracks that linking finds, compared with the true tracks.

python -m benchmarks.tracks RECORDING [--json]

The true boxes of a recording are linked without their ids: unchanged, and with Gaussian noise on every centre, side and
angle (`CASES`: as a share of the side, and the same number as an angle in radians), with and without missing boxes.

IDF1 and id switches are defined as in MOTChallenge: IDF1 = 2 IDTP / (true + linked boxes) with the assignment of whole
tracks that maximises it (Ristani et al., Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking,
2016). A switch is counted if the id of a true object differs from its id in the previous frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d_pairs
from annotator.recordings import open_recording
from annotator.recordings.kitti import KittiFolder
from annotator.tracking.config import TrackingConfig
from annotator.tracking.link import Seen, link
from annotator.tracking.motion import frame_times
from annotator.tracking.relabel import relabelled
from annotator.tracking.smooth import FLIP, TrackBox, smoothed
from annotator.types import OrientedBox, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.recorded.reading import load_truth
from benchmarks.report import Table, finish, guarded

# By case: the standard deviation of the noise, and the share of boxes that is missing.
CASES = {
    "true boxes": (0.0, 0.0),
    "2 % off": (0.02, 0.0),
    "10 % off": (0.1, 0.0),
    "2 % off, a fifth missing": (0.02, 0.2),
}
# Share of the noisy boxes whose heading is reversed.
FLIPPED = 0.3


@dataclass
class Arguments:
    """Link the true boxes of a recording, and compare the tracks with the true ones."""

    recording: tyro.conf.Positional[Path]
    """A recording whose labels have track ids."""
    seed: int = 0
    """Seed of the noise."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Measured:
    """Results of one case.

    Attributes:
        boxes, tracks, found: number of true boxes, of true tracks and of tracks found.
        idf1: IDF1, 0..1.
        switches: number of id switches.
        iou, smoothed_iou: mean exact 3D IoU of the boxes with the true ones, before and after smoothing.
        flipped, smoothed_flipped: number of boxes with a reversed heading, before and after smoothing.
    """

    boxes: int
    tracks: int
    found: int
    idf1: float
    switches: int
    iou: float
    smoothed_iou: float
    flipped: int
    smoothed_flipped: int


def measure(
    frames: Sequence[Sequence[Truth]], times: Sequence[float], is_still: bool, noise: float, missing: float, seed: int
) -> Measured:
    """Measures one case of one recording. Every true box needs a track id. `is_still` as in `smoothed`."""
    rng = np.random.default_rng(seed)
    visible = [[truth for truth in frame if rng.random() >= missing] for frame in frames]
    boxes_by_frame = [[Seen(truth.label, add_noise(truth.box, noise, rng)) for truth in frame] for frame in visible]
    tracks = link(boxes_by_frame, times, TrackingConfig())
    ids = {member: number for number, track in enumerate(tracks) for member in track.members}
    true = {(p, n): truth.track_id or 0 for p, frame in enumerate(visible) for n, truth in enumerate(frame)}
    smooth: dict[tuple[int, int], OrientedBox] = {}
    for track in tracks:
        boxes = [TrackBox(time, box) for time, box in zip(track.times, track.boxes, strict=True)]
        smooth |= dict(zip(track.members, smoothed(boxes, TrackingConfig(), is_still), strict=True))
    members = sorted(true)
    truths = [visible[place][number].box for place, number in members]
    before, after = (
        [boxes_by_frame[place][number].box for place, number in members],
        [smooth[member] for member in members],
    )
    return Measured(
        len(true),
        len(set(true.values())),
        len(tracks),
        idf1([true[member] for member in members], [ids[member] for member in members]),
        switches(members, true, ids),
        float(iou_3d_pairs(before, truths).mean()),
        float(iou_3d_pairs(after, truths).mean()),
        _flipped(before, truths),
        _flipped(after, truths),
    )


def add_noise(box: OrientedBox, noise: float, rng: np.random.Generator) -> OrientedBox:
    """The box with noise on centre, size and yaw, and with probability `FLIPPED` a reversed heading."""
    if noise == 0:
        return box
    center = box.center_m + box.rotation @ (noise * box.size_m * rng.standard_normal(3))
    turn = Rotation.from_rotvec([0.0, 0.0, noise * rng.standard_normal()]).as_matrix()
    size = box.size_m * np.exp(noise * rng.standard_normal(3))
    noisy = OrientedBox.from_parts(center, box.rotation @ turn, size)
    return relabelled(noisy, FLIP) if rng.random() < FLIPPED else noisy


def idf1(true: Sequence[int], linked: Sequence[int]) -> float:
    """IDF1 from the true id and the id after linking of each box; every true box is matched."""
    rows, columns = (np.unique(ids, return_inverse=True)[1] for ids in (true, linked))
    together = np.zeros((rows.max() + 1, columns.max() + 1))
    np.add.at(together, (rows, columns), 1)
    assignment = linear_sum_assignment(-together)
    return float(2 * together[assignment].sum() / (len(true) + len(linked)))


def switches(
    members: Sequence[tuple[int, int]], true: dict[tuple[int, int], int], linked: dict[tuple[int, int], int]
) -> int:
    """Number of times that the id of a true object changes between its frames; `members` in order of time."""
    last: dict[int, int] = {}
    count = 0
    for member in members:
        count += last.get(true[member], linked[member]) != linked[member]
        last[true[member]] = linked[member]
    return count


def _flipped(boxes: Sequence[OrientedBox], truths: Sequence[OrientedBox]) -> int:
    return sum(bool(a.rotation[:, 0] @ b.rotation[:, 0] < 0) for a, b in zip(boxes, truths, strict=True))


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    recording = open_recording(arguments.recording)
    frames, times_ns = list[list[Truth]](), list[int | None]()
    for index in range(len(recording)):
        frame = recording.frame(index)
        frames.append(load_truth(recording, index, frame))
        times_ns.append(frame.timestamp_ns)
    if any(truth.track_id is None for objects in frames for truth in objects):
        raise ConfigError(f"{arguments.recording}: some labels have no track ids")
    times = frame_times(times_ns).tolist()
    is_still = not isinstance(recording, KittiFolder)
    heads = ("boxes", "tracks", "found", "IDF1", "switches", "IoU", "smoothed", "flipped", "flipped, smoothed")
    table = Table("case", *heads)
    figures = {}
    for name, (noise, missing) in CASES.items():
        case = measure(frames, times, is_still, noise, missing, arguments.seed)
        figures[name] = vars(case)
        shares = (f"{case.idf1:.3f}", case.switches, f"{case.iou:.3f}", f"{case.smoothed_iou:.3f}")
        table.add(name, case.boxes, case.tracks, case.found, *shares, case.flipped, case.smoothed_flipped)
    finish(figures, arguments.json, table)


if __name__ == "__main__":
    guarded(main)
