"""The whole loop: a simulated operator labels frames, both detectors are trained, and RCV proposes on other frames.

    python -m benchmarks.loop TRAIN_DIR [TEST_DIR] [--operator silhouette|box] [--upright | --free]
        [--weights never] [--minutes N] [--model yolov5nu] [--json]

With one folder, every second frame is for training and the others for testing. The ground truth is used only by the
simulated operator on the training frames and to score the proposals on the test frames. The operator `silhouette` draws
what is seen, and then confirms those of the offered whole boxes that fit. It works with
masks only; there are then no whole boxes, and the scores that need true boxes are null.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from annotator.detection.config import Backend
from annotator.evaluation.boxes import BoxTable, evaluate_oriented
from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import contains
from annotator.project import (
    REVIEWED,
    BoxRotation,
    NewLabel,
    Origin,
    Project,
    ProjectSettings,
    WriteContext,
    create_project,
    open_project,
)
from annotator.rcv.config import RcvConfig, Strategy
from annotator.rcv.finish import FrameProposals
from annotator.recordings import Recording, open_recording
from annotator.types import BoxKind, DetectorKind, Frame, OrientedBox, Source
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors, active_detectors
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.annotate import TASK_FRAMES
from annotator.workflows.proposing.lift import propose_image_boxes
from annotator.workflows.recorded.reading import has_masks, has_truth, load_mask, load_truth
from annotator.workflows.settings import rcv_config
from annotator.workflows.simulate import AUTHOR, image_box_of, require_boxes_for, simulate_recording, visible_objects
from annotator.workflows.training import held_out
from annotator.workflows.training.samples import SampleConfig
from annotator.workflows.training.train import VIEW_DEFAULTS, TrainPlan, image_defaults, train
from annotator.workflows.workbench.drawing_steps import WholeBoxes
from annotator.workflows.workbench.loaded_detectors import ready_view
from benchmarks.report import QUIET, BoxOptions, Table, guarded, print_epoch, program


@dataclass(eq=False)
class Scores:
    """Accumulates the scores of the test frames.

    A frame without an object counts only in average precision, where its proposals are false positives. An unreadable
    frame only counts as a frame without a proposal, since its number of objects is unknown. Without true boxes, masks
    are used instead, and IoU and average precision are NaN.

    `frames` counts those with an object and the unreadable ones, `with_proposal` those of them with a proposal. `found`
    and `true` are rows of `BoxTable`. `recalls` (share of an object's points inside proposals) and `precisions` (share
    of the points inside proposals that belong to an object) have one value for each frame with a mask.
    """

    recording: Recording
    labels: Sequence[str]
    frames: int = 0
    with_proposal: int = 0
    recalls: list[float] = field(default_factory=list)
    precisions: list[float] = field(default_factory=list)
    found: list[tuple[int, str, OrientedBox, float]] = field(default_factory=list)
    true: list[tuple[int, str, OrientedBox, float]] = field(default_factory=list)

    def add(self, index: int, frame: Frame, proposed: FrameProposals) -> None:
        """Counts the proposals of one test frame."""
        mask = load_mask(self.recording, frame)
        boxed = mask is None or has_truth(self.recording)
        truths = [t for t in load_truth(self.recording, index, frame) if t.label in self.labels] if boxed else []
        self.found += [(index, p.label, p.box, p.score) for p in proposed.proposals]
        self.true += [(index, t.label, t.box, 1.0) for t in truths]
        if not (truths or (not boxed and mask is not None and mask.any())):
            return
        self.frames += 1
        self.with_proposal += bool(proposed.proposals)
        if mask is not None and frame.cloud.pixel_index is not None:
            of_object = mask.ravel()[frame.cloud.pixel_index] > 0
            inside = np.zeros(len(frame.cloud), bool)
            for each in proposed.proposals:
                inside |= contains(each.box, frame.cloud.xyz_m)
            both = int((inside & of_object).sum())
            self.recalls.append(both / max(int(of_object.sum()), 1))
            self.precisions.append(both / max(int(inside.sum()), 1))

    def summary(self) -> dict[str, object]:
        """The mean scores, by name; NaN without measurements."""
        result = evaluate_oriented(BoxTable.of(self.found), BoxTable.of(self.true))
        return {
            "frames": self.frames,
            "share_with_proposal": self.with_proposal / max(self.frames, 1),
            "mask_recall": _mean(self.recalls),
            "mask_precision": _mean(self.precisions),
            "mean_iou": _mean([c.mean_iou for c in result.classes.values() for _ in range(c.objects)]),
            "ap25": result.mean(0.25),
            "ap50": result.mean(0.5),
        }


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


NAME = "loop"
FITS_IOU = 0.5
# Class of the objects in a folder with masks only.
UNNAMED = "object"


@dataclass
class Arguments(BoxOptions):
    train_dir: Annotated[Path, tyro.conf.Positional]
    """A recording with ground truth (boxes, or masks for the silhouette operator)."""
    test_dir: Annotated[Path | None, tyro.conf.Positional] = None
    """A recording to test on; None = every second frame of the first recording."""
    operator: BoxKind | None = None
    """What the simulated operator draws: silhouette = boxes around the visible part (default with masks alone), box =
    projected true boxes (default otherwise)."""
    axes: Strategy = Strategy.CONSENSUS
    """Axes strategy of the recursion."""
    epochs: int | None = None
    """Epochs of both training runs; None = as many as show the default number of images."""
    model: str | None = None
    """Name of an ultralytics detection model for both detectors; None = the default of each."""
    weights: Literal["auto", "never"] = "auto"
    """What the view detector starts from: auto = the base detector, never = random weights."""
    backend: Backend = "auto"
    """Backend of the detectors."""
    minutes: float | None = None
    """Length of the view detector's training, minutes; beyond three, the image detector learns longer, too; None = the
    default."""
    views: int = SampleConfig().views
    """Approximate number of pseudo-views to generate from objects with 3D boxes."""
    project: Path | None = None
    """Folder in which to keep the project. If it exists, its detectors are used, for example to compare strategies."""

    def settings(self, config: RcvConfig) -> RcvConfig:
        """The project's settings, changed by the arguments."""
        return config.model_copy(update={"strategy": self.axes})


