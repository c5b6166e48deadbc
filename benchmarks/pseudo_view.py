"""Time to render the front and side view of a frustum, for 5,000 to 500,000 points.

OMP_NUM_THREADS=1 python -m benchmarks.pseudo_view [--json]
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from annotator.rcv.config import ViewConfig
from annotator.rcv.pseudo_view import render_pairs
from annotator.types import PointCloud
from annotator.types.errors import ConfigError
from benchmarks.report import Table, finish, guarded


@dataclass
class Arguments:
    """Time the rendering of one pair of pseudo-views."""

    points: tuple[int, ...] = (5_000, 20_000, 50_000, 200_000, 500_000)
    """Numbers of points of the cloud."""
    size_px: tuple[int, ...] = (64, 224, 320)
    """Longer sides of the views, pixels."""
    repeats: int = 30
    """Number of runs of each; the median is printed."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def frustum(points: int, rng: np.random.Generator) -> PointCloud:
    """A coloured cloud as from a depth camera: a wavy surface two metres away, in pixel order."""
    side = int(np.ceil(np.sqrt(points)))
    v, u = np.divmod(np.arange(points), side)
    x, y = (u / side - 0.5) * 1.2, (v / side - 0.5) * 1.2
    z = 2.0 + 0.2 * np.sin(6 * x) * np.cos(5 * y) + rng.normal(0, 0.003, points)
    return PointCloud(np.stack([x, y, z], axis=1).astype(np.float32), rng.integers(0, 255, (points, 3), np.uint8))


def check(args: Arguments) -> None:
    """
    Raises:
        ConfigError: a number out of its range.
    """
    for flag, values, low, high in (
        ("--points", args.points, 1, 100_000_000),
        ("--size-px", args.size_px, 32, 2048),
        ("--repeats", (args.repeats,), 1, 1_000_000),
    ):
        wrong = next((value for value in values if not low <= value <= high), None)
        if not values or wrong is not None:
            raise ConfigError(f"{flag} must be {low} to {high}, not {'empty' if wrong is None else wrong}")


def run(args: Arguments) -> dict[str, object]:
    """Runs the benchmark; returns what `--json` prints.

    Raises:
        ConfigError: as `check`.
    """
    check(args)
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    axes = Rotation.from_rotvec([0.2, 0.4, 0.1]).as_matrix()
    rows: list[dict[str, object]] = []
    for points in args.points:
        cloud = frustum(points, rng)
        for size_px in args.size_px:
            config = ViewConfig(size_px=size_px)
            seconds = []
            for _ in range(args.repeats):
                begin = time.perf_counter()
                render_pairs(cloud, [axes], config)
                seconds.append(time.perf_counter() - begin)
            rows.append({"points": points, "size_px": size_px, "ms": float(np.median(seconds) * 1e3)})
    return {"results": rows}


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("points", "view px", "ms for front and side (median)")
    for row in result["results"]:  # type: ignore[attr-defined]
        table.add(*row.values())
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
