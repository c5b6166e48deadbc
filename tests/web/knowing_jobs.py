"""Jobs for tests: a training of two epochs, and proposals by perfect detectors instead of trained ones.

The result of a short training depends on the processor; these proposals do not.
"""

from __future__ import annotations

from threading import Lock

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.recordings import open_recording
from annotator.types import BoxKind
from annotator.web.jobs import work
from annotator.web.jobs.records import BoxesRequest, JobContext, Outcome, ProposeRequest, TrainRequest
from annotator.workflows.detectors import Detectors
from annotator.workflows.proposing.runner import InlineEngine
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

EPOCHS = 2


def train(job: JobContext, request: TrainRequest) -> Outcome:
    """`train_work` from random weights, with fewer epochs than the 10 that a page can ask for."""
    short = {"epochs": EPOCHS, "pretrained": "never"}
    image, view = (config.model_copy(update=short) for config in (work.image_defaults(), work.VIEW_DEFAULTS))
    work.image_defaults = lambda minutes: image
    work.VIEW_DEFAULTS = view
    return work.train_work(job, request)


def propose(job: JobContext, request: ProposeRequest) -> Outcome:
    """`propose_work` with perfect detectors."""
    knows = _perfect(job)
    source = Detectors(knows, knows, BoxKind.BOX)
    # a worker process runs only one job, so patches need not be undone
    work.trained_detectors = lambda _: source  # type: ignore[assignment]
    work.make_engine = lambda *_, **__: InlineEngine(source)  # type: ignore[assignment]
    return work.propose_work(job, request)


def boxes(job: JobContext, request: BoxesRequest) -> Outcome:
    """`boxes_work` with a perfect view detector."""
    view = ReadyDetector(_perfect(job), BoxKind.BOX, Lock())
    work.require_view = lambda _: view  # type: ignore[assignment]
    return work.boxes_work(job, request)


def _perfect(job: JobContext) -> PerfectDetector:
    scenes = []
    for recording in [open_recording(stored.path) for stored in job.project.recordings.all()]:
        for index in range(len(recording)):
            frame = recording.frame(index)
            scenes.append(Scene.of(frame, load_truth(recording, index, frame)))
    return PerfectDetector(scenes, BoxKind.BOX, min_points=50)
