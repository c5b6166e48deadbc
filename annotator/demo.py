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
from typing import TypeVar

import numpy as np

from annotator import project as store
from annotator.detection.pretrained import has_base
from annotator.evaluation.report import Report
from annotator.geometry.iou import iou_3d_matrix
from annotator.geometry.outline import box_on_image
from annotator.project.changes import LabelAccepted, LabelEdited, LabelRejected, LabelTracked, Payload
from annotator.project.records import BoxRecord
from annotator.rcv.config import RcvConfig
from annotator.rcv.teach import TaughtObject
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.types import Box2D, BoxKind, DetectorKind, Label, ReviewState, Source
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


@dataclass
class Stopwatch:
    """The duration of each stage, seconds, by name."""

    seconds: dict[str, float] = field(default_factory=dict)
    _begin: float = field(default_factory=time.perf_counter)

    def end(self, stage: str) -> None:
        """Ends a stage, and begins the next."""
        now = time.perf_counter()
        self.seconds[stage] = now - self._begin
        self._begin = now


def counted(progress: Progress, stage: str) -> Callable[[int, int], None]:
    """The progress of a stage whose steps are counted."""
    return lambda done, total: progress(stage, float(done), float(total))


def dataset_folder(root: Path, preset: str) -> Path:
    return root / f"3D_{LABELS.get(preset, preset).upper()}"


def require_free(root: Path, preset: str) -> None:
    """Checks that the demo overwrites nothing, before minutes of work."""
    for path in (root / RECORDING, root / PROJECT, dataset_folder(root, preset)):
        if path.exists():
            raise ConfigError(f"{path}: exists already; choose another folder for the demo")


@dataclass(frozen=True)
class Plan:
    """What is generated.

    Attributes:
        preset: people, hands or objects.
        frames: length of the recording.
    """

    preset: str
    frames: int
    seed: int = 0


# With training: every second frame is labelled, and boxes are proposed on the others; the number of images shown to
# each detector, enough to find most objects after some minutes.
EVERY = 2
SHOWN = {DetectorKind.IMAGE: 2600, DetectorKind.VIEW: 19000}


@contextmanager
def _begun(root: Path, plan: Plan, watch: Stopwatch, progress: Progress) -> Iterator[tuple[store.Project, int]]:
    """Generates the recording, and yields a new project with it, without its labels, and its id there."""
    write_generated(
        root / RECORDING, plan.preset, plan.frames, plan.seed, report=counted(progress, "ray-cast the recording")
    )
    watch.end("generate")
    settings = store.ProjectSettings(rotation=ROTATIONS[plan.preset])
    with store.create_project(root, PROJECT, (LABELS[plan.preset],), settings=settings) as project:
        yield project, register_recording(project, open_recording(root / RECORDING)).id


def _exported(project: store.Project, root: Path, plan: Plan, progress: Progress) -> ExportReport:
    out = dataset_folder(root, plan.preset)
    return export_project(project, out, progress=counted(progress, "write the dataset"))


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
    require_free(root, plan.preset)
    watch = Stopwatch()
    with _begun(root, plan, watch, progress) as (project, recording):
        config = rcv_config(project)
        report = counted(progress, "draw 2D boxes")
        drawn = simulate_recording(project, recording, BoxKind.BOX, config, EVERY, report)
        watch.end("label")
        trained = train(
            project,
            _training(),
            progress=lambda role, step: progress(f"train the {role} detector", step.epochs_done, step.epochs),
        )
        watch.end("train")
        annotated = annotate(project, active_detectors(project), config, progress=counted(progress, "propose 3D boxes"))
        watch.end("propose")
        name = project.recordings.get(recording).name
        unlabelled = [f"{name}/{f.key}" for n, f in enumerate(project.frames.of([recording])) if n % EVERY]
        scores = evaluate_project(project, Protocol.ORIENTED, options=Options(frames=unlabelled))
        dataset = _exported(project, root, plan, progress)
        watch.end("score and export")
    return TrainedResult(drawn, trained, annotated, scores, dataset, watch.seconds)


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
# If a viewer changes a frame while the operator does, it is read and changed again, at most so often.
TRIES = 5

Changed = TypeVar("Changed")


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
        """Number of reviewed 3D boxes."""
        return self.accepted + self.adjusted + self.placed


