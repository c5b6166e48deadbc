"""Rate and latency of the live pipeline, end to end: read from disk, detect, and display on a page without a browser.

    python -m benchmarks.live DIR [--project P] [--warm-start] [--backend B] [--seconds S] [--json]

The frames are played forward and backward, so that motion is continuous. They are played faster than the detection can
process them, and the detection always takes the newest frame. So the pipeline limits the frame rate. Without a kept
project, the detectors are trained as in `benchmarks.loop`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import Annotated, Any

import tyro

from annotator.detection.config import Backend
from annotator.project import Project
from annotator.rcv.starts import is_warm
from annotator.recordings import Recording, open_recording
from annotator.types import Detector, DetectorKind
from annotator.types.errors import ConfigError
from annotator.types.messages import amount
from annotator.web.live import LivePage
from annotator.workflows.detectors import Detectors, UsedModel, active_detectors, load_detector, required_model
from annotator.workflows.live.detection import Detected, LiveDetection
from annotator.workflows.live.open_source import Playback
from annotator.workflows.live.pipeline import Figures, Pipeline
from annotator.workflows.settings import rcv_config
from benchmarks import loop
from benchmarks.report import Options, Table, guarded, program

# Duration of the warm-up, in which the detectors compile the network for each new image size.
WARM_UP_S = 5.0
# Minimum number of shown frames for a measurement.
LEAST_SHOWN = 5
# Minimum rate of the source, frames per second, and its rate as a multiple of the pipeline's. A higher rate would only
# slow the pipeline down.
LEAST_RATE, FASTER_BY = 30.0, 1.25


@dataclass
class Arguments(Options):
    directory: Annotated[Path, tyro.conf.Positional]
    """A recording; training on it needs ground truth."""
    project: Path | None = None
    """Folder kept by `benchmarks.loop --project`, whose detectors are used; if missing, a new project is kept here."""
    warm_start: bool = False
    """Start the recursion from the boxes of the previous frame."""
    backend: Backend = "fastest"
    """Backend of the detectors; default: that of `annotator live`."""
    image_size: int | None = None
    """Longer side of camera images in the network, pixels; None = as trained."""
    view_size: int | None = None
    """Longer side of pseudo-views in the network, pixels; None = as trained."""
    seconds: float = 20.0
    """How long to measure after the warm-up; longer if fewer than five frames were shown."""
    frames: int | None = None
    """Measure this number of frames of the source instead."""
    rate: float | None = None
    """Frames per second of the source; None = 1.25 times the pipeline's rate, and at least 30."""
    epochs: int | None = None
    """Epochs of both training runs if needed; None = as many as show the default number of images."""


def run(args: Arguments) -> dict[str, Any]:
    if not args.seconds > 0:
        raise ConfigError(f"--seconds must be above 0, not {args.seconds:g}")
    recording = open_recording(args.directory)
    training = loop.Arguments(args.directory, project=args.project, epochs=args.epochs)
    with loop.trained_project(training, recording, 2, {}) as (project, _):
        detectors = _detectors(project, args)
        config = rcv_config(project)
        rotation = project.config.settings.rotation
        detection = LiveDetection(detectors, config, rotation, warm_start=args.warm_start)
        return _measure(recording, detection, args) | {
            "backend": detectors.backends[1] or args.backend,
            "warm_start": args.warm_start,
            "image_size_px": args.image_size,
            "view_size_px": args.view_size,
            "max_steps": config.max_steps,
        }


def _detectors(project: Project, args: Arguments) -> Detectors:
    """The project's detectors, loaded again if the network gets another size."""
    detectors = active_detectors(project, backend=args.backend)

    def resized(model: UsedModel, detector: Detector, size_px: int | None) -> Detector:
        return detector if size_px is None else load_detector(model.path, args.backend, size_px, names=model.names)

    image = resized(required_model(project, DetectorKind.IMAGE), detectors.image, args.image_size)
    return replace(
        detectors, image=image, view=resized(required_model(project, DetectorKind.VIEW), detectors.view, args.view_size)
    )


def _measure(recording: Recording, detection: LiveDetection, args: Arguments) -> dict[str, object]:
    warm_up = _Run(recording, detection, math.inf).figures(WARM_UP_S, None)
    rate = args.rate or max(LEAST_RATE, FASTER_BY * (warm_up.fps or 0.0))
    measured = _Run(recording, detection, rate)
    figures = measured.figures(args.seconds, args.frames)
    if figures.fps is None:
        raise ConfigError(
            f"only {amount(figures.shown, 'frame was', 'frames were')} shown, too few for a rate; raise --seconds or "
            "--frames"
        )
    return {
        "fps": figures.fps,
        "latency_ms": figures.latency_ms,
        "latency_p95_ms": figures.latency_p95_ms,
        "stages_ms": dict(figures.stages_ms),
        "shown": figures.shown,
        "drops": dict(figures.drops),
        "source_fps": rate,
        "objects_per_frame": measured.objects / measured.frames,
        "warm_share": measured.warm / max(measured.objects, 1),
    }


class _Run:
    """One run of the pipeline, with its own source and its own page."""

    def __init__(self, recording: Recording, detection: LiveDetection, rate: float) -> None:
        back_and_forth = cycle([*range(len(recording)), *range(len(recording) - 2, 0, -1)])  # motion without a jump
        self._source = Playback(recording, rate=rate, order=back_and_forth)
        self._detection = detection
        self.frames = self.objects = self.warm = 0

    def figures(self, seconds: float, frames: int | None) -> Figures:
        """Runs for a number of seconds, or for a number of frames of the source."""
        pipeline = Pipeline(self._source, self._detection.detect, self._show, max_frames=frames)
        pipeline.meter.window_s = math.inf
        self._page = LivePage(self._source.name, {})
        self._page.follow(pipeline)
        pipeline.start()
        try:
            is_over = pipeline.wait(None if frames is not None else seconds)
            while not is_over and pipeline.figures().shown < LEAST_SHOWN:
                is_over = pipeline.wait(0.1)
            return pipeline.figures()
        finally:
            pipeline.end()
            self._page.close()

    def _show(self, detected: Detected) -> None:
        proposals = detected.found.proposals
        # counts more frames than the figures, because some are shown while the pipeline ends
        self.frames += 1
        self.objects += len(proposals)
        self.warm += sum(map(is_warm, proposals))
        self._page.show(detected)


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    return [Table.of_figures(result)]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
