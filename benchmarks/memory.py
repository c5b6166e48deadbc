"""Does `annotate` need more memory for a longer recording? Its peak, each length in a process of its own.

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
from benchmarks.repeating import LABEL, generate, knowing, lengthen
from benchmarks.report import Table, finish, guarded


@dataclass
class Arguments:
    """Peak resident memory of `annotate` by length of the recording, with detectors that need next to none."""

    frames: tuple[int, ...] = (20, 200)
    """Lengths to measure."""
    different: int = 4
    """So many frames are generated; a recording repeats them."""
    width: int = 640
    """Of the images, pixels; the height is three quarters of it."""
    engine: Literal["inline", "local"] = "inline"
    """What annotates."""
    workers: int | None = None
    """Of the local engine."""
    steps: int = 5
    """Of the recursion; with 1 a frame takes least time."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Peaks:
    """Peak resident memory, MB: of the process that drives the batch, and of its largest worker (None without any)."""

    driver_mb: float
    worker_mb: float | None


def annotate_and_measure(source: Path, folder: Path, args: Arguments) -> Peaks:
    """Peak resident memory of this process and its workers, after they have annotated the recording in `folder`.

    Raises:
        ConfigError: frames failed, so that the figure would say nothing.
    """
    from annotator.project import create_project
    from annotator.rcv.config import RcvConfig
    from annotator.recordings import open_recording
    from annotator.workflows.annotate import annotate_with
    from annotator.workflows.detectors import Detectors
    from annotator.workflows.engines.choose import EngineName, make_engine
    from annotator.workflows.engines.sources import GivenDetectors
    from annotator.workflows.recordings import register_recording

    detector = knowing(source, args.different)
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


def _alone(function: Callable[..., Any], *arguments: object) -> Any:
    """What a function gives in a fresh process, which has only its own memory to answer for."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def run(args: Arguments) -> dict[str, object]:
    """The benchmark; what `--json` prints.

    Raises:
        ConfigError: a length below 1.
    """
    if not args.frames or min(*args.frames, args.different) < 1:
        raise ConfigError(f"--frames and --different must be 1 or more, not {args.frames} and {args.different}")
    peaks: list[Peaks] = []
    with TemporaryDirectory() as temporary:
        source = Path(temporary) / "source"
        _alone(generate, source, args.different, args.width)
        for number, frames in enumerate(args.frames):
            folder = Path(temporary) / f"recording-{number}"
            lengthen(source, folder, frames, args.different)
            peaks.append(_alone(annotate_and_measure, source, folder, args))
    return {
        "results": [
            {"frames": n, "peak_mb": peak.driver_mb, "worker_peak_mb": peak.worker_mb}
            for n, peak in zip(args.frames, peaks, strict=True)
        ],
        "growth_mb_per_1000_frames": growth(args.frames, [peak.driver_mb for peak in peaks]) * 1000,
    }


def growth(frames: Sequence[int], peaks_mb: Sequence[float]) -> float:
    """MB a frame, by least squares; NaN where there is only one length."""
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
        print(f"{result['growth_mb_per_1000_frames']:.1f} MB more for 1000 frames more")


if __name__ == "__main__":
    guarded(main)
