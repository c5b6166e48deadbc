"""Time to list the frames of whole data sets, without reading a frame.

python -m benchmarks.listing [--share 1] [--repeats 5] [--json]

The data sets are temporary folders of empty files, with the same file names and numbers of files as the real ones:
KITTI's object training set, SUN RGB-D as downloaded (scenes in folders by camera) and as extracted by VoteNet.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro

from annotator.recordings import open_recording
from annotator.types.errors import ConfigError
from benchmarks.report import Table, finish, guarded

KITTI_FRAMES = 7_481
# Number of scenes of SUN RGB-D by folder (SUNRGBD/CAMERA/PART/SCENE).
SUN_SCENES = {
    "kv1/NYUdata": 1_449,
    "kv1/b3dodata": 554,
    "kv2/kinect2data": 1_000,
    "kv2/align_kv2": 2_784,
    "realsense/lg": 609,
    "realsense/sa": 550,
    "xtion/xtion_align_data": 1_030,
    "xtion/sun3ddata": 2_359,
}
# The files of a scene that the reader needs.
SCENE_FILES = (
    "intrinsics.txt",
    "image/a.jpg",
    "depth/a.png",
    "depth_bfx/a.png",
    "extrinsics/20151101.txt",
    "annotation3Dfinal/index.json",
)


@dataclass
class Arguments:
    """Time the listing of each data set."""

    share: float = 1.0
    """Share of each data set's frames to create."""
    repeats: int = 5
    """Number of listings of each data set; the median is reported."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def make_kitti(folder: Path, share: float) -> Path:
    """Creates KITTI's object training set with this share of its frames; returns its root."""
    names = {"image_2": "png", "velodyne": "bin", "calib": "txt", "label_2": "txt"}
    return _make_folders(folder / "kitti" / "training", names, range(_part(KITTI_FRAMES, share))).parent


def make_extracted(folder: Path, share: float) -> Path:
    """Creates VoteNet's `sunrgbd_trainval` with this share of its frames; returns its root."""
    names = {"image": "jpg", "depth": "mat", "calib": "txt", "label": "txt"}
    numbers = range(1, 1 + _part(sum(SUN_SCENES.values()), share))
    return _make_folders(folder / "sunrgbd_trainval", names, numbers)


def make_scenes(folder: Path, share: float) -> Path:
    """Creates SUN RGB-D as downloaded with this share of its scenes; returns its root."""
    root = folder / "SUNRGBD"
    for place, count in SUN_SCENES.items():
        for number in range(_part(count, share)):
            scene = root / place / f"2014-12-19_15-53-20_{number:012d}"
            for name in SCENE_FILES:
                file = scene / name
                file.parent.mkdir(parents=True, exist_ok=True)
                file.touch()
    return root


def _make_folders(root: Path, names: dict[str, str], numbers: range) -> Path:
    for name, suffix in names.items():
        (root / name).mkdir(parents=True)
        for number in numbers:
            (root / name / f"{number:06d}.{suffix}").touch()
    return root


def _part(count: int, share: float) -> int:
    return max(round(count * share), 1)


SETS: dict[str, Callable[[Path, float], Path]] = {
    "kitti_object": make_kitti,
    "sunrgbd_scenes": make_scenes,
    "sunrgbd_extracted": make_extracted,
}


def run(args: Arguments) -> dict[str, object]:
    """Runs the benchmark; returns what `--json` prints: frames and milliseconds by data set.

    Raises:
        ConfigError: a number is out of its range.
    """
    if not 0 < args.share <= 1 or not 1 <= args.repeats <= 1000:
        raise ConfigError("--share must be above 0 and at most 1, --repeats 1 to 1000")
    result: dict[str, object] = {}
    for name, make in SETS.items():
        with TemporaryDirectory() as folder:
            root = make(Path(folder), args.share)
            seconds, busy_seconds = [], []
            for _ in range(args.repeats):
                begin, busy = time.perf_counter(), time.process_time()
                recording = open_recording(root)
                seconds.append(time.perf_counter() - begin)
                busy_seconds.append(time.process_time() - busy)
            result[name] = {
                "format": recording.format,
                "frames": len(recording),
                "first_ms": seconds[0] * 1e3,
                "median_ms": statistics.median(seconds) * 1e3,
                "median_processor_ms": statistics.median(busy_seconds) * 1e3,
            }
    return result


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("data set", "recognised as", "frames", "first listing, ms", "median, ms", "median CPU time, ms")
    for name, row in result.items():
        assert isinstance(row, dict)
        table.add(name, *row.values())
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
