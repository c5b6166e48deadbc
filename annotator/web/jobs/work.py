"""The work of each kind of job, which calls one workflow. Runs in a worker process."""

from __future__ import annotations

import shutil
import zipfile
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

from annotator.detection.config import TrainingConfig
from annotator.detection.training import TrainingProgress, TrainingStoppedError
from annotator.project import new_action
from annotator.project.backup.take_in import copy_project
from annotator.types import DetectorKind
from annotator.types.messages import amount
from annotator.web.jobs.records import (
    BoxesRequest,
    CopyRequest,
    CurvePoint,
    ExportRequest,
    ImportRequest,
    JobContext,
    JobStoppedError,
    LiftRequest,
    Outcome,
    ProposeRequest,
    SampleRequest,
    TrainRequest,
)
from annotator.web.uploads import find_upload, remove_upload
from annotator.workflows.detectors import trained_detectors
from annotator.workflows.exporting import ExportFilter, ExportOptions, Split, export_project, parse_shares
from annotator.workflows.importing import (
    Become,
    BoxFormat,
    Importer,
    ImportReport,
    Note,
    import_image_boxes,
    import_labels,
    import_proposals,
    read_labels,
)
from annotator.workflows.importing.values import add_attributes, values_of_labels, values_of_pictures
from annotator.workflows.proposing.annotate import AnnotateSummary, annotate_with
from annotator.workflows.proposing.engines import EngineName, make_engine
from annotator.workflows.proposing.lift import boxes_of_file, drawn_boxes, lift, require_known
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.sample import add_sample
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.train import VIEW_DEFAULTS, Trained, TrainPlan, image_defaults, train
from annotator.workflows.workbench.loaded_detectors import require_view

MOST_FAILURES = 20
LIFT_STAGE = "propose 3D boxes"
RESUMES = "stopped; training again with the same boxes continues from here"


def train_work(job: JobContext, request: TrainRequest) -> Outcome:
    """Trains detectors; a new view detector is put into use if it is better on held-out frames."""
    plan = TrainPlan(
        image=_training_config(
            image_defaults(request.minutes), request.image_pictures, request.image_size_px, request.model
        ),
        view=_training_config(VIEW_DEFAULTS, request.view_pictures, request.view_size_px, request.model),
        minutes=request.minutes,
    )
    roles = tuple(dict.fromkeys(request.roles))
    reporter = _ProgressReporter(job, roles)
    job.progress(f"draw training images for the {roles[0]} detector")
    try:
        trained = train(job.project, plan, roles=roles, progress=reporter.step, stop=job.stopped)
    except TrainingStoppedError as error:
        raise JobStoppedError(RESUMES) from error
    figures = "; ".join([*(f"{t.role} detector: {_result(t)}" for t in trained), *trained[0].learned])
    left_out = [line for t in trained for line in t.left_out]
    return Outcome(f"trained: {figures}", {"models": [t.model.id for t in trained], "left_out": left_out})


def _result(trained: Trained) -> str:
    """What came out of a training, for people."""
    decision = trained.decision
    if decision is None or decision.mean_iou is None:
        measured = f"mAP50 {trained.result.metrics.map50:.2f}"
    else:
        measured = f"mean IoU {decision.mean_iou:.2f} on {decision.objects} held-out objects"
    return measured if decision is None else f"{measured}, {decision.outcome}"


def _training_config(
    config: TrainingConfig, images: int | None, size_px: int | None, model: str | None
) -> TrainingConfig:
    options = {"pictures_seen": images, "image_size_px": size_px, "model": model}
    return config.model_copy(update={name: value for name, value in options.items() if value is not None})


