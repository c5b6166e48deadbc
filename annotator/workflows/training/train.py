"""Trains a project's two detectors from its labels, and registers them."""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import accumulate
from pathlib import Path

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import MANIFEST_NAME, DatasetManifest, TrainingSample, tiled, write_dataset
from annotator.detection.pretrained import check_start
from annotator.detection.trained import LAST, TrainedModel, resumable
from annotator.detection.training import TrainingProgress, TrainingStoppedError, train_detector
from annotator.files import remove_abandoned
from annotator.project import Project, StoredFrame, StoredModel
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import FrameError
from annotator.types.messages import amount
from annotator.workflows.detectors import AGNOSTIC, UsedModel, load_detector
from annotator.workflows.recorded.adjusting import learn_up
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.held_out import Decision, HeldOut, held_out_groups
from annotator.workflows.training.image_choice import decide
from annotator.workflows.training.model_report import write_validation_pictures
from annotator.workflows.training.rounds import (
    DEFAULT_VIEW_PX,
    FIRST_PART_S,
    Choice,
    image_config,
    part_seconds,
    starting_config,
)
from annotator.workflows.training.samples import (
    Material,
    SampleConfig,
    agnostic_samples,
    gather,
    image_samples,
    view_samples,
    with_generated,
)

DATASET = "dataset"

Report = Callable[[TrainingProgress], None]
Stop = Callable[[], bool]


@dataclass(frozen=True)
class Trained:
    """A trained detector.

    Attributes:
        left_out: messages on data left out: unreadable frames, unreviewed proposals, boxes of the other kind.
        decision: how held-out frames decided; None before that.
        learned: messages on up directions that reviewed boxes gave before (`learn_up`).
    """

    role: DetectorKind
    model: StoredModel
    result: TrainedModel
    manifest: DatasetManifest
    seconds: float = 0.0
    left_out: tuple[str, ...] = ()
    decision: Decision | None = None
    learned: tuple[str, ...] = ()


class Run:
    def __init__(self, project: Project, role: DetectorKind, classes: tuple[str, ...], kind: BoxKind) -> None:
        self.project, self.role, self.classes, self.kind = project, role, classes, kind
        # classes that are renamed from now on are translated
        self._since_ns = project.store.clock()

    @property
    def _folder(self) -> Path:
        return self.project.models_folder / self.role.value

    @property
    def dataset(self) -> Path:
        return self._folder / DATASET

    def write(self, samples: Iterable[TrainingSample]) -> DatasetManifest:
        """Writes the training set, which replaces the last one of this role."""
        held_out = held_out_groups(self.project)
        return write_dataset(self.dataset, samples, self.classes, held_out.__contains__, self.kind)

    def train(
        self, manifest: DatasetManifest, config: TrainingConfig, report: Report | None, stop: Stop | None
    ) -> Trained:
        """Trains on the written set, and registers the model without activating it."""
        # depends on the labels and settings only
        settings = hashlib.sha256(config.model_dump_json().encode()).hexdigest()
        out = self._folder / f"{manifest.sha256[:12]}-{settings[:8]}"
        dataset = self.dataset
        try:
            result = train_detector(dataset, out, config, report, self.role, stop)
        except TrainingStoppedError:
            if config.seconds is not None:  # its settings depend on the clock, so no later run continues it
                shutil.rmtree(out, ignore_errors=True)
            raise
        model_manifest = out / MANIFEST_NAME
        # the next training overwrites the dataset; the model keeps the list of its labels
        shutil.copyfile(dataset / MANIFEST_NAME, model_manifest)
        detector = load_detector(result.weights)
        write_validation_pictures(dataset, manifest, detector, out)
        model = self._registered(result, model_manifest, detector.fingerprint)
        return Trained(self.role, model, result, manifest)

    def _registered(self, result: TrainedModel, manifest: Path, fingerprint: str) -> StoredModel:
        """Registers the model, unless it is registered already."""
        for known in self.project.models.all(self.role):
            if known.fingerprint == fingerprint and known.path.resolve() == result.weights.resolve():
                return known
        return self.project.models.register(
            self.role,
            result.weights,
            labels=result.classes,
            box_kind=self.kind,
            metrics=result.metrics.model_dump(exclude={"measured_on"}),
            fingerprint=fingerprint,
            manifest=manifest,
            activate=False,
            created_ns=self._since_ns,
        )


def skip(left_out: list[str], stored: StoredFrame, error: FrameError) -> None:
    """Adds a frame that cannot be read to the messages on data left out, once."""
    line = f"frame {stored.key}: {error}"
    if line not in left_out:
        left_out.append(line)


