"""CPU time of a step of the recursion without the detector, by stage, for one object in a depth camera's frame.

The time is that of one thread.

OMP_NUM_THREADS=1 python -m benchmarks.step [--points 50000] [--json]
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from annotator.detection.perfect import PerfectDetector
from annotator.geometry.outline import box_on_image
from annotator.geometry.projection import in_frustum, pixel_rays, unproject_depth
from annotator.rcv import measure, propose, pseudo_view, recursion
from annotator.rcv.axes import with_normals
from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.starts import WarmStart
from annotator.types import Camera, Frame, OrientedBox, PointCloud, Truth
from benchmarks.report import Options, Table, guarded, program, require


class Stopwatch:
    """CPU seconds of this thread by stage. The time of nested stages counts for the innermost one.

    CPU time does not include waiting; other programs affect it only through shared caches.

    Attributes:
        runs: for each run, its steps; for each step, seconds by stage.
        whole: for each stage of the whole run, its seconds each time it ran.
    """

    def __init__(self, run_stages: Sequence[str], clock: Callable[[], float] = time.thread_time) -> None:
        self._clock = clock
        self.runs: list[list[dict[str, float]]] = []
        self.whole: dict[str, list[float]] = {stage: [] for stage in run_stages}
        self._inside: list[float] = []

    @contextmanager
    def over(self, *functions: tuple[Any, ...]) -> Iterator[None]:
        """Times one run of functions, each an object, its name there, its stage, and True if it starts a step."""
        self.runs.append([])
        with ExitStack() as stack:
            for holder, name, stage, *starts_step in functions:
                timed = self._timed(getattr(holder, name), stage, bool(starts_step))
                stack.enter_context(patch.object(holder, name, timed))
            yield

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Counts the time of the block for a stage."""
        self._inside.append(0.0)
        begin = self._clock()
        yield
        total = self._clock() - begin
        without_nested = total - self._inside.pop()
        if self._inside:
            self._inside[-1] += total
        if name in self.whole:
            self.whole[name].append(without_nested)
        else:
            self.runs[-1][-1][name] += without_nested

    def _timed(self, function: Callable[..., Any], stage: str, starts_step: bool) -> Callable[..., Any]:
        def call(*args: Any, **named: Any) -> Any:
            if starts_step:
                self.runs[-1].append(defaultdict(float))
            with self.stage(stage):
                return function(*args, **named)

        return call


CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
WALL_M = 2.5
OF_STEP = ("axes", "render", "fit", "cut", "trace", "check", "rest")
OF_FRAME = ("frustum", "normals", "finish")
DETECTOR = "detector stand-in"
# Names of the steps in order; the last name also stands for all later steps. WARM: of a recursion with a start box.
PLAIN, WARM = ("camera", "wide", "near"), ("warm", "warm again")


@dataclass
class Arguments(Options):
    points: int = 50_000
    """Number of points in the object's frustum."""
    size_px: int = RcvConfig().view_px
    """Longer side of the pseudo-views, pixels."""
    repeats: int = 20
    """Number of frames; the median is printed."""


def scene(points: int, seed: int) -> tuple[Frame, Truth]:
    """A rotated box in front of a wall, in a depth camera's frame; its frustum has about `points` points."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(np.array([0.5, 0.6, -0.4]) + rng.normal(0, 0.05, 3)).as_matrix()
    size = np.array([0.4, 0.25, 0.18])
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 1.2]), rotation, size)
    for _ in range(4):  # the area of its outline grows with the square of its size
        outline = box_on_image(CAMERA, box, "thing")
        assert outline is not None
        size = size * np.sqrt(points / (outline.width_px * outline.height_px))
        box = OrientedBox.from_parts(box.center_m, rotation, size)
    depth = _depth(box) + rng.normal(0, 0.001, (CAMERA.height_px, CAMERA.width_px)).astype(np.float32)
    xyz, index = unproject_depth(CAMERA, depth)
    rgb = rng.integers(0, 255, (CAMERA.height_px, CAMERA.width_px, 3), np.uint8)
    cloud = PointCloud(xyz, rgb.reshape(-1, 3)[index], pixel_index=index)
    return Frame(f"{seed:06d}", seed, CAMERA, rgb, cloud, depth), Truth("thing", box)


def _depth(box: OrientedBox) -> np.ndarray:
    """(h, w) float32 depth, metres: of the box where the pixel's ray meets it (slab method), else of the wall."""
    rays = np.concatenate([pixel_rays(CAMERA), np.ones((CAMERA.height_px, CAMERA.width_px, 1))], axis=2)
    along, origin = rays @ box.rotation, -box.center_m @ box.rotation
    first, second = (-box.size_m / 2 - origin) / along, (box.size_m / 2 - origin) / along
    enters, leaves = np.minimum(first, second).max(axis=2), np.maximum(first, second).min(axis=2)
    return np.where(enters < leaves, enters, WALL_M).astype(np.float32)


