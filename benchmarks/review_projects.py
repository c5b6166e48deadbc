"""The projects of `benchmarks.review`: taught by ten frames, with proposals for the others; and one without labels."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from annotator.detection.pretrained import NAME
from annotator.project import (
    BoxRotation,
    NewLabel,
    Project,
    ProjectSettings,
    WriteContext,
    create_project,
    open_project,
)
from annotator.recordings import open_recording
from annotator.types import DetectorKind, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import (
    Detectors,
    active_model,
    base_model,
    base_titles,
    load_detector,
    own_model,
    view_model,
)
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.settings import rcv_config
from annotator.workflows.simulate import visible_objects
from annotator.workflows.tracks.link import link_tracks
from annotator.workflows.training.train import ProgressCallback, TrainPlan, image_defaults, train
from annotator.workflows.workbench.review_queue import Order, queue

AUTHOR = "simulated operator"
TAUGHT_FRAMES = 10


def is_project(path: Path) -> bool:
    """True for a project's folder."""
    return (path / "project.json").is_file()


@contextmanager
def copied(project: Path, folder: Path, name: str) -> Iterator[Project]:
    """A copy of a project, which the operator may change.

    Args:
        folder: where the copy is made.
        name: of the copy's folder.
    """
    shutil.copytree(project, folder / name)
    with open_project(folder / name) as opened:
        yield opened


@contextmanager
def unlabelled(path: Path, folder: Path, rotation: BoxRotation) -> Iterator[Project]:
    """A new project of a recording with true boxes, which are not in the project.

    Raises:
        ConfigError: the recording has no true boxes, or too few frames.
        AnnotatorError: it cannot be read.
    """
    recording = open_recording(path)
    if len(recording) < 2 * TAUGHT_FRAMES:
        raise ConfigError(
            f"{path}: has {len(recording)} frames; {TAUGHT_FRAMES} of them teach, and as many at least are reviewed"
        )
    truths = [load_truth(recording, index, recording.frame(index)) for index in range(len(recording))]
    classes = sorted({truth.label for each in truths for truth in each})
    if not classes:
        raise ConfigError(f"{path}: has no true boxes to teach and to review against")
    with create_project(folder, "taught", classes, settings=ProjectSettings(rotation=rotation)) as project:
        register_recording(project, recording)
        yield project


def teach(
    path: Path, folder: Path, rotation: BoxRotation, minutes: float | None, progress: ProgressCallback | None = None
) -> Path:
    """Makes a project of a recording, and teaches its detectors with ten frames, as the page orders them.

    Args:
        path: the recording, with true boxes.
        folder: where the project is made.
        minutes: length of the view detector's training; None = the default.

    Returns:
        The project's folder.

    Raises:
        ConfigError: the recording has no true boxes, or too few frames.
        AnnotatorError: it cannot be read, or the training failed.
    """
    with unlabelled(path, folder, rotation) as project:
        recording = open_recording(path)
        source = FrameSource(project)
        # the page's "Most useful first": far from each other
        for item in queue(project, Order.TEACH, most=TAUGHT_FRAMES).items:
            index = item.frame.index or 0
            objects = visible_objects(recording, index, source.read(item.frame), project.config.classes)
            new = [NewLabel(each.label, each.box) for each in objects]
            revision = item.frame.revision
            if new:
                revision = project.labels.create(item.frame.id, new, WriteContext(revision, AUTHOR)).receipt.revision
            project.frames.finalise(item.frame.id, WriteContext(revision, AUTHOR))
        train(project, TrainPlan(image=image_defaults(minutes), minutes=minutes), progress=progress)
        return project.path


def propose(project: Project, *, with_base: bool) -> None:
    """Proposes boxes for all frames that are not finalised, and links them into tracks, as `annotate` and `track` do.

    Args:
        with_base: let the base detector measure them, in place of the project's own view detector.

    Raises:
        DetectionError: a detector is missing, or cannot be loaded.
    """
    image = active_model(project, DetectorKind.IMAGE)
    view = base_model() if with_base else view_model(project)
    detectors = Detectors(
        load_detector(image.path), load_detector(view.path), view.box_kind, view.class_agnostic, image.box_kind
    )
    annotate(project, detectors, rcv_config(project))
    link_tracks(project)


def measured_by(project: Project) -> list[str]:
    """Names the view detectors that measured the open proposals, for people."""
    own = {model.fingerprint: own_model(project, model).described for model in project.models.all(DetectorKind.VIEW)}
    base = base_titles(project)
    used = {each.run_id for each in project.labels.select(states=[ReviewState.PROPOSED])}
    return sorted({NAME if run.id in base else own[run.view_detector] for run in project.jobs.all() if run.id in used})


def without_labels(project: Project) -> None:
    """Deletes what a project's frames hold, and takes its own detectors out of use, so that the base detector measures
    boxes: a project as it begins.

    Raises:
        ProjectError: the store refuses a change.
    """
    for frame in project.frames.of():
        revision = frame.revision
        if frame.finalised:
            revision = project.frames.reopen(frame.id, WriteContext(revision, AUTHOR)).revision
        for label in project.labels.of_frame(frame.id):
            revision = project.labels.delete(frame.id, label.uid, WriteContext(revision, AUTHOR)).revision
    for role in DetectorKind:
        project.models.deactivate(role)
