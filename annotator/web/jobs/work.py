"""The work of the jobs, around one workflow each. Runs in a worker process."""

from __future__ import annotations

import shutil
import zipfile
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from annotator.detection.config import TrainingConfig
from annotator.detection.progress import TrainingProgress, TrainingStoppedError
from annotator.project import Role
from annotator.web.jobs.desk import Desk, JobStoppedError, Outcome
from annotator.web.jobs.records import CurvePoint, ExportRequest, ImportRequest, ProposeRequest, TrainRequest
from annotator.workflows.annotate import annotate_with
from annotator.workflows.engines.choose import EngineName, make_engine
from annotator.workflows.engines.sources import trained_detectors
from annotator.workflows.exporting import ExportFilter, ExportOptions, Split, export_project, parse_shares
from annotator.workflows.own_labels import import_own_labels
from annotator.workflows.rcv_settings import rcv_config
from annotator.workflows.train import IMAGE_DEFAULTS, VIEW_DEFAULTS, TrainPlan, train

T = TypeVar("T")

FAILURES_TOLD = 20
RESUMES = "stopped; training the same boxes again goes on from here"


def train_work(desk: Desk, request: TrainRequest) -> Outcome:
    """Trains detectors; each proposes as soon as it is done."""
    plan = TrainPlan(
        image=_with(IMAGE_DEFAULTS, request.image_pictures, request.image_size_px, request.model),
        view=_with(VIEW_DEFAULTS, request.view_pictures, request.view_size_px, request.model),
    )
    roles = tuple(dict.fromkeys(request.roles))
    telling = _Telling(desk, plan, roles)
    desk.progress(f"draw training pictures for the {roles[0]} detector")
    try:
        trained = train(desk.project, plan, roles=roles, progress=telling.step, stop=desk.stopped)
    except TrainingStoppedError as error:
        raise JobStoppedError(RESUMES) from error
    figures = ", ".join(f"{t.role} detector mAP50 {t.result.metrics.map50:.2f}" for t in trained)
    left_out = [line for t in trained for line in t.left_out]
    return Outcome(f"trained: {figures}", {"models": [t.model.id for t in trained], "left_out": left_out})


def _with(config: TrainingConfig, pictures: int | None, size_px: int | None, model: str | None) -> TrainingConfig:
    given = {"pictures_seen": pictures, "image_size_px": size_px, "model": model}
    return config.model_copy(update={name: value for name, value in given.items() if value is not None})


@dataclass(eq=False)
class _Telling:
    """Turns the progress of two trainings into that of one job, counted in pictures shown."""

    desk: Desk
    plan: TrainPlan
    roles: tuple[Role, ...]
    told: dict[Role, int] = field(default_factory=dict)
    measured: dict[Role, float | None] = field(default_factory=dict)

    def step(self, role: Role, step: TrainingProgress) -> None:
        """One batch or epoch of one training."""
        if step.batch == 0 and step.epoch > self.told.get(role, 0):
            self.told[role] = step.epoch
            self._measured(role, step)
        if self.desk.stopped():  # the training asks by itself, and ends in good order
            return
        before = sum(map(self._pictures, self.roles[: self.roles.index(role)]))
        total = sum(map(self._pictures, self.roles))
        own = self._pictures(role) * step.epochs_done / step.epochs
        epoch = min(step.epoch + 1, step.epochs)
        stage = f"train the {role} detector, epoch {epoch} of {step.epochs}"
        self.desk.progress(stage, before + own, total, self._seconds_left(step, before + own, own, total))

    def _seconds_left(self, step: TrainingProgress, done: float, own: float, total: float) -> float | None:
        """The rest of this training as it says, and of the next one at the same pace."""
        if step.seconds_left is None or own <= 0:
            return None
        after = total - done - (self._pictures(Role(step.role)) - own)
        return step.seconds_left + after * step.seconds / own

    def _pictures(self, role: Role) -> float:
        return float((self.plan.image if role is Role.IMAGE else self.plan.view).pictures_seen)

    def _measured(self, role: Role, step: TrainingProgress) -> None:
        metrics = {name.rpartition("/")[2]: value for name, value in step.losses.items()}
        if step.map50 is not None and step.map50_95 is not None and step.map50_95 != self.measured.get(role):
            # the trainer measures only now and then, and repeats its last figures meanwhile
            self.measured[role] = step.map50_95
            metrics |= {"map50": step.map50, "map50_95": step.map50_95}
        self.desk.measured(CurvePoint(role=role, epoch=step.epoch, metrics=metrics))


