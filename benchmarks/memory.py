"""Peak memory of `annotate` by length of the recording, each length in a separate process.

python -m benchmarks.memory [--frames 20 200] [--engine local --workers 2] [--json]
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from annotator.types.errors import ConfigError
from benchmarks.repeating import LABEL, generate, lengthen, perfect_detector
from benchmarks.report import Table, finish, guarded


@dataclass
class Arguments:
    """Measure the peak resident memory of `annotate` by length of the recording, with perfect detectors."""

    frames: tuple[int, ...] = (20, 200)
    """Lengths of the recording to measure, frames."""
    different: int = 4
    """Number of different frames that each recording repeats."""
    width: int = 640
    """Width of the images, pixels; the height is three quarters of it."""
    engine: Literal["inline", "local"] = "inline"
    """Engine that annotates: this process, or worker processes."""
    workers: int | None = None
    """Number of workers of the local engine."""
    steps: int = 5
    """Maximum number of steps of the recursion; 1 is fastest."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Peaks:
    """Peak resident memory, MB: of the main process, and of its largest worker (None without workers)."""

    driver_mb: float
    worker_mb: float | None


def annotate_and_measure(source: Path, folder: Path, args: Arguments) -> Peaks:
    """Annotates the recording in `folder`; returns the peak resident memory of this process and its workers.

    Raises:
        ConfigError: frames failed or there was no proposal, so the measurement is invalid.
    """
    from annotator.project import create_project
    from annotator.rcv.config import RcvConfig
    from annotator.recordings import open_recording
    from annotator.workflows.add_recordings import register_recording
    from annotator.workflows.detectors import Detectors
    from annotator.workflows.proposing.annotate import annotate_with
    from annotator.workflows.proposing.engines import EngineName, make_engine
    from annotator.workflows.proposing.tasks import GivenDetectors

    detector = perfect_detector(source, args.different)
    pair = GivenDetectors(Detectors(detector, detector))
    engine = make_engine(EngineName(args.engine), pair, frames=max(args.frames), workers=args.workers)
    with create_project(folder.parent / "projects", folder.name, (LABEL,)) as project, closing(engine):
        register_recording(project, open_recording(folder))
        done = annotate_with(project, engine, RcvConfig(max_steps=args.steps))
    if done.failures or not done.proposals:
        raise ConfigError(f"{done.failures} frames failed, {done.proposals} proposals: {done.failed[:1]}")
    workers = _peak_mb(resource.RUSAGE_CHILDREN) if args.engine == "local" else None
    return Peaks(_peak_mb(resource.RUSAGE_SELF), workers)


def _peak_mb(whose: int) -> float:
    peak = resource.getrusage(whose).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def _in_new_process(function: Callable[..., Any], *arguments: object) -> Any:
    """Calls a function in a new process, whose peak memory excludes earlier work."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def run(args: Arguments) -> dict[str, object]:
    """Runs the benchmark; returns what `--json` prints.

    Raises:
        ConfigError: a length or a number of frames below 1.
    """
    if not args.frames or min(*args.frames, args.different) < 1:
        raise ConfigError(f"--frames and --different must be 1 or more, not {args.frames} and {args.different}")
    peaks: list[Peaks] = []
    with TemporaryDirectory() as temporary:
        source = Path(temporary) / "source"
        _in_new_process(generate, source, args.different, args.width)
        for number, frames in enumerate(args.frames):
            folder = Path(temporary) / f"recording-{number}"
            lengthen(source, folder, frames, args.different)
            peaks.append(_in_new_process(annotate_and_measure, source, folder, args))
    return {
        "results": [
            {"frames": n, "peak_mb": peak.driver_mb, "worker_peak_mb": peak.worker_mb}
            for n, peak in zip(args.frames, peaks, strict=True)
        ],
        "growth_mb_per_1000_frames": growth(args.frames, [peak.driver_mb for peak in peaks]) * 1000,
    }


def growth(frames: Sequence[int], peaks_mb: Sequence[float]) -> float:
    """Growth in MB per frame, by least squares; NaN if there is only one length."""
    x = np.array(frames, np.float64)
    x -= x.mean()
    return float(x @ np.array(peaks_mb) / (x @ x)) if x.any() else float("nan")


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("frames", "peak MB", "largest worker's peak MB")
    for row in result["results"]:  # type: ignore[attr-defined]
        table.add(*row.values())
    finish(result, args.json, table)
    if not args.json:
        print(f"growth: {result['growth_mb_per_1000_frames']:.1f} MB per 1000 frames")


if __name__ == "__main__":
    guarded(main)
