"""Opening a large bag, reading its frames, and the memory that this takes, in a process of its own.

python -m benchmarks.bags [--gigabytes 2] [--container ros1] [--compression lz4] [--json]

The bag is made in a temporary folder: images of 1920 x 1080 px and scans of 120,000 points at 10 Hz, tf of a moving rig
at 100 Hz and an IMU at 200 Hz. It is removed from the system's file cache before it is opened.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import resource
import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

import numpy as np
import tyro
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.types.errors import ConfigError
from benchmarks.bag_writer import SECOND, BagWriter, structured
from benchmarks.report import Table, finish, guarded

WIDTH, HEIGHT, POINTS = 1920, 1080, 120_000
MATRIX = np.array([[1000.0, 0, WIDTH / 2], [0, 1000, HEIGHT / 2], [0, 0, 1]])
# x forward, y left, z up to x right, y down, z forward
CAMERA_IN_BASE = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
START_NS = 1_700_000_000 * SECOND
PERIOD_NS, LATE_NS = SECOND // 10, SECOND // 200


@dataclass
class Arguments:
    """Measure the opening of a bag and the reading of its frames."""

    gigabytes: float = 2.0
    """Size of the messages of the bag, in 10^9 bytes."""
    container: Literal["ros1", "sqlite3", "mcap"] = "ros1"
    """Format of the bag."""
    compression: Literal["", "lz4", "bz2", "message", "storage"] = ""
    """Compression: lz4 or bz2 (ros1), message (sqlite3, mcap: zstd) or storage (mcap: zstd); "" = none."""
    frames: int = 60
    """Number of frames to read, in random order."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Measured:
    """What one process measured.

    Attributes:
        frames: in the bag.
        open_s, open_again_s: the time to open it, and in the same process once more.
        frame_s: the time of each frame that was read.
        imported_mb, peak_mb: resident memory before the bag was opened, and the peak.
    """

    frames: int
    open_s: float
    open_again_s: float
    frame_s: list[float]
    imported_mb: float
    peak_mb: float


def make_bag(folder: Path, args: Arguments) -> Path:
    """Writes the bag and returns its path."""
    random = np.random.default_rng(0)
    # half of the picture is noise: it compresses to about half
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[: HEIGHT // 2] = random.integers(0, 256, (HEIGHT // 2, WIDTH, 3))
    angle, slope = random.uniform(-np.pi, np.pi, POINTS), random.uniform(-0.4, 0.1, POINTS)
    range_m = random.uniform(3, 60, POINTS)
    columns = {"x": range_m * np.cos(angle), "y": range_m * np.sin(angle), "z": range_m * slope}
    columns = {name: values.astype(np.float32) for name, values in columns.items()}
    columns |= {"intensity": random.uniform(0, 255, POINTS).astype(np.float32), "ring": np.zeros(POINTS, np.uint16)}
    points = structured(columns)
    frames = math.ceil(args.gigabytes * 1e9 / (picture.nbytes + points.nbytes))
    level = RigidTransform.from_translation([0.3, 0.0, 1.6]) * RigidTransform.from_rotation(CAMERA_IN_BASE)
    with BagWriter(folder, args.container, args.compression) as bag:
        bag.transform("/tf_static", START_NS, "base", "lidar", RigidTransform.from_translation([0.0, 0.0, 1.8]))
        bag.transform("/tf_static", START_NS, "base", "camera", level)
        for i in range(frames):
            time_ns = START_NS + i * PERIOD_NS
            for part in range(10):
                at_ns = time_ns + part * PERIOD_NS // 10
                moved = RigidTransform.from_translation([i + part / 10, 0.0, 0.0])
                bag.transform("/tf", at_ns, "odom", "base", moved)
                bag.imu("/imu", at_ns, (0.0, 0.0, 9.81), "base")
                bag.imu("/imu", at_ns + PERIOD_NS // 20, (0.0, 0.0, 9.81), "base")
            # drivers log a message some milliseconds after its time
            bag.cloud("/lidar/points", time_ns, points, log_ns=time_ns + LATE_NS)
            picture[0, 0] = i % 256
            image_ns = time_ns + SECOND // 50
            bag.info("/camera/camera_info", image_ns, (WIDTH, HEIGHT), MATRIX)
            bag.image("/camera/image_raw", image_ns, picture, "bgr8", log_ns=image_ns + LATE_NS)
    return bag.path


def forget(path: Path) -> None:
    """Writes the files to disk and removes them from the system's cache, where it allows that."""
    for file in [path] if path.is_file() else sorted(path.iterdir()):
        with file.open("rb") as opened:
            os.fsync(opened.fileno())
            if hasattr(os, "posix_fadvise"):
                os.posix_fadvise(opened.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def measure(path: Path, count: int) -> Measured:
    """Opens the bag and reads `count` frames in random order; runs in a process of its own."""
    from annotator.recordings import open_recording
    from annotator.recordings.ros import messages, recording  # noqa: F401 - not part of the time

    messages._typestore("std_msgs/Header", "", b"")
    imported_mb = _peak_mb()
    started = time.perf_counter()
    opened = open_recording(path)
    open_s = time.perf_counter() - started
    started = time.perf_counter()
    open_recording(path)
    open_again_s = time.perf_counter() - started
    order = np.random.default_rng(1).permutation(len(opened))[:count]
    frame_s = []
    for i in order.tolist():
        started = time.perf_counter()
        opened.frame(i)
        frame_s.append(time.perf_counter() - started)
    return Measured(len(opened), open_s, open_again_s, frame_s, imported_mb, _peak_mb())


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Runs the benchmark."""
    args = tyro.cli(Arguments)
    valid = {"ros1": ("", "lz4", "bz2"), "sqlite3": ("", "message"), "mcap": ("", "message", "storage")}
    if args.compression not in valid[args.container]:
        raise ConfigError(
            f"{args.container} has no compression {args.compression!r}; choose of {valid[args.container]}"
        )
    with TemporaryDirectory() as folder:
        free = shutil.disk_usage(folder).free
        if free < args.gigabytes * 1.2e9:
            raise ConfigError(f"{folder}: {free / 1e9:.1f} GB are free; the bag needs {args.gigabytes:g} GB")
        path = make_bag(Path(folder), args)
        files = [path] if path.is_file() else list(path.iterdir())
        size = sum(file.stat().st_size for file in files)
        forget(path)
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            measured = pool.submit(measure, path, args.frames).result()
    times = np.array(measured.frame_s)
    table = Table("bag", "GB", "frames", "open, s", "again, s", "frame, s", "95 %, s", "peak, MB", "of it imports, MB")
    name = f"{args.container} {args.compression}".strip()
    median, p95 = float(np.median(times)), float(np.percentile(times, 95))
    table.add(name, size / 1e9, measured.frames, measured.open_s, measured.open_again_s, median, p95,
              measured.peak_mb, measured.imported_mb)  # fmt: skip
    result = {
        "bag": name, "bytes": size, "frames": measured.frames, "open_s": measured.open_s,
        "open_again_s": measured.open_again_s, "frame_median_s": median, "frame_p95_s": p95,
        "peak_mb": measured.peak_mb, "imported_mb": measured.imported_mb,
    }  # fmt: skip
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
