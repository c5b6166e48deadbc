"""The demo without training: one 2D box per object, measured by the base detector and followed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from annotator.demo.reviewing import Reviewed, SimulatedOperator
from annotator.demo.stages import (
    Progress,
    Stopwatch,
    add_recording,
    counted,
    dataset_folder,
    generate,
    new_project,
    require_free,
)
from annotator.detection.pretrained import has_base
from annotator.project import StoredFrame
from annotator.rcv.config import RcvConfig
from annotator.types.errors import ConfigError, DetectionError, StaleRevisionError, TrackTakenError
from annotator.workflows.exporting import ExportReport, export_project
from annotator.workflows.settings import rcv_config
from annotator.workflows.simulate import AUTHOR
from annotator.workflows.tracks.follow_recording import follow_recording
from annotator.workflows.workbench.loaded_detectors import ReadyDetector, require_view


@dataclass(frozen=True)
class FirstDragPlan:
    """Settings of the demo without training.

    Attributes:
        preset: people, hands or objects.
        frames: length of the recording.
    """

    preset: str = "people"
    frames: int = 24
    seed: int = 0


@dataclass(frozen=True)
class FirstDragResult:
    """What the operator did, how good the proposals were, and the duration of each stage.

    Attributes:
        reviewed: the operator's work.
        mean_iou: of the proposals, before the review.
        dataset: the export.
        seconds: of each stage, by name.
    """

    reviewed: Reviewed
    mean_iou: float
    dataset: ExportReport
    seconds: dict[str, float]


def run_first_drag(
    root: Path, plan: FirstDragPlan, progress: Progress, on_proposals: Callable[[], None] = lambda: None
) -> FirstDragResult:
    """Runs the demo in the folder `root`: `recording`, the project `demo`, and the dataset `3D_*`.

    Args:
        on_proposals: called when the first proposals are stored; never, if there is nothing to draw.

    Raises:
        ConfigError, ProjectError: a file or folder of that name exists.
        DetectionError: this installation has no base detector.
    """
    require_free(root, plan.preset)
    if not has_base():
        raise DetectionError("this installation has no base detector; run the demo with --train")
    watch = Stopwatch()
    generate(root, plan.preset, plan.frames, plan.seed, progress)
    watch.end("generate")
    with new_project(root, plan.preset) as project:
        recording = add_recording(project, root)
        view, operator = require_view(project), SimulatedOperator(project, recording)
        frames = [frame for frame in project.frames.of([recording]) if frame.index is not None]
        report = counted(progress, "draw, follow and review")
        shown = False

        def first_boxes() -> None:
            nonlocal shown
            if not shown:
                shown = True
                watch.end("first boxes")
                on_proposals()

        for number, stored in enumerate(frames, start=1):
            tracks: list[int] = []
            # a frame that a viewer has finalised, or changes again and again, is left to them
            with suppress(StaleRevisionError, TrackTakenError):
                if not project.frames.get(stored.id).finalised:
                    tracks = _label(operator, stored, view, rcv_config(project), first_boxes)
            # a viewer may have deleted or doubled the boxes to follow; what is missing is drawn on the next frame
            with suppress(StaleRevisionError, TrackTakenError, ConfigError):
                if tracks and number < len(frames):
                    follow_recording(project, recording, None, AUTHOR, tracks=tracks)
            report(number, len(frames))
        watch.end("follow and review")
        dataset = export_project(
            project, dataset_folder(root, plan.preset), progress=counted(progress, "write the dataset")
        )
        watch.end("export")
    ious = operator.done.ious
    return FirstDragResult(operator.done, float(np.mean(ious)) if ious else 0.0, dataset, watch.seconds)


def _label(
    operator: SimulatedOperator,
    stored: StoredFrame,
    view: ReadyDetector,
    config: RcvConfig,
    on_proposals: Callable[[], None],
) -> list[int]:
    """Reviews a frame, and draws what is missing; returns the tracks to follow from here."""
    tracks = operator.review(stored)
    if operator.missing(stored):
        operator.draw(stored, view, config)
        on_proposals()
        operator.review(stored)
        operator.place(stored)
        tracks += operator.track(stored)
    return operator.reviewed_of(tracks)