class SimulatedOperator:
    """Labels one recording of a project."""

    def __init__(self, project: store.Project, recording_id: int) -> None:
        self.done = Reviewed()
        self._project, self._recording_id = project, recording_id
        self._source = FrameSource(project)
        self._recording = self._source.recording(recording_id)
        self._truths: dict[int, list[TaughtObject]] = {}

    def draw(self, stored: store.StoredFrame, view: ReadyDetector, config: RcvConfig) -> None:
        """Draws a 2D box around each object without a 3D box; 3D boxes of these objects are proposed."""
        camera = self._source.read(stored).camera

        def draw(context: store.WriteContext) -> tuple[Box2D, ...]:
            outlines = [box_on_image(camera, item.box, item.label) for item in self.missing(stored)]
            boxes = tuple(box for box in outlines if box is not None)
            known = next((drawn.boxes for drawn in self._project.boxes.on_images() if drawn.frame_id == stored.id), ())
            self._project.boxes.set_on_image(stored.id, [*known, *boxes], BoxKind.BOX, context)
            return boxes

        boxes = self._changed(stored, draw)
        self.done.drawn += len(boxes)
        lift(self._project, GivenBoxes("boxes drawn on the images", {stored.id: boxes}, {}), view, config)

    def missing(self, stored: store.StoredFrame) -> list[TaughtObject]:
        """The visible objects of a frame without a reviewed 3D box."""
        truths, labels = self._objects(stored), self._labels(stored, store.REVIEWED)
        ious = _ious(labels, truths)
        return [truth for truth, iou in zip(truths, ious.max(axis=0, initial=0.0), strict=True) if iou < SAME_IOU]

    def review(self, stored: store.StoredFrame) -> list[int]:
        """Accepts, adjusts or rejects all proposals of a frame; returns the tracks of the adjusted ones."""
        return self._changed(stored, lambda context: self._review(stored, context))

    def _review(self, stored: store.StoredFrame, context: store.WriteContext) -> list[int]:
        labels, truths = self._labels(stored, (ReviewState.PROPOSED,)), self._objects(stored)
        ious = _ious(labels, truths)
        payloads: list[Payload] = []
        taken: set[int] = set()
        tracks: list[int] = []
        accepted = adjusted = rejected = 0
        kept: list[float] = []
        for index in np.argsort(-ious.max(axis=1, initial=0.0)).tolist():
            label, best = labels[index], int(ious[index].argmax()) if truths else -1
            iou = float(ious[index, best]) if truths else 0.0
            if iou < SAME_IOU or best in taken:
                payloads.append(LabelRejected(uid=label.uid))
                rejected += 1
                continue
            taken.add(best)
            kept.append(iou)
            if iou >= GOOD_IOU:
                payloads.append(LabelAccepted(uid=label.uid))
                accepted += 1
            else:
                box = BoxRecord.of(truths[best].box)
                payloads.append(LabelEdited(uid=label.uid, label=label.label, box=box, track_id=label.track_id))
                adjusted += 1
                tracks += [] if label.track_id is None else [label.track_id]
        if payloads:
            self._project.log.append(stored.id, payloads, context)
        done = self.done
        done.accepted, done.adjusted = done.accepted + accepted, done.adjusted + adjusted
        done.rejected, done.ious = done.rejected + rejected, done.ious + kept
        return tracks

    def place(self, stored: store.StoredFrame) -> None:
        """Places the 3D boxes of objects for which nothing was proposed."""

        def place(context: store.WriteContext) -> int:
            new = [store.NewLabel(item.label, item.box, origin=store.Origin.PLACED) for item in self.missing(stored)]
            if new:
                self._project.labels.create(stored.id, new, context)
            return len(new)

        self.done.placed += self._changed(stored, place)

    def track(self, stored: store.StoredFrame) -> list[int]:
        """Gives the reviewed boxes without a track new ones; returns these."""

        def track(context: store.WriteContext) -> list[int]:
            untracked = [label for label in self._labels(stored, store.REVIEWED) if label.track_id is None]
            first = self._project.labels.next_track_id(self._recording_id)
            tracks = list(range(first, first + len(untracked)))
            payloads = [LabelTracked(uid=at.uid, track_id=track) for at, track in zip(untracked, tracks, strict=True)]
            if payloads:
                self._project.log.append_to_frames([store.FramePart(stored.id, payloads, context)], new_tracks=tracks)
            return tracks

        return self._changed(stored, track)

    def reviewed_of(self, tracks: Sequence[int]) -> list[int]:
        """Returns the tracks that have a reviewed box; a viewer may have deleted those of the others."""
        chosen = self._project.labels.along(self._recording_id, states=store.REVIEWED, tracks=tracks)
        present = {stored.label.track_id for stored in chosen}
        return [track for track in tracks if track in present]

    def _changed(self, stored: store.StoredFrame, change: Callable[[store.WriteContext], Changed]) -> Changed:
        """Changes a frame as it is now. If a viewer of the workbench is faster, the frame is read and changed again."""
        for attempt in range(TRIES):
            # the revision is read before the labels, so that a change in between is noticed
            context = store.WriteContext(self._project.frames.get(stored.id).revision, AUTHOR, Source.MANUAL)
            try:
                return change(context)
            except (StaleRevisionError, TrackTakenError):
                if attempt == TRIES - 1:
                    raise
        raise AssertionError

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
    require_free(root, plan.preset)
    if not has_base():
        raise DetectionError("this installation has no base detector; run the demo with --train")
    watch = Stopwatch()
    with _begun(root, plan, watch, progress) as (project, recording):
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
        dataset = _exported(project, root, plan, progress)
        watch.end("export")
    ious = operator.done.ious
    return FirstDragResult(operator.done, float(np.mean(ious)) if ious else 0.0, dataset, watch.seconds)


def _label(
    operator: SimulatedOperator,
    stored: store.StoredFrame,
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
