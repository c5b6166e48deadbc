"""Annotated frames per second: in one process, with worker processes, and with Ray.

    python -m benchmarks.batch [--project P --recording DIR] [--engines local ray] [--workers 2] [--json]

With a project kept by `benchmarks.loop --project`, its trained detectors run on a recording. Without one, perfect
detectors run on a generated recording. All engines are started first; then each annotates the same frames, in turn and
several times. The medians give the steady rate; the time to start is listed separately. "plain" is the engine without
worker processes, whose detectors use all cores. "one core" is the same engine with detectors on one core, as in each of
several workers. "base detector" is the plain engine with the base detector as view detector; it is left out if this
installation has none. Projects with a view detector of their own never use it.
"""

from __future__ import annotations

import os
import statistics
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from annotator.detection.config import Backend
from annotator.detection.perfect import PerfectDetector, Scene
from annotator.detection.pretrained import base_weights, has_base
from annotator.project import BoxRotation, ProjectSettings, create_project, open_project
from annotator.rcv.config import RcvConfig
from annotator.recordings import Recording, open_recording
from annotator.synthetic import write_generated
from annotator.types import Box2D, BoxKind, Frame, Image
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors, base_model, load_detector, trained_detectors
from annotator.workflows.proposing.annotate import TASK_FRAMES, annotate_with
from annotator.workflows.proposing.engines import EngineName, make_engine
from annotator.workflows.proposing.pool import WorkerPool
from annotator.workflows.proposing.runner import Engine
from annotator.workflows.proposing.tasks import DetectorSource
from annotator.workflows.recorded.reading import load_truth
from benchmarks.report import Options, Table, guarded, program, seconds_of

PRESET, LABEL = "people", "person"
FOLDERS = {"color": ".jpg", "depth": ".png"}


@dataclass(frozen=True)
class Repeating:
    """A perfect detector for a recording that repeats its `different` first frames, of which `first` is the detector;
    with 4, `000007` is the same as `000003`."""

    first: Any
    different: int

    @property
    def labels(self) -> tuple[str, ...]:
        return (LABEL,)

    @property
    def fingerprint(self) -> str:
        return f"{self.first.fingerprint}-{self.different}"

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        originals = [
            replace(i, key=f"{int(i.key) % self.different:06d}") if isinstance(i, Frame) else i for i in images
        ]
        boxes: list[list[Box2D]] = self.first.detect(originals)
        return boxes


def perfect_detector(source: Path, different: int) -> Repeating:
    """The perfect detector for recordings that repeat the frames of `source`."""
    recording = open_recording(source)
    frames = [recording.frame(index) for index in range(different)]
    scenes = [Scene.of(frame, load_truth(recording, index, frame)) for index, frame in enumerate(frames)]
    return Repeating(PerfectDetector(scenes), different)


def lengthen(source: Path, folder: Path, frames: int, different: int) -> None:
    """Creates a recording of `frames` frames as hard links to the files of the source's frames."""
    for name, suffix in FOLDERS.items():
        (folder / name).mkdir(parents=True)
        for number in range(frames):
            link = folder / name / f"{number:06d}{suffix}"
            os.link(source / name / f"{number % different:06d}{suffix}", link)
    for name in ("camera_intrinsic.json", "gravity.json"):
        os.link(source / name, folder / name)


PLAIN, ONE_CORE, BASE, PROJECT = "plain", "one core", "base detector", "loop"


@dataclass
class Arguments(Options):
    project: Path | None = None
    """A folder kept by `benchmarks.loop --project`."""
    recording: Path | None = None
    """The recording that its detectors run on."""
    engines: tuple[Literal["local", "ray"], ...] = ("local", "ray")
    """Engines to measure beside the plain loop."""
    workers: tuple[int, ...] = (2,)
    """Numbers of workers to measure."""
    threads: int | None = None
    """CPU threads of each worker; None = its share of the cores."""
    backend: Backend = "auto"
    """Backend of the trained detectors."""
    frames: int = 48
    """Number of frames that each engine annotates."""
    repeats: int = 3
    """Number of repetitions."""
    steps: int = RcvConfig().max_steps
    """Maximum number of steps of the recursion."""
    different: int = 4
    """Number of different frames that a generated recording repeats."""
    width: int = 640
    """Width of generated images, pixels."""


@dataclass(frozen=True, eq=False)
class Job:
    """The work of every engine: frames of a recording. `base` has the base detector, if this installation has one."""

    source: DetectorSource
    base: DetectorSource | None
    recording: Recording
    classes: tuple[str, ...]
    rotation: BoxRotation
    config: RcvConfig
    frames: int