def run(args: Arguments) -> dict[str, Any]:
    recording = open_recording(args.train_dir)
    test = recording if args.test_dir is None else open_recording(args.test_dir)
    if not (has_truth(test) or has_masks(test)):
        raise ConfigError(f"{test.path}: has neither true boxes nor masks to score against")
    step = 2 if args.test_dir is None else 1
    frames = list(range(step - 1, len(test), step))
    seconds: dict[str, float] = {}
    with trained_project(args, recording, step, seconds) as (project, boxes_2d):
        begin = time.perf_counter()
        detectors = active_detectors(project, backend=args.backend)
        config = args.settings(rcv_config(project))
        scores = Scores(test, project.config.classes)
        _propose_all(frames, detectors, config, project.config.settings.rotation, scores)
        seconds["propose"] = time.perf_counter() - begin
        operator = _box_kind(project)
        whole_boxes = sum(one.origin is Origin.DRAWN for one in project.labels.select(states=REVIEWED))
    return {
        **scores.summary(),
        "boxes_2d": boxes_2d,
        "operator": operator,
        "whole_boxes": whole_boxes,
        "box_kind": detectors.box_kind.value,
        "axes": args.axes.value,
        "backend": args.backend,
        "seconds": seconds,
    }


@contextmanager
def trained_project(
    args: Arguments, recording: Recording, step: int, seconds: dict[str, float]
) -> Iterator[tuple[Project, int]]:
    """A project whose detectors are trained on every `step`-th frame of a recording, and its number of 2D boxes.

    `seconds` receives the seconds of labelling and training, if this run does them.
    """
    with TemporaryDirectory() as temporary, _project(args, recording, Path(temporary)) as project:
        yield project, _label_and_train(project, recording, step, args, seconds)


def _labels(recording: Recording) -> list[str]:
    """The classes of a new project: those of the true boxes; with masks only, one without a name."""
    if _masks_alone(recording):
        return [UNNAMED]
    labels: set[str] = set()
    for index in range(len(recording)):
        try:
            frame = recording.frame(index)
        except FrameError:
            continue  # reported later, by labelling or by proposing
        labels.update(truth.label for truth in load_truth(recording, index, frame))
    if not labels:
        raise ConfigError(f"{recording.path}: has no true boxes to train on and to score against")
    return sorted(labels)


def _masks_alone(recording: Recording) -> bool:
    return has_masks(recording) and not has_truth(recording)


def _project(args: Arguments, recording: Recording, temporary: Path) -> Project:
    """A new project, or that of an earlier run, whose labels and detectors do not change."""
    root = args.project or temporary
    if not (root / NAME).is_dir():
        if args.operator is not None:
            require_boxes_for(args.operator, recording)
        settings = ProjectSettings(rotation=args.rotation)
        return create_project(root, NAME, _labels(recording), settings=settings)
    return open_project(root / NAME)


