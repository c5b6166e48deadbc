"""How many frames a second are annotated: in one process, by worker processes, by Ray.

    python -m benchmarks.batch [--project P --recording DIR] [--engines local ray] [--workers 2] [--json]

With a project that `benchmarks.loop --project` has kept, its trained detectors work on a recording; without one,
detectors that know a generated recording. All engines are started first, and then do the same frames in turn, several
times: the medians are of the steady rate, and how long starting takes is told apart. "plain" is the engine without
processes, whose detectors use all cores, and "one core" the same with detectors on one core, as each of several workers
has them.
"""

from __future__ import annotations

import statistics
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

import tyro

from annotator.detection.config import Backend
from annotator.project import BoxRotation, ProjectSettings, create_project, open_project
from annotator.rcv.config import RcvConfig
from annotator.recordings import Recording, open_recording
from annotator.types.errors import ConfigError
from annotator.workflows.annotate import BATCH_FRAMES, annotate_with
from annotator.workflows.detectors import Detectors
from annotator.workflows.engines.choose import EngineName, make_engine
from annotator.workflows.engines.engine import Engine
from annotator.workflows.engines.pool import WorkerPool
from annotator.workflows.engines.sources import DetectorSource, GivenDetectors, trained_detectors
from annotator.workflows.recordings import register_recording
from benchmarks.repeating import LABEL, generate, knowing, lengthen
from benchmarks.report import Table, finish, guarded

PLAIN, ONE_CORE, PROJECT = "plain", "one core", "loop"


@dataclass
class Arguments:
    """Frames a second by engine and workers, against the plain loop."""

    project: Path | None = None
    """A folder that `benchmarks.loop --project` has kept."""
    recording: Path | None = None
    """What its detectors work on."""
    engines: tuple[Literal["local", "ray"], ...] = ("local", "ray")
    """To be measured beside the plain loop."""
    workers: tuple[int, ...] = (2,)
    """Numbers of workers to measure."""
    threads: int | None = None
    """Of the processor for each worker; None = its share of the cores."""
    backend: Backend = "auto"
    """What runs trained detectors."""
    frames: int = 48
    """To do, in turn by every engine."""
    repeats: int = 3
    """Turns."""
    steps: int = RcvConfig().max_steps
    """Of the recursion."""
    different: int = 4
    """So many frames are generated where no recording is given; it repeats them."""
    width: int = 640
    """Of generated images, pixels."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


@dataclass(frozen=True, eq=False)
class Job:
    """What every engine does: the frames of a recording, with these detectors and settings."""

    source: DetectorSource
    recording: Recording
    classes: tuple[str, ...]
    rotation: BoxRotation
    config: RcvConfig
    frames: int


def prepared(args: Arguments, folder: Path) -> Job:
    """The job that the arguments name.

    Raises:
        ConfigError: a project without a recording, or the other way round.
        AnnotatorError: they cannot be opened.
    """
    if (args.project is None) != (args.recording is None):
        raise ConfigError("--project and --recording belong together; give both, or none")
    if min(args.frames, args.repeats, args.different, *args.workers) < 1:
        raise ConfigError("--frames, --repeats, --different and --workers must be 1 or more")
    config = RcvConfig(max_steps=args.steps)
    if args.project is None or args.recording is None:
        generate(folder / "source", args.different, args.width)
        lengthen(folder / "source", folder / "recording", args.frames, args.different)
        detector = knowing(folder / "source", args.different)
        source: DetectorSource = GivenDetectors(Detectors(detector, detector))
        return Job(source, open_recording(folder / "recording"), (LABEL,), BoxRotation.AUTO, config, args.frames)
    with open_project(args.project / PROJECT) as project:
        trained, stored = trained_detectors(project, args.backend), project.config
    config = config.model_copy(update={"box_kind": trained.box_kind})
    recording = open_recording(args.recording)
    frames = min(args.frames, len(recording))
    return Job(trained, recording, stored.classes, stored.settings.rotation, config, frames)


def seconds(engine: Engine, job: Job) -> float:
    """How long an engine that is ready takes for the job, from the first frame read to the last one stored.

    Raises:
        ConfigError: frames failed, so that the figure would say nothing.
    """
    with TemporaryDirectory() as temporary:
        settings = ProjectSettings(rotation=job.rotation)
        with create_project(Path(temporary), "batch", job.classes, settings=settings) as project:
            register_recording(project, job.recording)
            done = annotate_with(project, engine, job.config, limit=job.frames)
    if done.failures:
        raise ConfigError(f"{done.failures} of {done.frames} frames failed: {done.failed[:1]}")
    return done.seconds


def run(args: Arguments) -> dict[str, object]:
    """The benchmark; what `--json` prints.

    Raises:
        ConfigError: arguments of no use, or frames failed.
        AnnotatorError: of the engines.
    """
    wanted = [(PLAIN, 0), (ONE_CORE, 0), *((name, workers) for name in args.engines for workers in args.workers)]
    taken: dict[tuple[str, int], list[float]] = {row: [] for row in wanted}
    start_s: dict[tuple[str, int], float] = {}
    with TemporaryDirectory() as temporary, ExitStack() as stack:
        job = prepared(args, Path(temporary))
        engines = {}
        for row in wanted:
            begin = time.perf_counter()
            engines[row] = stack.enter_context(closing(_started(row, job, args)))
            start_s[row] = time.perf_counter() - begin
        for turn in range(args.repeats + 1):
            for row, engine in engines.items():
                took = seconds(engine, job)
                if turn > 0:  # the first one wakes everything
                    taken[row].append(took)
    return {
        "frames": job.frames,
        "batch_frames": BATCH_FRAMES,
        "results": [
            {
                "engine": name,
                "workers": workers,
                "start_s": start_s[name, workers],
                "fps": job.frames / statistics.median(took),
                "against_plain": _faster(taken[PLAIN, 0], took),
                "against_one_core": _faster(taken[ONE_CORE, 0], took),
            }
            for (name, workers), took in taken.items()
        ],
        "ray_against_local": _ray_against_local(taken, max(args.workers)),
    }


def _started(row: tuple[str, int], job: Job, args: Arguments) -> Engine:
    name, workers = row
    if name in (PLAIN, ONE_CORE):
        threads = 1 if name == ONE_CORE else None
        engine = make_engine(EngineName.INLINE, job.source, frames=job.frames, threads=threads)
    else:
        engine = make_engine(EngineName(name), job.source, frames=job.frames, workers=workers, threads=args.threads)
    if isinstance(engine, WorkerPool):
        engine.start_all()
    else:
        engine.start()
    return engine


def _ray_against_local(taken: dict[tuple[str, int], list[float]], workers: int) -> float | None:
    ray, local = taken.get((EngineName.RAY.value, workers)), taken.get((EngineName.LOCAL.value, workers))
    return _faster(local, ray) if ray and local else None


def _faster(before_s: list[float], after_s: list[float]) -> float:
    """How many times as fast; turn by turn, since the machine may have been busier in one than in the next."""
    return statistics.median(before / after for before, after in zip(before_s, after_s, strict=True))


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("engine", "workers", "start s", "frames a second", "times the plain loop", "times one core")
    for row in result["results"]:  # type: ignore[attr-defined]
        table.add(*row.values())
    finish(result, args.json, table)
    if not args.json and result["ray_against_local"] is not None:
        print(f"Ray: {result['ray_against_local']:.2f} times local workers")


if __name__ == "__main__":
    guarded(main)
