"""Trains a project's two detectors from its labels, and registers them."""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import write_dataset
from annotator.detection.manifest import MANIFEST_NAME, DatasetManifest
from annotator.detection.pretrained import check_start
from annotator.detection.progress import TrainingProgress
from annotator.detection.tiles import tiled
from annotator.detection.trained import MODEL_NAME, TrainedModel
from annotator.detection.training import train_detector
from annotator.project import Project, Role, StoredFrame, StoredModel
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.detectors import load_detector
from annotator.workflows.rcv_settings import rcv_config
from annotator.workflows.samples import Material, SampleConfig, gather, image_samples, view_samples
from annotator.workflows.validation_pictures import write_validation_pictures

DATASET = "dataset"
# A camera image shows its objects small, and there are fewer of them than of pseudo-views.
IMAGE_DEFAULTS = TrainingConfig(image_size_px=256, pictures_seen=1600)
VIEW_DEFAULTS = TrainingConfig(image_size_px=64, pictures_seen=48000)

ProgressCallback = Callable[[Role, TrainingProgress], None]


@dataclass(frozen=True)
class Trained:
    """One detector after its training.

    Attributes:
        left_out: what could not teach it, in words: unreadable frames, boxes of the other kind.
    """

    role: Role
    model: StoredModel
    result: TrainedModel
    manifest: DatasetManifest
    seconds: float
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrainPlan:
    """What to train and how.

    Attributes:
        image, view: settings of each detector.
        samples: how many pictures are made from 3D labels.
        rcv: how pseudo-views are drawn; None takes the project's settings, at the size that is trained at unless they
            say another.
        val_share: share of the frames that measure instead of teaching.
        seed: of the split.
    """

    image: TrainingConfig = IMAGE_DEFAULTS
    view: TrainingConfig = VIEW_DEFAULTS
    samples: SampleConfig = field(default_factory=SampleConfig)
    rcv: RcvConfig | None = None
    val_share: float = 0.15
    seed: int = 0


def train(
    project: Project,
    plan: TrainPlan,
    *,
    roles: tuple[Role, ...] = (Role.IMAGE, Role.VIEW),
    progress: ProgressCallback | None = None,
    stop: Callable[[], bool] | None = None,
) -> list[Trained]:
    """Trains the detectors one after the other; each is registered, and active, as soon as it is done.

    Data sets and runs live in the project's `models/` by the hash of what they learn from, so that an interrupted
    training of the same labels goes on where it was. A labelled frame that cannot be read is left out, and told.

    Raises:
        ConfigError: the project has settings that cannot be used.
        DetectionError: nothing to learn from, or the training failed.
    """
    rcv = plan.rcv or rcv_config(project, view_px=plan.view.image_size_px)
    material = gather(project, roles)
    for role in roles:  # a model that does not exist is told before the pictures are made, not after
        _check_start(project, role, plan.image if role is Role.IMAGE else plan.view)
    return [_train_one(project, material, role, plan, rcv, progress, stop) for role in roles]


def _check_start(project: Project, role: Role, config: TrainingConfig) -> None:
    """Refuses what a training could not begin with, unless one with these settings is done: that needs no beginning.

    (Whether it has learnt from the present labels shows only with the pictures; if not, the training refuses.)

    Raises:
        ConfigError, DetectionError: as `check_start`.
    """
    try:
        check_start(config)
    except ConfigError:
        if not any((project.models_folder / role.value).glob(f"*-{_settings_hash(config)}/{MODEL_NAME}")):
            raise


def _train_one(
    project: Project,
    material: Material,
    role: Role,
    plan: TrainPlan,
    rcv: RcvConfig,
    progress: ProgressCallback | None,
    stop: Callable[[], bool] | None,
) -> Trained:
    begin = time.perf_counter()
    classes = project.config.classes
    folder = project.models_folder / role.value
    left_out: list[str] = []

    def skip(stored: StoredFrame, error: FrameError) -> None:
        left_out.append(f"frame {stored.key}: {error}")

    if role is Role.IMAGE:
        samples, kind, config = image_samples(project, material, skip), material.image_kind, plan.image
        if material.untold:
            left_out.append(f"{material.untold} camera images with proposals that nobody has reviewed")
    else:
        views = view_samples(project, material, rcv, plan.samples, skip)
        samples, kind, config = tiled(views, plan.view.image_size_px), material.kind, plan.view
        if material.left_out:
            left_out.append(f"{material.left_out} pseudo-views whose boxes are not of the kind {kind}, as most are")
    manifest = write_dataset(folder / DATASET, samples, classes, plan.val_share, plan.seed, kind)
    out = folder / run_name(manifest, config)
    report = None if progress is None else (lambda step: progress(role, step))
    result = train_detector(folder / DATASET, out, config, report, role.value, stop)
    kept = out / MANIFEST_NAME
    # The pictures can be made again from the recordings; which labels they showed is kept with the model.
    shutil.copyfile(folder / DATASET / MANIFEST_NAME, kept)
    detector = load_detector(result.weights)
    write_validation_pictures(folder / DATASET, manifest, detector, out)
    model = _registered(project, role, result, kind, kept, detector.fingerprint)
    return Trained(role, model, result, manifest, time.perf_counter() - begin, tuple(left_out))


def _registered(
    project: Project, role: Role, result: TrainedModel, kind: BoxKind, manifest: Path, fingerprint: str
) -> StoredModel:
    """The model in the project's registry, active; training the same again is no second model."""
    for known in project.models.all(role):
        if known.fingerprint == fingerprint and known.path.resolve() == result.weights.resolve():
            return project.models.activate(known.id)
    return project.models.register(
        role,
        result.weights,
        labels=result.classes,
        box_kind=kind,
        metrics=result.metrics.model_dump(exclude={"measured_on"}),
        fingerprint=fingerprint,
        manifest=manifest,
    )


def run_name(manifest: DatasetManifest, config: TrainingConfig) -> str:
    """The folder of a training: the same labels and settings give the same one, so that it is found again."""
    return f"{manifest.sha256[:12]}-{_settings_hash(config)}"


def _settings_hash(config: TrainingConfig) -> str:
    return hashlib.sha256(config.model_dump_json().encode()).hexdigest()[:8]