def propose_work(desk: Desk, request: ProposeRequest) -> Outcome:
    """Proposes boxes on recordings."""
    desk.progress("load the detectors")
    source = trained_detectors(desk.project)
    config = rcv_config(desk.project).model_copy(update={"box_kind": source.box_kind})
    for recording in request.recordings or ():
        desk.project.recordings.get(recording)
    present = desk.project.frames.count_present(request.recordings)
    frames = present if request.limit is None else min(present, request.limit)
    # its own workers, where there are any, end with this process, whatever ends it
    with closing(make_engine(EngineName.AUTO, source, frames=frames)) as engine:
        done = annotate_with(
            desk.project,
            engine,
            config,
            recordings=request.recordings,
            limit=request.limit,
            progress=desk.counted("propose boxes"),
        )
    words = f"{done.proposals} proposals in {done.done} frames"
    if done.skipped:
        words += f", {done.skipped} frames were done before"
    if done.failures:
        words += f", {done.failures} frames failed"
    failed = [{"key": key, "reason": reason} for key, reason in done.failed[:FAILURES_TOLD]]
    result = {"frames": done.done, "proposals": done.proposals, "skipped": done.skipped, "without": done.without}
    return Outcome(words, {**result, "failed": failed, "failures": done.failures})


def import_work(desk: Desk, request: ImportRequest) -> Outcome:
    """Takes over the labels of recordings."""
    labels, left_out, unreadable = Counter[str](), Counter[str](), list[str]()
    for recording in [desk.project.recordings.get(number) for number in request.recordings]:
        found = import_own_labels(desk.project, recording.id, desk.counted(f"read the boxes of {recording.name}"))
        labels += found.labels
        left_out += found.other_classes
        unreadable += found.unreadable
    words = f"{labels.total()} boxes taken over"
    if left_out:
        words += f", {left_out.total()} of other classes left out ({', '.join(sorted(left_out))})"
    if unreadable:
        words += f", those of {len(unreadable)} frames could not be read"
    return Outcome(words, {"labels": labels, "left_out": left_out, "unreadable": unreadable[:FAILURES_TOLD]})


def export_work(desk: Desk, request: ExportRequest) -> Outcome:
    """Writes a dataset and packs it; only the packed file is left."""
    name = f"{desk.project.path.name}-{request.format}"
    out, packed = desk.folder / name, desk.folder / f"{name}.zip"
    split = request.split
    report = export_project(
        desk.project,
        out,
        request.format,
        choose=ExportFilter(
            _chosen(request.states),
            _chosen(request.classes),
            _chosen(request.recordings),
            request.empty_frames,
            request.skip_unreadable,
        ),
        split=None if split is None else Split(parse_shares(split.shares), split.by, split.seed),
        options=ExportOptions(request.images, request.pictures),
        progress=desk.counted("write the dataset"),
    )
    _pack(desk, out, packed)
    shutil.rmtree(out)
    told = report.model_dump(mode="json", include={"format", "frames", "objects", "splits", "notes"})
    lost = [loss.message for loss in report.losses]
    told["unreadable"] = report.unreadable[:FAILURES_TOLD]
    result = {"file": packed.name, "bytes": packed.stat().st_size, **told, "lost": lost}
    return Outcome(f"{report.objects} boxes in {report.frames} frames", result)


def _chosen(values: list[T] | None) -> tuple[T, ...] | None:
    return None if values is None else tuple(values)


def _pack(desk: Desk, folder: Path, packed: Path) -> None:
    """All files of a folder, below its name, as a zip; pictures are stored as they are."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    part = packed.with_suffix(".part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for number, path in enumerate(files, 1):
            kind = zipfile.ZIP_STORED if path.suffix in (".png", ".jpg") else zipfile.ZIP_DEFLATED
            archive.write(path, path.relative_to(folder.parent), kind)
            desk.progress("pack the dataset", float(number), float(len(files)))
    part.replace(packed)
