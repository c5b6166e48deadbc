"""Oriented 3D boxes of frames in memory, and from 2D boxes on the images, without any training of a view detector.

The 2D boxes come from a file, or are those that were drawn in the project. A 2D detector of any origin takes the place
of the project's image detector in `annotate` (`RenamedDetector`).
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from annotator.formats.table import FlatFormat
from annotator.project import Project, new_action
from annotator.project.config import BoxRotation
from annotator.rcv.config import REVISION, Orientation, RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.propose import propose_from_boxes
from annotator.types import Box2D, BoxKind, Detector, Frame, Image
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import MOST_LISTED, first_few
from annotator.workflows.detectors import LIFTED_FROM
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.importing.pictures import checked_images, read_pictures
from annotator.workflows.importing.placing import OwnClasses
from annotator.workflows.importing.report import Become, ImportReport, Note
from annotator.workflows.proposing.annotate import AnnotateSummary, Batch
from annotator.workflows.proposing.runner import failure
from annotator.workflows.proposing.still_votes import AUTHOR
from annotator.workflows.proposing.tasks import FrameAnswer
from annotator.workflows.workbench.loaded_detectors import ReadyDetector


def propose_image_boxes(
    frames: Sequence[Frame],
    image_boxes: Sequence[Sequence[Box2D]],
    view_detector: Detector,
    config: RcvConfig,
    rotation: BoxRotation,
) -> list[FrameProposals]:
    """Returns the proposals of each frame from its boxes on the image, in the given order.

    Args:
        config: with the settings of the detector; the orientation is set here.
        rotation: the rotations that boxes may have; AUTO depends on the frame's up direction.
    """
    results: dict[int, FrameProposals] = {}
    for orientation in Orientation:
        indices = [i for i, frame in enumerate(frames) if orientation_for(rotation, frame) is orientation]
        if indices:
            settings = config.model_copy(update={"orientation": orientation})
            chosen, boxes = [frames[i] for i in indices], [image_boxes[i] for i in indices]
            results |= zip(indices, propose_from_boxes(chosen, boxes, view_detector, settings), strict=True)
    return [results[index] for index in range(len(frames))]


Progress = Callable[[int, int], None]
"""Called with (frames done, frames)."""


@dataclass(frozen=True, eq=False)
class GivenBoxes:
    """2D boxes on the images of frames.

    Attributes:
        origin: where they come from, for the record of the run.
        of_frame: the boxes on the image of each frame, by frame id.
        silhouettes: the frames whose boxes enclose what is seen; the others enclose the projected 3D box.
        left_out: images and boxes that are not used, and a recording that was matched with one of another name.
    """

    origin: str
    of_frame: Mapping[int, tuple[Box2D, ...]]
    silhouettes: Collection[int] = ()
    left_out: ImportReport = field(default_factory=lambda: ImportReport(Become.FLAT))


def drawn_boxes(project: Project, only_without_labels: bool = False) -> GivenBoxes:
    """Returns the boxes that were drawn or imported on the project's images."""
    drawn = [on_image for on_image in project.boxes.on_images() if on_image.boxes]
    boxes = {on_image.frame_id: on_image.boxes for on_image in drawn}
    silhouettes = {on_image.frame_id for on_image in drawn if on_image.box_kind is BoxKind.SILHOUETTE}
    if only_without_labels:
        without = project.boxes.frames_without_labels()
        # a box may have been drawn since the first read
        boxes = {frame_id: boxes[frame_id] for frame_id in without if frame_id in boxes}
        if not boxes:
            raise ConfigError(f"project {project.config.name}: no frame has boxes on its image but no 3D box")
    if not boxes:
        raise ConfigError(
            f"project {project.config.name} has no boxes on its images; give --boxes or --detector, or draw some"
        )
    return GivenBoxes("boxes drawn on the images", boxes, silhouettes)


def boxes_of_file(
    project: Project,
    path: Path,
    format: FlatFormat,
    recording: str | None,
    names: Mapping[str, str],
    kind: BoxKind = BoxKind.SILHOUETTE,
) -> GivenBoxes:
    """Returns the boxes of a COCO or YOLO dataset of camera images.

    Args:
        recording: name of the recording of the images, if several recordings have such frames.
        names: the project's class of each class of the file; classes that are not listed keep their names.
        kind: what the boxes enclose.
    """
    dataset = read_pictures(format, path)
    images, placed, unreadable = checked_images(project, dataset, dataset.pictures, recording)
    classes, left_out = OwnClasses(project.config.classes, names), ImportReport(Become.FLAT)
    of_frame: dict[int, tuple[Box2D, ...]] = {}
    for image in images:
        own = [(box, classes.of(box.label)) for box in image.boxes]
        of_frame[image.frame_id] = tuple(replace(box, label=label) for box, label in own if label is not None)
        left_out.add_all(Note.OTHER_CLASS, [box.label for box, label in own if label is None])
    if not any(of_frame.values()):
        wanted, others = ", ".join(project.config.classes), _listed(left_out.of(Note.OTHER_CLASS))
        raise FormatError(
            path, f"has no box of the classes {wanted}, only {others}; map its classes to those of the project"
        )
    silhouettes = of_frame if kind is BoxKind.SILHOUETTE else ()
    if placed.renamed is not None:
        left_out.add(Note.RENAMED, of=str(placed.renamed))
    left_out.add_all(Note.UNMATCHED_IMAGE, placed.unmatched)
    left_out.add_all(Note.UNREADABLE, unreadable)
    return GivenBoxes(f"boxes of {path.name}", of_frame, silhouettes, left_out)