def _box_kind(project: Project) -> BoxKind | None:
    """The kind of 2D boxes that the operator has drawn; None without labels."""
    return next((boxes.box_kind for boxes in project.boxes.on_images()), None)


def _label_and_train(
    project: Project, recording: Recording, step: int, args: Arguments, seconds: dict[str, float]
) -> int:
    """Labels and trains, unless an earlier run has; returns the number of 2D boxes in the project."""
    if project.models.active(DetectorKind.VIEW) is None:
        default = BoxKind.SILHOUETTE if _masks_alone(recording) else BoxKind.BOX
        operator = args.operator or _box_kind(project) or default
        _label(project, recording, step, operator, plan(args).view.image_size_px, seconds)
        held_out.is_held_out = lambda *_: False  # type: ignore[attr-defined]  # all labelled frames train
        for trained in train(project, plan(args), progress=print_epoch):
            project.models.activate(trained.model.id)
            seconds[f"train_{trained.role}"] = trained.seconds
            QUIET.print(f"{trained.role}: {trained.manifest.images['train']} images, {trained.result.metrics}")
    counts = project.statistics()
    return counts.image_boxes.boxes + counts.view_boxes.boxes


def _label(
    project: Project, recording: Recording, step: int, operator: BoxKind, size_px: int, seconds: dict[str, float]
) -> None:
    """Labels every `step`-th frame, unless an interrupted earlier run has labelled all of them."""
    begin = time.perf_counter()
    stored = register_recording(project, recording)
    to_label = {frame.id for frame in [f for f in project.frames.of([stored.id]) if f.index is not None][::step]}
    if to_label <= {boxes.frame_id for boxes in project.boxes.on_images([stored.id])}:
        return
    simulate_recording(project, stored.id, operator, rcv_config(project, view_px=size_px), step)
    if operator is BoxKind.SILHOUETTE and has_truth(recording):
        _confirm_whole_boxes(project, recording, stored.id)
    seconds["label"] = time.perf_counter() - begin


def _confirm_whole_boxes(project: Project, recording: Recording, recording_id: int) -> None:
    """Confirms the offered whole boxes that fit drawn objects, and never corrects them."""
    source, offers, detector = FrameSource(project), WholeBoxes(project), ready_view(project)
    indices, labelled = {key: index for index, key in enumerate(recording.keys)}, project.boxes.frames_with_images()
    for stored in [one for one in project.frames.of([recording_id]) if one.index is not None and one.id in labelled]:
        frame, new = source.read(stored), []
        for item in visible_objects(recording, indices[stored.key], frame, project.config.classes):
            image_box = image_box_of(frame, item, BoxKind.SILHOUETTE)
            offered = [] if image_box is None else offers.of(frame, stored, image_box, detector)
            fits = [iou_3d(item.box, one.box) for one in offered]
            if fits and max(fits) >= FITS_IOU:
                box = offered[fits.index(max(fits))].box
                new.append(NewLabel(item.label, box, origin=Origin.DRAWN, image_box=image_box))
        if new:
            context = WriteContext(project.frames.get(stored.id).revision, AUTHOR, Source.MANUAL)
            project.labels.create(stored.id, new, context)


def plan(args: Arguments) -> TrainPlan:
    """The settings of both training runs."""
    changes = dict[str, object](epochs=args.epochs)
    if args.model is not None:
        changes["model"] = args.model
    return TrainPlan(
        image=image_defaults(args.minutes).model_copy(update=changes),
        view=VIEW_DEFAULTS.model_copy(update=changes | {"pretrained": args.weights}),
        samples=SampleConfig(views=args.views),
        minutes=args.minutes,
    )


def _propose_all(
    frames: Sequence[int], detectors: Detectors, config: RcvConfig, rotation: BoxRotation, scores: Scores
) -> None:
    for first in range(0, len(frames), TASK_FRAMES):
        read: dict[int, Frame] = {}
        for index in frames[first : first + TASK_FRAMES]:
            try:
                read[index] = scores.recording.frame(index)
            except FrameError as error:
                QUIET.print(f"counted as a frame without a proposal: {error}")
                scores.frames += 1
        results = propose_frames(list(read.values()), detectors, config, rotation)
        for (index, frame), proposed in zip(read.items(), results, strict=True):
            scores.add(index, frame, proposed)


def propose_frames(
    frames: Sequence[Frame], detectors: Detectors, config: RcvConfig, rotation: BoxRotation
) -> list[FrameProposals]:
    """The proposals of each frame, in the given order."""
    boxes = detectors.image.detect(frames) if frames else []
    return propose_image_boxes(frames, boxes, detectors.view, detectors.settings(config), rotation)


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    return [Table.of_figures(result)]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
