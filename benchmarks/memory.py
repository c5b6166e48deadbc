"""Does `annotate` need more memory for a longer recording? Its peak, each length in a process of its own.

python -m benchmarks.memory [--frames 20 200] [--json]
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import tyro

from annotator.types import Box2D, Frame, Image
from annotator.types.errors import ConfigError
from benchmarks.report import Table, finish, guarded

PRESET, LABEL = "people", "person"
FOLDERS = {"color": ".jpg", "depth": ".png"}


@dataclass
class Arguments:
    """Peak resident memory of `annotate` by length of the recording, with detectors that need next to none."""

    frames: tuple[int, ...] = (20, 200)
    """Lengths to measure."""
    different: int = 4
    """So many frames are generated; a recording repeats them."""
    width: int = 640
    """Of the images, pixels; the height is three quarters of it."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True)
class Repeating:
    """A detector that knows the first frames of a recording, for one that repeats them: `000007` is `000003` of 4."""

    first: Any
    different: int

    @property
    def labels(self) -> tuple[str, ...]:
        return (LABEL,)

    @property
    def fingerprint(self) -> str:
        return f"{self.first.fingerprint}-{self.different}"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        known = [replace(i, key=_key(int(i.key) % self.different)) if isinstance(i, Frame) else i for i in images]
        found: list[list[Box2D]] = self.first.detect(known)
        return found


def generate(folder: Path, different: int, width_px: int) -> None:
    """The frames that all recordings repeat."""
    from annotator.recordings.generated import write_generated

    write_generated(folder, PRESET, different, 0, width_px, width_px * 3 // 4)


def lengthen(source: Path, folder: Path, frames: int, different: int) -> None:
    """A recording of so many frames without so many files: its names are links to the source's files."""
    for name, suffix in FOLDERS.items():
        (folder / name).mkdir(parents=True)
        for number in range(frames):
            place = folder / name / (_key(number) + suffix)
            os.link(source / name / (_key(number % different) + suffix), place)
    for name in ("camera_intrinsic.json", "gravity.json"):
        os.link(source / name, folder / name)


def annotate_and_measure(source: Path, folder: Path, different: int) -> float:
    """Peak resident memory of this process in MB, after it has annotated the recording in `folder`.

    Raises:
        ConfigError: frames failed, so that the figure would say nothing.
    """
    from annotator.detection.perfect import PerfectDetector, Scene
    from annotator.project import create_project
    from annotator.rcv.config import RcvConfig
    from annotator.recordings import open_recording
    from annotator.workflows.annotate import annotate
    from annotator.workflows.detectors import Detectors
    from annotator.workflows.recordings import register_recording
    from annotator.workflows.truth import load_truth

    known = open_recording(source)
    frames = [known.frame(index) for index in range(different)]
    perfect = PerfectDetector([Scene.of(frame, load_truth(known, i, frame)) for i, frame in enumerate(frames)])
    del frames
    detector = Repeating(perfect, different)
    with create_project(folder.parent / "projects", folder.name, (LABEL,)) as project:
        register_recording(project, open_recording(folder))
        done = annotate(project, Detectors(detector, detector), RcvConfig())
    if done.failed or not done.proposals:
        raise ConfigError(f"{len(done.failed)} frames failed, {done.proposals} proposals: {done.failed[:1]}")
    return _peak_mb()


def _peak_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def _key(number: int) -> str:
    return f"{number:06d}"


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
    peaks: list[float] = []
    with TemporaryDirectory() as temporary:
        source = Path(temporary) / "source"
        _alone(generate, source, args.different, args.width)
        for number, frames in enumerate(args.frames):
            folder = Path(temporary) / f"recording-{number}"
            lengthen(source, folder, frames, args.different)
            peaks.append(_alone(annotate_and_measure, source, folder, args.different))
    return {
        "results": [{"frames": n, "peak_mb": peak} for n, peak in zip(args.frames, peaks, strict=True)],
        "growth_mb_per_1000_frames": growth(args.frames, peaks) * 1000,
    }


def growth(frames: Sequence[int], peaks_mb: Sequence[float]) -> float:
    """MB a frame, by least squares; NaN where there is only one length."""
    x = np.array(frames, np.float64)
    x -= x.mean()
    return float(x @ np.array(peaks_mb) / (x @ x)) if x.any() else float("nan")


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("frames", "peak MB")
    for row in result["results"]:  # type: ignore[attr-defined]
        table.add(*row.values())
    finish(result, args.json, table)
    if not args.json:
        print(f"{result['growth_mb_per_1000_frames']:.1f} MB more for 1000 frames more")


if __name__ == "__main__":
    guarded(main)
