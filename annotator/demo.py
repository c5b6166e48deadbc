"""The demo: the whole loop on a generated recording, labelled by a simulated operator.

Without training, one 2D box per object is measured by the base detector and followed. With training, drawn boxes teach
two detectors, which propose boxes that are scored and exported.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from annotator import project as store
from annotator.detection.pretrained import has_base
from annotator.evaluation.report import Report
from annotator.geometry.iou import iou_3d_matrix
from annotator.geometry.outline import box_on_image
from annotator.project.changes import LabelChanged, Payload
from annotator.project.records import BoxRecord
from annotator.rcv.config import RcvConfig
from annotator.rcv.teach import TaughtObject
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.types import BoxKind, DetectorKind, Label, ReviewState, Source
from annotator.types.errors import ConfigError, DetectionError, StaleRevisionError, TrackTakenError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import active_detectors
from annotator.workflows.evaluate import Options, Protocol, evaluate_project
from annotator.workflows.exporting import ExportReport, export_project
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.annotate import AnnotateSummary, annotate
from annotator.workflows.proposing.lift import GivenBoxes, lift
from annotator.workflows.settings import rcv_config
from annotator.workflows.simulate import AUTHOR, Drawn, simulate_recording, visible_objects
from annotator.workflows.tracks.follow_run import follow_recording
from annotator.workflows.training.samples import SampleConfig
from annotator.workflows.training.train import IMAGE_DEFAULTS, VIEW_DEFAULTS, Trained, TrainPlan, train
from annotator.workflows.workbench.loaded_detectors import ReadyDetector, require_view

RECORDING, PROJECT = "recording", "demo"
LABELS = {"people": "person", "hands": "hand", "objects": "object"}
# People and objects stand upright; hands may be turned in any way.
ROTATIONS = {"people": store.BoxRotation.UPRIGHT, "hands": store.BoxRotation.FREE, "objects": store.BoxRotation.UPRIGHT}

Progress = Callable[[str, float, float], None]
"""Called with (stage, amount done, total amount)."""


@dataclass(frozen=True)
class Plan:
    """What is generated: the preset (people, hands or objects) and the length of the recording."""

    preset: str
    frames: int
    seed: int = 0


# With training: every second frame is labelled, and boxes are proposed on the others; the number of images shown to
# each detector, enough to find most objects after some minutes.
EVERY = 2
SHOWN = {DetectorKind.IMAGE: 2600, DetectorKind.VIEW: 19000}


class _Demo:
    """A run of the demo in a folder: its stages' progress, and their durations in seconds, by name."""

    def __init__(self, root: Path, plan: Plan, progress: Progress) -> None:
        self.root, self.plan, self.progress = root, plan, progress
        self.label = LABELS[plan.preset]
        self.dataset = root / f"3D_{self.label.upper()}"
        for path in (root / RECORDING, root / PROJECT, self.dataset):  # before minutes of work
            if path.exists():
                raise ConfigError(f"{path}: exists already; choose another folder for the demo")
        self.seconds: dict[str, float] = {}
        self._begin = time.perf_counter()

    def counted(self, stage: str) -> Callable[[int, int], None]:
        return lambda done, total: self.progress(stage, float(done), float(total))

    def end(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage], self._begin = now - self._begin, now

    @contextmanager
    def project(self) -> Iterator[tuple[store.Project, int]]:
        """Generates the recording, and yields a new project with it, without its labels, and its id there."""
        place, report = self.root / RECORDING, self.counted("ray-cast the recording")
        write_generated(place, self.plan.preset, self.plan.frames, self.plan.seed, report=report)
        self.end("generate")
        settings = store.ProjectSettings(rotation=ROTATIONS[self.plan.preset])
        with store.create_project(self.root, PROJECT, (self.label,), settings=settings) as project:
            yield project, register_recording(project, open_recording(place)).id

    def export(self, project: store.Project) -> ExportReport:
        return export_project(project, self.dataset, progress=self.counted("write the dataset"))


@dataclass(frozen=True)
class TrainedResult:
    """The result of each stage, and its duration by name."""

    drawn: Drawn
    trained: list[Trained]
    annotated: AnnotateSummary
    scores: Report
    dataset: ExportReport
    seconds: dict[str, float]


def run_trained(root: Path, plan: Plan, progress: Progress) -> TrainedResult:
    """Runs the loop in the folder `root`: `recording`, the project `demo`, and the dataset `3D_*`."""
    run = _Demo(root, plan, progress)
    with run.project() as (project, recording):
        config = rcv_config(project)
        drawn = simulate_recording(project, recording, BoxKind.BOX, config, EVERY, run.counted("draw 2D boxes"))
        run.end("label")
        trained = train(
            project,
            _training(),
            progress=lambda role, step: progress(f"train the {role} detector", step.epochs_done, step.epochs),
        )
        run.end("train")
        annotated = annotate(project, active_detectors(project), config, progress=run.counted("propose 3D boxes"))
        run.end("propose")
        name = project.recordings.get(recording).name
        unlabelled = [f"{name}/{f.key}" for n, f in enumerate(project.frames.of([recording])) if n % EVERY]
        scores = evaluate_project(project, Protocol.ORIENTED, options=Options(frames=unlabelled))
        dataset = run.export(project)
        run.end("score and export")
    return TrainedResult(drawn, trained, annotated, scores, dataset, run.seconds)