def previous_box(box: OrientedBox, rng: np.random.Generator) -> WarmStart:
    """A warm start: the box of the previous frame, slightly shifted and rotated."""
    turn = Rotation.from_rotvec(rng.normal(0, 0.08, 3)).as_matrix()
    shift = rng.normal(0, 0.03, 3) * box.size_m.max()
    return WarmStart("thing", OrientedBox.from_parts(box.center_m + shift, turn @ box.rotation, box.size_m))


def timed_frame(
    watch: Stopwatch, frame: Frame, truth: Truth, warm_starts: Sequence[WarmStart], config: RcvConfig
) -> int:
    """Proposes on one frame and times the stages; returns the number of points in the object's frustum."""
    detector = PerfectDetector.for_frame(frame, [truth], jitter=0.01)
    boxes = detector.detect([frame])
    with watch.over(
        (propose, "in_frustums", "frustum"),
        (propose, "finish", "finish"),
        (propose, "check_first_step", "check"),
        (propose, "absorb_step", "rest"),
        (propose, "plan_step", "rest", True),
        (recursion, "_consensus_axes", "axes"),
        (recursion, "render_pairs", "render"),
        (pseudo_view, "render_pairs", "render"),
        (recursion, "cut_cloud", "cut"),
        (recursion, "contains", "cut"),
        (recursion, "_step_trace", "trace"),
        (measure, "fit_box", "fit"),
        (detector, "detect", DETECTOR),
    ):
        propose.propose_from_boxes([frame], boxes, detector, config, [warm_starts])
    mask = in_frustum(frame.camera, frame.cloud.xyz_m, boxes[0][0])
    with watch.stage("normals"):
        with_normals(frame, mask)
    return int(mask.sum())


def run(args: Arguments) -> dict[str, Any]:
    require(args, 500, 120_000, "points")
    require(args, 32, 2048, "size_px")
    require(args, 1, 1_000_000, "repeats")
    cv2.setNumThreads(1)
    plain_config = RcvConfig(orientation=Orientation.FREE)
    config = plain_config.model_copy(update={"view_px": args.size_px})
    points = []
    for repeat in range(args.repeats + 1):
        if repeat < 2:  # the first frame only fills caches
            watches = {"plain": Stopwatch(OF_FRAME), "warm": Stopwatch(OF_FRAME)}
        frame, truth = scene(args.points, repeat)
        warm_start = previous_box(truth.box, np.random.default_rng(repeat))
        for path, watch in watches.items():
            points.append(timed_frame(watch, frame, truth, [] if path == "plain" else [warm_start], config))
    rows = [row for path, watch in watches.items() for row in _rows(path, watch)]
    return {
        "points": int(np.median(points)),
        "size_px": args.size_px,
        "steps": rows,
        "per_step_ms": {path: _per_step(watch) for path, watch in watches.items()},
        "per_frame_ms": {s: float(np.median(watches["plain"].whole[s] or [np.nan])) * 1e3 for s in OF_FRAME},
    }


def _rows(path: str, watch: Stopwatch) -> list[dict[str, object]]:
    """For each kind of step, the median time of each stage and its share."""
    by_kind: dict[str, list[Mapping[str, float]]] = defaultdict(list)
    for steps in watch.runs:
        # more steps mean that the start box was dropped and the object restarted without it
        names = WARM if path == "warm" and len(steps) <= len(WARM) else PLAIN
        for number, stages in enumerate(steps):
            by_kind[names[min(number, len(names) - 1)]].append(stages)
    rows: list[dict[str, object]] = []
    for kind, runs in by_kind.items():
        ms = {stage: float(np.median([s.get(stage, 0.0) for s in runs])) * 1e3 for stage in (*OF_STEP, DETECTOR)}
        detector_ms = ms.pop(DETECTOR)
        share = {stage: value / max(sum(ms.values()), 1e-12) for stage, value in ms.items()}
        total = float(np.median([_without_detector(s) for s in runs])) * 1e3
        row = {"path": path, "step": kind, "runs": len(runs), "ms": ms, "share": share}
        rows.append(row | {"total_ms": total, "detector_ms": detector_ms})
    return rows


def _without_detector(stages: Mapping[str, float]) -> float:
    return sum(stages.get(stage, 0.0) for stage in OF_STEP)


def _per_step(watch: Stopwatch) -> float:
    """Median over the frames of the mean time of a step, milliseconds."""
    return float(np.median([np.mean([_without_detector(s) for s in steps]) for steps in watch.runs])) * 1e3


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    steps = Table("path", "step", *OF_STEP, "all, ms", DETECTOR)
    for row in result["steps"]:
        steps.add(row["path"], row["step"], *row["ms"].values(), row["total_ms"], row["detector_ms"])
    return [steps, Table("once per frame", "ms", rows=result["per_frame_ms"].items())]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
