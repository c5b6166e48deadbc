"""Oriented 3D boxes from 2D boxes on the images, without any training of a view detector.

The 2D boxes come from a file, from a 2D detector, or from the boxes that were drawn in the project.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from annotator.project import Project, StoredFrame
from annotator.rcv.config import REVISION, RcvConfig
from annotator.types import Box2D, Detector
from annotator.types.errors import AnnotatorError, ConfigError, FormatError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.image_boxes import checked_images
from annotator.workflows.importing.picture_labels import FlatFormat, read_pictures
from annotator.workflows.proposing.batch_store import AnnotateSummary, Batch
from annotator.workflows.proposing.engines.runner import failure
from annotator.workflows.proposing.engines.tasks import FrameAnswer
from annotator.workflows.proposing.propose_frames import propose_image_boxes
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

Progress = Callable[[int, int], None]
"""Called with (frames done, frames)."""


@dataclass(frozen=True, eq=False)
class GivenBoxes:
    """2D boxes on the images of frames.

    Attributes:
        origin: where they come from, for the record of the run.
        of_frame: the boxes on the image of each frame, by frame id.
        other_classes: number of boxes left out because the project has no such class, by class name.
        unmatched: image names without a frame in the project.
    """

    origin: str
    of_frame: Mapping[int, tuple[Box2D, ...]]
    other_classes: Mapping[str, int]
    unmatched: tuple[str, ...] = ()


def drawn_boxes(project: Project) -> GivenBoxes:
    """Returns the boxes that were drawn or imported on the project's images.

    Raises:
        ConfigError: there are none.
    """
    boxes = {drawn.frame_id: drawn.boxes for drawn in project.boxes.on_images() if drawn.boxes}
    if not boxes:
        raise ConfigError(
            f"project {project.config.name} has no boxes on its images; give --boxes or --detector, or draw some"
        )
    return GivenBoxes("boxes drawn on the images", boxes, {})


def boxes_of_file(
    project: Project, path: Path, format: FlatFormat, recording: str | None, names: Mapping[str, str]
) -> GivenBoxes:
    """Returns the boxes of a COCO or YOLO dataset of camera images.

    Args:
        recording: name of the recording of the images, if several recordings have such frames.
        names: the project's class of each class of the file; classes that are not listed keep their names.

    Raises:
        FormatError: the dataset is invalid, or has no box of a class of the project.
    """
    dataset = read_pictures(format, path)
    images = checked_images(project, dataset, dataset.pictures, recording)
    chosen = _chosen(project, {image.frame_id: image.boxes for image in images.matched}, names)
    if not any(chosen.of_frame.values()):
        raise FormatError(
            path,
            f"has no box of the classes {', '.join(project.config.classes)}, only {_listed(chosen.other_classes)}; "
            "map its classes with --rename",
        )
    return replace(chosen, origin=f"boxes of {path.name}", unmatched=images.unmatched)


def boxes_of_detector(
    project: Project,
    detector: Detector,
    origin: str,
    recordings: Sequence[int] | None,
    names: Mapping[str, str],
    progress: Progress | None = None,
) -> GivenBoxes:
    """Returns the boxes of a 2D detector on all images.

    Args:
        names: as for `boxes_of_file`.

    Raises:
        ConfigError: the detector has none of the project's classes.
    """
    known = {names.get(label, label) for label in detector.labels} & set(project.config.classes)
    if not known:
        raise ConfigError(
            f"the detector has none of the classes {', '.join(project.config.classes)}, but {_listed(detector.labels)};"
            " map its classes with --rename"
        )
    source, boxes = FrameSource(project), {}
    frames = [frame for frame in project.frames.of(recordings) if frame.index is not None]
    for done, stored in enumerate(frames, start=1):
        try:
            boxes[stored.id] = tuple(detector.detect([source.read(stored)])[0])
        except AnnotatorError:
            boxes[stored.id] = ()  # the frame is reported when it is lifted
        if progress is not None:
            progress(done, len(frames))
    return replace(_chosen(project, boxes, names), origin=origin)


def lift(
    project: Project,
    boxes: GivenBoxes,
    view: ReadyDetector,
    config: RcvConfig,
    progress: Progress | None = None,
) -> AnnotateSummary:
    """Proposes 3D boxes for the objects in 2D boxes; unreviewed proposals of the same frames are replaced.

    A frame that fails is stored with the reason, and the others continue. Finalised frames stay as they are.

    Args:
        view: the project's view detector or the base detector.
        config: the project's settings.
    """
    begin = time.perf_counter()
    frames = [project.frames.get(frame_id) for frame_id, given in boxes.of_frame.items() if given]
    config, rotation = config.for_detector(view.box_kind, view.class_agnostic), project.config.settings.rotation
    settings = {**config.record(), "rotation": rotation.value, "method": REVISION, "lifted from": boxes.origin}
    run = project.jobs.start(
        image_detector=_fingerprint(boxes), view_detector=view.fingerprint, config_json=json.dumps(settings)
    )
    batch = Batch(project, run, len(frames), None, AnnotateSummary(frames=len(frames)))
    source = FrameSource(project)

    def answer(stored: StoredFrame) -> FrameAnswer:
        started = time.perf_counter()
        try:
            given = [replace(box, score=max(box.score, config.min_image_score)) for box in boxes.of_frame[stored.id]]
            (result,) = propose_image_boxes([source.read(stored)], [given], view, config, rotation)
        except Exception as error:
            return failure(error, time.perf_counter() - started)
        return FrameAnswer(result, None, time.perf_counter() - started)

    for done, stored in enumerate(frames, start=1):
        batch.store(stored, answer(stored))
        if progress is not None:
            progress(done, len(frames))
    project.jobs.finish(run.id)
    batch.summary.seconds = time.perf_counter() - begin
    return batch.summary


def _chosen(project: Project, boxes: Mapping[int, Sequence[Box2D]], names: Mapping[str, str]) -> GivenBoxes:
    """Keeps the boxes of the project's classes, under the project's names."""
    classes = set(project.config.classes)
    chosen: dict[int, tuple[Box2D, ...]] = {}
    other: dict[str, int] = {}
    for frame_id, given in boxes.items():
        renamed = [replace(box, label=names.get(box.label, box.label)) for box in given]
        chosen[frame_id] = tuple(box for box in renamed if box.label in classes)
        for box in renamed:
            if box.label not in classes:
                other[box.label] = other.get(box.label, 0) + 1
    return GivenBoxes("", chosen, other)


def _fingerprint(boxes: GivenBoxes) -> str:
    """Hash of the boxes, in place of an image detector's fingerprint."""
    content = [(frame, [(b.label, *b.xyxy, b.score) for b in given]) for frame, given in sorted(boxes.of_frame.items())]
    return hashlib.sha256(json.dumps([boxes.origin, content]).encode()).hexdigest()


def _listed(names: Mapping[str, int] | Sequence[str]) -> str:
    shown = sorted(names)
    more = f" and {len(shown) - 10} more" if len(shown) > 10 else ""
    return ", ".join(shown[:10]) + more if shown else "no classes"