def _training() -> TrainPlan:
    return TrainPlan(
        image=IMAGE_DEFAULTS.model_copy(update={"pictures_seen": SHOWN[DetectorKind.IMAGE]}),
        view=VIEW_DEFAULTS.model_copy(update={"pictures_seen": SHOWN[DetectorKind.VIEW]}),
        samples=SampleConfig(views=320),
    )


# The operator accepts a proposal with at least this IoU, and adjusts a worse one.
GOOD_IOU = 0.5
# A proposal with a lower IoU is not recognised as the object, and rejected.
SAME_IOU = 0.1
# Objects with fewer points are left out.
MIN_POINTS = 100


@dataclass
class Reviewed:
    """What the operator did.

    Attributes:
        drawn: number of 2D boxes drawn.
        accepted, adjusted, rejected: number of proposed 3D boxes.
        placed: number of 3D boxes placed by hand, because nothing was proposed for a drawn box.
        ious: IoU of each accepted or adjusted proposal with the truth.
    """

    drawn: int = 0
    accepted: int = 0
    adjusted: int = 0
    rejected: int = 0
    placed: int = 0
    ious: list[float] = field(default_factory=list)

    @property
    def boxes(self) -> int:
        return self.accepted + self.adjusted + self.placed


class SimulatedOperator:
    """Labels one recording of a project. Where a viewer changes a frame at the same time, it is left to them."""

    def __init__(self, project: store.Project, recording_id: int) -> None:
        self.done = Reviewed()
        self._project, self._recording_id = project, recording_id
        self._source = FrameSource(project)
        self._recording = self._source.recording(recording_id)
        self._truths: dict[int, list[TaughtObject]] = {}

    def draw(self, stored: store.StoredFrame, view: ReadyDetector, config: RcvConfig) -> None:
        """Draws a 2D box around each object without a 3D box; 3D boxes of these objects are proposed."""
        context, camera = self._context(stored), self._source.read(stored).camera
        outlines = [box_on_image(camera, item.box, item.label) for item in self.missing(stored)]
        boxes = tuple(box for box in outlines if box is not None)
        known = next((drawn.boxes for drawn in self._project.boxes.on_images() if drawn.frame_id == stored.id), ())
        self._project.boxes.set_on_image(stored.id, [*known, *boxes], BoxKind.BOX, context)
        self.done.drawn += len(boxes)
        lift(self._project, GivenBoxes("boxes drawn on the images", {stored.id: boxes}, {}), view, config)

    def missing(self, stored: store.StoredFrame) -> list[TaughtObject]:
        """The visible objects of a frame without a reviewed 3D box."""
        truths, labels = self._objects(stored), self._labels(stored, store.REVIEWED)
        ious = _ious(labels, truths)
        return [truth for truth, iou in zip(truths, ious.max(axis=0, initial=0.0), strict=True) if iou < SAME_IOU]

    def review(self, stored: store.StoredFrame) -> list[int]:
        """Accepts, adjusts or rejects all proposals of a frame; returns the tracks of the adjusted ones."""
        context = self._context(stored)
        labels, truths = self._labels(stored, (ReviewState.PROPOSED,)), self._objects(stored)
        ious = _ious(labels, truths)
        payloads: list[Payload] = []
        taken: dict[int, float] = {}
        tracks: list[int | None] = []
        for index in np.argsort(-ious.max(axis=1, initial=0.0)).tolist():
            label, best = labels[index], int(ious[index].argmax()) if truths else -1
            iou = float(ious[index, best]) if truths else 0.0
            if iou < SAME_IOU or best in taken:
                payloads.append(LabelChanged(uid=label.uid, state=ReviewState.REJECTED))
                continue
            taken[best] = iou
            if iou >= GOOD_IOU:
                payloads.append(LabelChanged(uid=label.uid, state=ReviewState.ACCEPTED))
            else:
                box = BoxRecord.of(truths[best].box)
                payloads.append(LabelChanged(uid=label.uid, state=ReviewState.EDITED, box=box))
                tracks.append(label.track_id)
        if payloads:
            self._project.log.append(stored.id, payloads, context)
        self.done.accepted += len(taken) - len(tracks)
        self.done.adjusted += len(tracks)
        self.done.rejected += len(payloads) - len(taken)
        self.done.ious += taken.values()
        return [track for track in tracks if track is not None]

    def place(self, stored: store.StoredFrame) -> None:
        """Places the 3D boxes of objects for which nothing was proposed."""
        context = self._context(stored)
        new = [store.NewLabel(item.label, item.box, origin=store.Origin.PLACED) for item in self.missing(stored)]
        if new:
            self._project.labels.create(stored.id, new, context)
        self.done.placed += len(new)

    def track(self, stored: store.StoredFrame) -> list[int]:
        """Gives the reviewed boxes without a track new ones; returns these."""
        context = self._context(stored)
        untracked = [label for label in self._labels(stored, store.REVIEWED) if label.track_id is None]
        first = self._project.labels.next_track_id(self._recording_id)
        tracks = list(range(first, first + len(untracked)))
        payloads = [LabelChanged(uid=at.uid, track_id=track) for at, track in zip(untracked, tracks, strict=True)]
        if payloads:
            self._project.log.append_to_frames([store.FramePart(stored.id, payloads, context)], new_tracks=tracks)
        return tracks

    def reviewed_of(self, tracks: Sequence[int]) -> list[int]:
        """Returns the tracks that have a reviewed box; a viewer may have deleted those of the others."""
        chosen = self._project.labels.along(self._recording_id, states=store.REVIEWED, tracks=tracks)
        present = {stored.label.track_id for stored in chosen}
        return [track for track in tracks if track in present]

    def _context(self, stored: store.StoredFrame) -> store.WriteContext:
        """Of the frame as it is now; read before its labels, so that a change in between is noticed."""
        return store.WriteContext(self._project.frames.get(stored.id).revision, AUTHOR, Source.MANUAL)

    def _labels(self, stored: store.StoredFrame, states: Sequence[ReviewState]) -> list[Label]:
        return [label for label in self._project.labels.of_frame(stored.id) if label.state in states]

    def _objects(self, stored: store.StoredFrame) -> list[TaughtObject]:
        if stored.id not in self._truths:
            index = self._recording.keys.index(stored.key)
            found = visible_objects(self._recording, index, self._source.read(stored), self._project.config.classes)
            self._truths[stored.id] = [
                item for item in found if item.points is not None and item.points.sum() >= MIN_POINTS
            ]
        return self._truths[stored.id]


