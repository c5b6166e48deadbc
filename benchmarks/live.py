"""The live pipeline, end to end: read from disk, detect, and display into a view that no browser looks at.

    python -m benchmarks.live DIR [--project P] [--warm-start] [--backend B] [--seconds S] [--json]

The frames are played forth and back, so that motion goes on without a jump, and faster than they can be detected, the
newest wins: frames a second are the pipeline's and not the recording's. Without a kept project the detectors are
trained as `benchmarks.loop` trains them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from annotator.detection.config import Backend
from annotator.project import Project, Role
from annotator.rcv.config import RcvConfig
from annotator.rcv.seeds import is_warm
from annotator.recordings import Recording, open_recording
from annotator.types.errors import ConfigError
from annotator.web.live.view import LiveView
from annotator.workflows.detectors import Detectors, load_detector
from annotator.workflows.live.detection import Detected, LiveDetection
from annotator.workflows.live.figures import Figures
from annotator.workflows.live.pipeline import Pipeline
from annotator.workflows.live.playback import Playback, Repeat
from annotator.workflows.rcv_settings import rcv_config
from benchmarks import loop
from benchmarks.report import Table, finish, guarded

QUIET = Console(stderr=True)
# Detectors make themselves ready for each size of picture that they meet.
WARM_UP_S = 5.0
# Fewer frames say nothing, however long they take.
LEAST_SHOWN = 5
# The slowest source, and how much faster than the pipeline it shall be: reading more would only take time away.
LEAST_RATE, FASTER_BY = 30.0, 1.25


@dataclass
class Arguments:
    """Frames a second and latency of `annotator live`."""

    directory: Annotated[Path, tyro.conf.Positional]
    """A recording; to be trained on, too, it needs truth."""
    project: Path | None = None
    """Use the detectors of a project that `benchmarks.loop --project` has kept here, or keep this one's."""
    warm_start: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Begin each recursion with the boxes of the frame before."""
    backend: Backend = "fastest"
    """What runs the detectors; the default of `annotator live`."""
    image_size: int | None = None
    """The longer side of a camera image in the network, pixels; None = as trained."""
    view_size: int | None = None
    """The same of a pseudo-view."""
    seconds: float = 20.0
    """How long to measure, after warming up; longer where fewer than five frames have come through."""
    frames: int | None = None
    """Measure so many frames of the source instead."""
    rate: float | None = None
    """Frames a second of the source; None = a little more than the pipeline can do, and at least 30."""
    epochs: int | None = None
    """Of both trainings, where they are to be done; None = as many as show the default number of pictures."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def run(args: Arguments) -> dict[str, object]:
    """The benchmark; what `--json` prints.

    Raises:
        ConfigError: a duration or a number of frames that measures nothing; or as `benchmarks.loop`.
        AnnotatorError: of its stages.
    """
    if not args.seconds > 0:
        raise ConfigError(f"{args.seconds:g} seconds measure nothing; give more than 0")
    recording = open_recording(args.directory)
    taught = loop.Arguments(args.directory, project=args.project, epochs=args.epochs)
    with loop.taught(taught, recording, 2, {}) as (project, _):
        detectors = _detectors(project, args)
        config = rcv_config(project)
        rotation = project.config.settings.rotation
        detection = LiveDetection(detectors, config, rotation, warm_start=args.warm_start)
        return _measure(recording, detection, args) | _conditions(detectors, config, args)


def _detectors(project: Project, args: Arguments) -> Detectors:
    image, view = project.models.active(Role.IMAGE), project.models.active(Role.VIEW)
    assert image is not None and view is not None  # it was taught
    return Detectors(
        load_detector(image.path, args.backend, args.image_size),
        load_detector(view.path, args.backend, args.view_size),
        view.box_kind,
    )


def _measure(recording: Recording, detection: LiveDetection, args: Arguments) -> dict[str, object]:
    warm = _Once(recording, detection, math.inf)
    reached = warm.figures(WARM_UP_S, None)
    rate = args.rate or max(LEAST_RATE, FASTER_BY * (reached.fps or 0.0))
    measured = _Once(recording, detection, rate)
    figures = measured.figures(args.seconds, args.frames)
    if figures.fps is None:
        raise ConfigError(f"{figures.shown} frames came through, too few for a rate; give more --seconds or --frames")
    return {
        "fps": figures.fps,
        "latency_ms": figures.latency_ms,
        "latency_p95_ms": figures.latency_p95_ms,
        "stages_ms": dict(figures.stages_ms),
        "shown": figures.shown,
        "drops": vars(figures.drops),
        "source_fps": rate,
        "objects_per_frame": measured.objects / measured.frames,
        "warm_share": measured.warm / max(measured.objects, 1),
    }


class _Once:
    """One run of the pipeline, from its own source into its own view."""

    def __init__(self, recording: Recording, detection: LiveDetection, rate: float) -> None:
        self._source = Playback(recording, rate=rate, repeat=Repeat.BACK)
        self._detection = detection
        self.frames = self.objects = self.warm = 0

    def figures(self, seconds: float, frames: int | None) -> Figures:
        """Runs for so long, or for so many frames of the source.

        Raises:
            AnnotatorError: why a stage failed.
        """
        pipeline = Pipeline(self._source, self._detection, self._show, most_frames=frames)
        pipeline.meter.window_s = math.inf
        self._view = LiveView(self._source.name, {})
        self._view.follow(pipeline)
        pipeline.start()
        try:
            is_over = pipeline.wait(None if frames is not None else seconds)
            while not is_over and pipeline.figures().shown < LEAST_SHOWN:
                is_over = pipeline.wait(0.1)
            return pipeline.figures()
        finally:
            pipeline.end()
            self._view.close()

    def _show(self, detected: Detected) -> None:
        found = detected.found.proposals
        # more of them than the figures tell of: some are shown while the pipeline ends
        self.frames += 1
        self.objects += len(found)
        self.warm += sum(map(is_warm, found))
        self._view.show(detected)


def _conditions(detectors: Detectors, config: RcvConfig, args: Arguments) -> dict[str, object]:
    return {
        "backend": detectors.backends[1] or args.backend,
        "warm_start": args.warm_start,
        "image_size_px": args.image_size,
        "view_size_px": args.view_size,
        "max_steps": config.max_steps,
    }


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    result = run(args)
    table = Table("measure", "value")
    for name, value in result.items():
        if isinstance(value, dict):
            for part, each in value.items():
                table.add(f"{name}: {part}", each)
        else:
            table.add(name, value)
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