class RenamedDetector:
    """A 2D detector under the project's class names; its other classes are left out."""

    def __init__(self, detector: Detector, classes: Sequence[str], names: Mapping[str, str]) -> None:
        self._detector = detector
        self._names = {label: names.get(label, label) for label in detector.labels}
        self._classes = set(classes)
        self.labels = tuple(sorted(self._classes & set(self._names.values())))
        if not self.labels:
            raise ConfigError(
                f"the detector has none of the classes {', '.join(classes)}, but {_listed(detector.labels)}; "
                "map its classes with --classes"
            )
        self.fingerprint = hashlib.sha256(f"{detector.fingerprint} {sorted(self._names.items())}".encode()).hexdigest()

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        return [
            [replace(box, label=self._names[box.label]) for box in boxes if self._names[box.label] in self._classes]
            for boxes in self._detector.detect(images)
        ]


def lift(
    project: Project,
    boxes: GivenBoxes,
    view: ReadyDetector,
    config: RcvConfig,
    progress: Progress | None = None,
    author: str = AUTHOR,
    action: str | None = None,
) -> AnnotateSummary:
    """Proposes 3D boxes for the objects in 2D boxes; unreviewed proposals of the same frames are replaced. One action.

    A frame that fails is stored with the reason, and the others continue. Finalised frames stay as they are.

    Args:
        view: the project's view detector or the base detector.
        author: who can undo it.
        action: id of an action (`new_action`) that it is a part of; None = one of its own.
    """
    begin = time.perf_counter()
    require_known(view, {box.label for given in boxes.of_frame.values() for box in given})
    frames = [project.frames.get(frame_id) for frame_id, given in boxes.of_frame.items() if given]
    rotation = project.config.settings.rotation
    configs = {kind: config.for_detector(view.box_kind, view.class_agnostic, kind, view.trained) for kind in BoxKind}
    kinds = {stored.id: BoxKind.SILHOUETTE if stored.id in boxes.silhouettes else BoxKind.BOX for stored in frames}
    config = configs[BoxKind.SILHOUETTE if BoxKind.SILHOUETTE in kinds.values() else BoxKind.BOX]
    settings = {**config.record(), "rotation": rotation.value, "method": REVISION, LIFTED_FROM: boxes.origin}
    # in place of an image detector's fingerprint
    content = [(frame, [(b.label, *b.xyxy, b.score) for b in given]) for frame, given in sorted(boxes.of_frame.items())]
    fingerprint = hashlib.sha256(json.dumps([boxes.origin, content]).encode()).hexdigest()
    run = project.jobs.start(
        image_detector=fingerprint, view_detector=view.fingerprint, config_json=json.dumps(settings)
    )
    batch = Batch(project, run, AnnotateSummary(frames=len(frames)), config.box_kind, author, action or new_action())
    source = FrameSource(project)
    for done, stored in enumerate(frames, start=1):
        started = time.perf_counter()
        try:
            given = [replace(box, score=max(box.score, config.min_image_score)) for box in boxes.of_frame[stored.id]]
            (result,) = propose_image_boxes([source.read(stored)], [given], view, configs[kinds[stored.id]], rotation)
            answer = FrameAnswer(result, None, time.perf_counter() - started)
        except Exception as error:
            answer = failure(error, time.perf_counter() - started)
        batch.store(stored, answer)
        if progress is not None:
            progress(done, len(frames))
    project.jobs.finish(run.id)
    batch.vote(progress)
    batch.summary.seconds = time.perf_counter() - begin
    return batch.summary


def require_known(view: ReadyDetector, labels: Collection[str]) -> None:
    """Checks that a view detector can measure objects of all these classes."""
    unknown = [] if view.class_agnostic else sorted(set(labels) - set(view.labels))
    if unknown:
        raise ConfigError(
            f"the project's view detector was not trained on {', '.join(unknown)}; train it on them first"
        )


def _listed(names: Mapping[str, int] | Sequence[str]) -> str:
    return first_few(sorted(names), MOST_LISTED) or "no classes"