def unless_stopped(samples: Iterable[TrainingSample], check_stop: Callable[[], None]) -> Iterator[TrainingSample]:
    """Yields the samples; `check_stop` is called after each and may raise to end that."""
    for sample in samples:
        yield sample
        check_stop()


def remove_leftovers(project: Project, role: DetectorKind) -> None:
    """Removes what killed trainings of a role left: incomplete training sets, and runs that cannot be resumed.

    What another process writes stays: it holds the folder's lock.
    """
    folder = project.models_folder / role.value
    registered = {model.path.parent.resolve() for model in project.models.all(role)}
    # a finished run has no checkpoints
    runs = [path.parent for path in folder.glob("*/weights") if resumable(path / LAST) is None]
    for path in (*folder.glob(f".{DATASET}.*.unfinished"), *(run for run in runs if run.resolve() not in registered)):
        remove_abandoned(path)


# Objects are small in camera images, hence the larger input; and there are fewer images than pseudo-views.
IMAGE_DEFAULTS = TrainingConfig(image_size_px=192, pictures_seen=2800)
VIEW_DEFAULTS = TrainingConfig(image_size_px=DEFAULT_VIEW_PX, pictures_seen=48000)

# Share of the remaining time of a part that is for training; the rest is for measuring. The shortest training, seconds.
TRAINING_SHARE, MIN_TRAINING_S = 0.85, 10.0


def image_defaults(minutes: float | None = None) -> TrainingConfig:
    """The default settings of the image detector.

    Args:
        minutes: of the view detector's training; beyond three minutes, the image detector learns longer, too.
    """
    length = max((minutes or 0.0) * 60 / FIRST_PART_S, 1.0)
    return IMAGE_DEFAULTS.model_copy(update={"pictures_seen": round(length * IMAGE_DEFAULTS.pictures_seen)})


ProgressCallback = Callable[[DetectorKind, TrainingProgress], None]


@dataclass(frozen=True)
class TrainPlan:
    """The settings of a training.

    Attributes:
        samples: how many pseudo-views are generated.
        minutes: length of the view detector's training; None: three minutes if it starts from a detector, else as
            many pictures as `view` says.
    """

    image: TrainingConfig = IMAGE_DEFAULTS
    view: TrainingConfig = VIEW_DEFAULTS
    samples: SampleConfig = field(default_factory=SampleConfig)
    minutes: float | None = None


def train(
    project: Project,
    plan: TrainPlan,
    *,
    roles: tuple[DetectorKind, ...] = (DetectorKind.IMAGE, DetectorKind.VIEW),
    progress: ProgressCallback | None = None,
    stop: Callable[[], bool] | None = None,
) -> list[Trained]:
    """Trains the detectors one after the other, and registers each.

    Reviewed boxes may give the up direction of a recording first (`learn_up`).

    Held-out frames decide whether a detector is put into use. The view detector is trained in parts (`rounds`), and
    they decide after each part.

    Datasets and runs are stored in the project's `models/` under a hash of their content, so that an interrupted
    training on the same labels continues. Labelled frames that cannot be read are left out and reported.

    Args:
        stop: returns True to end the training early; asked after each sample, batch and measured frame.
    """
    rcv_config(project)  # invalid settings are reported before the samples are made
    material = gather(project, roles)
    for role in roles:
        remove_leftovers(project, role)
    for role in roles:  # checked before the samples are made, which takes long
        check_start(plan.image if role is DetectorKind.IMAGE else plan.view)
    learned = learn_up(project)  # not if the training is refused: nothing would say so
    results = []
    for role in roles:
        report = None if progress is None else partial(progress, role)
        if role is DetectorKind.IMAGE:
            results.append(_train_image(project, material, plan, report, stop))
        else:
            results.append(_ViewTraining(project, material, plan, report, stop).run())
    return [replace(result, learned=learned) for result in results]


def _train_image(
    project: Project, material: Material, plan: TrainPlan, report: Report | None, stop: Stop | None
) -> Trained:
    begin = time.perf_counter()
    left_out: list[str] = []
    if material.unreviewed_images:
        left_out.append(f"{amount(material.unreviewed_images, 'camera image')} with unreviewed proposals")
    run = Run(project, DetectorKind.IMAGE, project.config.classes, material.image_kind)
    real = image_samples(project, material, partial(skip, left_out))
    written = run.write(unless_stopped(real, partial(_check_stop, stop)))
    config = image_config(project, plan.image, written.sha256)
    ran = run.train(written, config, report, stop)
    decision = decide(project, run.dataset, written, ran.model, ran.result.note)
    model, seconds = project.models.get(ran.model.id), time.perf_counter() - begin
    return replace(ran, model=model, seconds=seconds, left_out=tuple(left_out), decision=decision)