def _ious(labels: Sequence[Label], truths: Sequence[TaughtObject]) -> np.ndarray:
    """IoU of each label (row) with each true object (column)."""
    if not labels or not truths:
        return np.zeros((len(labels), len(truths)))
    return iou_3d_matrix([label.box for label in labels], [truth.box for truth in truths])


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
    root: Path, plan: Plan, progress: Progress, on_proposals: Callable[[], None] = lambda: None
) -> FirstDragResult:
    """Runs the demo in the folder `root`: `recording`, the project `demo`, and the dataset `3D_*`.

    Args:
        on_proposals: called when the first proposals are stored; never, if there is nothing to draw.
    """
    run = _Demo(root, plan, progress)
    if not has_base():
        raise DetectionError("this installation has no base detector; run the demo with --train")
    with run.project() as (project, recording):
        view, operator = require_view(project), SimulatedOperator(project, recording)
        frames = [frame for frame in project.frames.of([recording]) if frame.index is not None]
        report = run.counted("draw, follow and review")
        shown = False

        def first_boxes() -> None:
            nonlocal shown
            if not shown:
                shown = True
                run.end("first boxes")
                on_proposals()

        for number, stored in enumerate(frames, start=1):
            tracks: list[int] = []
            # a frame that a viewer has finalised, or changes, is left to them
            with suppress(StaleRevisionError, TrackTakenError):
                if not project.frames.get(stored.id).finalised:
                    tracks = _label(operator, stored, view, rcv_config(project), first_boxes)
            # a viewer may have deleted or doubled the boxes to follow; what is missing is drawn on the next frame
            with suppress(StaleRevisionError, TrackTakenError, ConfigError):
                if tracks and number < len(frames):
                    follow_recording(project, recording, None, AUTHOR, tracks=tracks)
            report(number, len(frames))
        run.end("follow and review")
        dataset = run.export(project)
        run.end("export")
    ious = operator.done.ious
    return FirstDragResult(operator.done, float(np.mean(ious)) if ious else 0.0, dataset, run.seconds)


def _label(
    operator: SimulatedOperator,
    stored: store.StoredFrame,
    view: ReadyDetector,
    config: RcvConfig,
    on_proposals: Callable[[], None],
) -> list[int]:
    tracks = operator.review(stored)
    if operator.missing(stored):
        operator.draw(stored, view, config)
        on_proposals()
        operator.review(stored)
        operator.place(stored)
        tracks += operator.track(stored)
    return operator.reviewed_of(tracks)