def prepare_job(args: Arguments, folder: Path) -> Job:
    """Creates the job described by the arguments."""
    if (args.project is None) != (args.recording is None):
        raise ConfigError("--project and --recording belong together; give both or neither")
    if min(args.frames, args.repeats, args.different, *args.workers) < 1:
        raise ConfigError("--frames, --repeats, --different and --workers must be 1 or more")
    config = RcvConfig(max_steps=args.steps)
    if args.project is None or args.recording is None:
        write_generated(folder / "source", PRESET, args.different, 0, args.width, args.width * 3 // 4)
        lengthen(folder / "source", folder / "recording", args.frames, args.different)
        detector = perfect_detector(folder / "source", args.different)
        source: DetectorSource = Detectors(detector, detector)
        base: DetectorSource | None = None
        if has_base():
            base = Detectors(detector, load_detector(base_weights(), args.backend), BoxKind.BOX, True)
        return Job(source, base, open_recording(folder / "recording"), (LABEL,), BoxRotation.AUTO, config, args.frames)
    with open_project(args.project / PROJECT) as project:
        trained, stored = trained_detectors(project, args.backend), project.config
    recording = open_recording(args.recording)
    frames = min(args.frames, len(recording))
    with_base = replace(trained, view=base_model()) if has_base() else None
    return Job(trained, with_base, recording, stored.classes, stored.settings.rotation, config, frames)


def seconds(engine: Engine, job: Job) -> float:
    """Seconds that a started engine needs for the job, from reading the first frame to storing the last one."""
    with TemporaryDirectory() as temporary:
        settings = ProjectSettings(rotation=job.rotation)
        with create_project(Path(temporary), "batch", job.classes, settings=settings) as project:
            register_recording(project, job.recording)
            done = annotate_with(project, engine, job.config, limit=job.frames)
    if done.failures:
        raise ConfigError(f"{done.failures} of {done.frames} frames failed: {done.failed[:1]}")
    return done.seconds


def run(args: Arguments) -> dict[str, Any]:
    start_s: dict[tuple[str, int], float] = {}
    with TemporaryDirectory() as temporary, ExitStack() as stack:
        job = prepare_job(args, Path(temporary))
        rows = [(PLAIN, 0), (ONE_CORE, 0), *((name, workers) for name in args.engines for workers in args.workers)]
        rows += [] if job.base is None else [(BASE, 0)]
        taken: dict[tuple[str, int], list[float]] = {row: [] for row in rows}
        engines = {}
        for row in rows:
            engine = engines[row] = stack.enter_context(closing(_engine(row, job, args)))
            start_s[row] = seconds_of(engine.start_all if isinstance(engine, WorkerPool) else engine.start)
        for turn in range(args.repeats + 1):
            for row, engine in engines.items():
                took = seconds(engine, job)
                if turn > 0:  # the first turn is a warm-up
                    taken[row].append(took)
    most = max(args.workers)
    ray, local = taken.get((EngineName.RAY.value, most)), taken.get((EngineName.LOCAL.value, most))
    return {
        "frames": job.frames,
        "batch_frames": TASK_FRAMES,
        "results": [
            {
                "engine": name,
                "workers": workers,
                "start_s": start_s[name, workers],
                "fps": job.frames / statistics.median(took),
                "against_plain": _speed_up(taken[PLAIN, 0], took),
                "against_one_core": _speed_up(taken[ONE_CORE, 0], took),
            }
            for (name, workers), took in taken.items()
        ],
        "ray_against_local": _speed_up(local, ray) if ray and local else None,
    }


def _engine(row: tuple[str, int], job: Job, args: Arguments) -> Engine:
    name, workers = row
    if name == BASE and job.base is not None:
        return make_engine(EngineName.INLINE, job.base, frames=job.frames)
    if name in (PLAIN, ONE_CORE):
        threads = 1 if name == ONE_CORE else None
        return make_engine(EngineName.INLINE, job.source, frames=job.frames, threads=threads)
    return make_engine(EngineName(name), job.source, frames=job.frames, workers=workers, threads=args.threads)


def _speed_up(before_s: list[float], after_s: list[float]) -> float:
    """Median speed-up, compared turn by turn because the load of the machine may change between turns."""
    return statistics.median(before / after for before, after in zip(before_s, after_s, strict=True))


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    heads = ("engine", "workers", "start s", "frames per second", "times the plain loop", "times one core")
    table = Table(*heads, rows=(row.values() for row in result["results"]))
    if result["ray_against_local"] is not None:
        table.add("Ray, times the rate of local workers", "", "", result["ray_against_local"], "", "")
    return [table]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