class _ViewTraining:
    """A training of the view detector in parts; each part starts from the training's best detector so far."""

    def __init__(
        self, project: Project, material: Material, plan: TrainPlan, report: Report | None, stop: Stop | None
    ) -> None:
        self.project, self.material, self.plan, self.report, self.stop = project, material, plan, report, stop
        self.left_out: list[str] = []
        self.paused_s = 0.0

    def run(self) -> Trained:
        """Trains all parts; the result is the detector that the project uses now, or else the last one."""
        begin = time.perf_counter()
        project, plan = self.project, self.plan
        labels = self.material.labels_of(self.material.kind)
        held_out = HeldOut(project, labels, self._check_stop, self.material.kind)
        choice = Choice(project, held_out, plan.view)
        other_kind = len(self.material.views) - len(self.material.views_of_kind)
        if other_kind and (choice.origin is None or not choice.origin.class_agnostic):
            kind = self.material.kind
            self.left_out.append(
                f"{amount(other_kind, 'pseudo-view')} whose boxes are not of the majority kind, {kind}"
            )
        self.left_out += choice.left_out
        self.view_px = choice.view_px
        self.rcv = rcv_config(project, view_px=self.view_px)
        ends: list[float | None] = [None]
        anew = None
        if plan.view.epochs is None and (choice.origin is not None or plan.minutes is not None):
            lengths = list(part_seconds(plan.minutes or FIRST_PART_S / 60))
            ends = [begin + end for end in accumulate(lengths)]
            anew = choice.part_anew(lengths)
        parts = []
        for number, end in enumerate(ends):
            report = None if self.report is None else partial(_in_part, self.report, number + 1, len(ends))
            parts.append(self._part(choice, None if number == anew else choice.origin, number, end, report))
        active = project.models.active(DetectorKind.VIEW)
        last = ([part for part in parts if active is not None and part.model.id == active.id] or parts)[-1]
        model, seconds = project.models.get(last.model.id), time.perf_counter() - begin
        return replace(last, model=model, seconds=seconds, left_out=tuple(self.left_out))

    def _part(
        self, choice: Choice, origin: UsedModel | None, number: int, end_s: float | None, report: Report | None
    ) -> Trained:
        """One part, with views of its own.

        Args:
            origin: the detector that it continues; None: published or random weights.
            number: from 0.
            end_s: when it should end, by `time.perf_counter`, without pauses; None: a run of epochs or pictures.
        """
        plan = self.plan
        drawing = plan.samples.model_copy(update={"seed": plan.samples.seed + number})
        given, skipped = (self.project, self.material, self.rcv, drawing), partial(skip, self.left_out)
        if origin is None or not origin.class_agnostic:
            classes, samples = self.project.config.classes, view_samples(*given, skipped)
        else:  # with generated views, so that what the base detector knows is kept
            own = agnostic_samples(*given, load_detector(origin.path), skipped)
            classes, samples = AGNOSTIC, with_generated(own, self.view_px, drawing.seed)
        run = Run(self.project, DetectorKind.VIEW, classes, self.material.kind)
        written = run.write(tiled(unless_stopped(samples, self._check_stop), self.view_px))
        seconds = None
        if end_s is not None:  # the rest of the time is for measuring the result
            seconds = max((end_s + self.paused_s - time.perf_counter()) * TRAINING_SHARE, MIN_TRAINING_S)
        if origin is None:
            config = plan.view.model_copy(update={"seconds": seconds})
        else:
            sized = plan.view.model_copy(update={"image_size_px": self.view_px})
            config = starting_config(sized, origin, seconds, drawing.seed)
        ran = run.train(written, config, report, self.stop)
        note = ran.result.note if origin is None else f"starts from the {origin.described}"
        return replace(ran, decision=choice.add(ran.model, note))

    def _check_stop(self) -> None:
        """Blocks during a pause; adds its length to `paused_s`."""
        begin = time.perf_counter()
        _check_stop(self.stop)
        self.paused_s += time.perf_counter() - begin


def _check_stop(stop: Stop | None) -> None:
    if stop is not None and stop():
        raise TrainingStoppedError("training was stopped; train again to begin anew or to resume")


def _in_part(report: Report, part: int, parts: int, step: TrainingProgress) -> None:
    report(replace(step, part=part, parts=parts))