@dataclass(eq=False)
class _ProgressReporter:
    """Converts the progress of one or two trainings into that of the job: each counts 1.

    Attributes:
        reported: latest reported epoch of each training, by part.
        measured: latest mAP50-95 of each training.
    """

    job: JobContext
    roles: tuple[DetectorKind, ...]
    reported: dict[DetectorKind, dict[int, int]] = field(default_factory=dict)
    measured: dict[DetectorKind, float | None] = field(default_factory=dict)

    def step(self, role: DetectorKind, step: TrainingProgress) -> None:
        """Reports one batch or epoch of one training."""
        reported = self.reported.setdefault(role, {})
        if step.batch == 0 and step.epoch > reported.get(step.part, 0):
            reported[step.part] = step.epoch
            self._measured(role, step, sum(reported.values()))
        if self.job.stopped():  # the training itself stops at its next safe point
            return
        epoch = min(step.epoch + 1, step.epochs)
        part = f"part {step.part} of {step.parts}, " if step.parts > 1 else ""
        stage = f"train the {role} detector, {part}epoch {epoch} of {step.epochs}"
        self.job.progress(stage, self.roles.index(role) + step.share_done, float(len(self.roles)))

    def _measured(self, role: DetectorKind, step: TrainingProgress, epoch: int) -> None:
        metrics = {name.rpartition("/")[2]: value for name, value in step.losses.items()}
        if step.map50 is not None and step.map50_95 is not None and step.map50_95 != self.measured.get(role):
            # the trainer does not validate after every epoch, and repeats its latest figures in between
            self.measured[role] = step.map50_95
            metrics |= {"map50": step.map50, "map50_95": step.map50_95}
        self.job.measured(CurvePoint(role=role, epoch=epoch, metrics=metrics))


def propose_work(job: JobContext, request: ProposeRequest) -> Outcome:
    """Proposes boxes on recordings."""
    job.progress("load the detectors")
    source = trained_detectors(job.project)
    config = rcv_config(job.project)
    for recording in request.recordings or ():
        job.project.recordings.get(recording)
    present = job.project.frames.count_present(request.recordings)
    frames = present if request.limit is None else min(present, request.limit)
    # worker processes of the engine end with this process
    with closing(make_engine(EngineName.AUTO, source, frames=frames)) as engine:
        done = annotate_with(
            job.project,
            engine,
            config,
            recordings=request.recordings,
            limit=request.limit,
            author=job.operator,
            progress=job.counter("propose boxes"),
        )
    return _proposed(done)


def lift_work(job: JobContext, request: LiftRequest) -> Outcome:
    """Proposes 3D boxes from the 2D boxes on the images, without any training."""
    job.progress("load the view detector")
    boxes, view = drawn_boxes(job.project, only_without_labels=True), require_view(job.project)
    done = lift(job.project, boxes, view, rcv_config(job.project), job.counter(LIFT_STAGE), job.operator)
    return _proposed(done, f", measured by: {view.title}")


def boxes_work(job: JobContext, request: BoxesRequest) -> Outcome:
    """Imports the boxes of a file as one action of the operator; proposes 3D boxes from 2D boxes if asked to."""
    project, upload = job.project, find_upload(job.project, request.upload)
    recording = None if request.recording is None else project.recordings.get(request.recording).name
    if isinstance(upload.format, BoxFormat):
        outcome = _boxes_3d(job, request, upload.path, upload.format, recording)
        remove_upload(project, upload.id)
        return outcome
    # loaded first, so that nothing is imported if it cannot be
    view = require_view(project) if request.lift else None
    job.progress("read the file")
    if view is not None:
        given = boxes_of_file(project, upload.path, upload.format, recording, request.names, request.box_kind)
        require_known(view, {box.label for boxes in given.of_frame.values() for box in boxes})
    if request.add_attributes:
        add_attributes(project, values_of_pictures(upload.format, upload.path), job.operator)
    action = new_action()
    done = import_image_boxes(
        project,
        upload.path,
        request.box_kind,
        recording,
        upload.format,
        request.names,
        Importer(job.operator, action),
        job.counter("store the 2D boxes"),
    )
    outcome = _imported(done)
    if view is not None:
        job.progress(LIFT_STAGE)
        lifted = _proposed(
            lift(project, given, view, rcv_config(project), job.counter(LIFT_STAGE), job.operator, action),
            f", measured by: {view.title}",
        )
        outcome = Outcome(f"{outcome.message}; {lifted.message}", outcome.result | lifted.result)
    remove_upload(project, upload.id)
    return outcome


def _boxes_3d(job: JobContext, request: BoxesRequest, path: Path, format: BoxFormat, recording: str | None) -> Outcome:
    """Imports 3D boxes as proposals or labels."""
    job.progress("read the file")
    dataset, importer = read_labels(format, path), Importer(job.operator, new_action())
    if request.add_attributes:
        add_attributes(job.project, values_of_labels(dataset), job.operator)
    progress = job.counter("store the boxes")
    if request.become == "proposals":
        done = import_proposals(
            job.project,
            dataset,
            request.source,
            recording=recording,
            min_score=request.min_score,
            names=request.names,
            importer=importer,
            progress=progress,
        )
    else:
        done = import_labels(
            job.project, dataset, recording, progress, request.names, importer, fill=request.add_attributes
        )
    return _imported(done)


def _imported(done: ImportReport) -> Outcome:
    unknown = dict(done.of(Note.OTHER_CLASS))
    return Outcome(done.text(), {"frames": done.frames, "boxes": done.boxes.total(), "unknown": unknown})


def _proposed(done: AnnotateSummary, source: str = "") -> Outcome:
    message = f"{amount(done.proposals, 'proposal')} in {amount(done.done, 'frame')}"
    if done.still:
        message += f", {amount(done.still, 'still object')} as one proposal each"
    if done.skipped:
        message += f", {amount(done.skipped, 'frame')} done before"
    if done.failures:
        message += f", {amount(done.failures, 'frame')} failed"
    message += "".join(f"; {line}" for line in done.learned)
    failed = [{"key": key, "reason": reason} for key, reason in done.failed[:MOST_FAILURES]]
    result = {"frames": done.done, "proposals": done.proposals, "skipped": done.skipped, "without": done.without}
    return Outcome(message + source, {**result, "failed": failed, "failures": done.failures})


def import_work(job: JobContext, request: ImportRequest) -> Outcome:
    """Imports the 3D boxes of recordings."""
    every = ImportReport(Become.LABELS, job.project.config.classes)
    for recording in [job.project.recordings.get(number) for number in request.recordings]:
        counter = job.counter(f"read the boxes of {recording.name}")
        every.include(import_own_labels(job.project, recording.id, counter, request.names))
    outcome = _imported(every)
    return replace(outcome, result=outcome.result | {"recordings": list(request.recordings)})


def copy_work(job: JobContext, request: CopyRequest) -> Outcome:
    """Copies the project, with or without its labels."""
    folder, counter = job.project.path, job.counter("copy files")
    copy_project(folder, folder.parent, request.name, progress=counter, labels=request.labels, sent=False)
    without = "" if request.labels else ", without labels"
    return Outcome(f"copied to {request.name}{without}", {"project": request.name})


def sample_work(job: JobContext, request: SampleRequest) -> Outcome:
    """Generates the sample recording."""
    frames = add_sample(job.project, job.counter("generate a recording of people in a room"))
    return Outcome(f"{amount(frames, 'frame')} generated", {"frames": frames})


def export_work(job: JobContext, request: ExportRequest) -> Outcome:
    """Writes a dataset and packs it; only the packed file remains."""
    name = f"{job.project.path.name}-{request.format}"
    out, packed = job.folder / name, job.folder / f"{name}.zip"
    split = request.split
    report = export_project(
        job.project,
        out,
        request.format,
        choose=ExportFilter(
            request.states, request.classes, request.recordings, request.empty_frames, request.skip_unreadable
        ),
        split=None if split is None else Split(parse_shares(split.shares), split.by, split.seed),
        options=ExportOptions(request.images, request.pictures),
        progress=job.counter("write the dataset"),
    )
    _pack(job, out, packed)
    shutil.rmtree(out)
    summary = report.model_dump(mode="json", include={"format", "frames", "objects", "splits", "notes"})
    lost = [loss.message for loss in report.losses]
    summary["unreadable"] = report.unreadable[:MOST_FAILURES]
    result = {"file": packed.name, "bytes": packed.stat().st_size, **summary, "lost": lost}
    return Outcome(f"{amount(report.objects, 'box')} in {amount(report.frames, 'frame')}", result)


def _pack(job: JobContext, folder: Path, packed: Path) -> None:
    """Packs a folder as a zip, with its name as the top folder; images are stored uncompressed."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    part = packed.with_suffix(".part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for number, path in enumerate(files, 1):
            method = zipfile.ZIP_STORED if path.suffix in (".png", ".jpg") else zipfile.ZIP_DEFLATED
            archive.write(path, path.relative_to(folder.parent), method)
            job.progress("pack the dataset", float(number), float(len(files)))
    part.replace(packed)
