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
from annotator.project import Project, StoredFrame, StoredModel
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.detectors import load_detector
from annotator.workflows.settings import rcv_config
from annotator.workflows.training.samples import Material, SampleConfig, gather, image_samples, view_samples
from annotator.workflows.training.validation_pictures import write_validation_pictures

DATASET = "dataset"
# Objects are small in camera images, hence the larger input; and there are fewer images than pseudo-views.
IMAGE_DEFAULTS = TrainingConfig(image_size_px=256, pictures_seen=1600)
VIEW_DEFAULTS = TrainingConfig(image_size_px=64, pictures_seen=48000)

ProgressCallback = Callable[[DetectorKind, TrainingProgress], None]


@dataclass(frozen=True)
class Trained:
    """A trained detector.

    Attributes:
        seconds: duration of the training.
        left_out: messages on data left out: unreadable frames, unreviewed proposals, boxes of the other kind.
    """

    role: DetectorKind
    model: StoredModel
    result: TrainedModel
    manifest: DatasetManifest
    seconds: float
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrainPlan:
    """The settings of a training.

    Attributes:
        image, view: settings of each detector.
        samples: how many pseudo-views are generated.
        rcv: how pseudo-views are drawn; None = the project's settings, with views of the detector's input size unless
            they set a size.
        val_share: share of the frames used for validation.
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
    roles: tuple[DetectorKind, ...] = (DetectorKind.IMAGE, DetectorKind.VIEW),
    progress: ProgressCallback | None = None,
    stop: Callable[[], bool] | None = None,
) -> list[Trained]:
    """Trains the detectors one after the other; each is registered and activated as soon as it is trained.

    Datasets and runs are stored in the project's `models/` under a hash of their content, so that an interrupted
    training on the same labels continues. Labelled frames that cannot be read are left out and reported.

    Args:
        progress: called after each step of a training.
        stop: returns True to end the training early.

    Raises:
        ConfigError: invalid settings.
        DetectionError: there are no labels to learn from, or the training failed.
    """
    rcv = plan.rcv or rcv_config(project, view_px=plan.view.image_size_px)
    material = gather(project, roles)
    for role in roles:  # checked before the samples are made, which takes long
        _check_start(project, role, plan.image if role is DetectorKind.IMAGE else plan.view)
    return [_train_one(project, material, role, plan, rcv, progress, stop) for role in roles]


def _check_start(project: Project, role: DetectorKind, config: TrainingConfig) -> None:
    """Checks the pretrained weights, unless a finished training with these settings exists, which does not need them.

    Whether that training used the present labels is known only once the dataset is written; if not, the training
    itself raises the error.

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
    role: DetectorKind,
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

    if role is DetectorKind.IMAGE:
        samples, kind, config = image_samples(project, material, skip), material.image_kind, plan.image
        if material.unreviewed_images:
            left_out.append(f"{material.unreviewed_images} camera images with unreviewed proposals")
    else:
        views = view_samples(project, material, rcv, plan.samples, skip)
        samples, kind, config = tiled(views, plan.view.image_size_px), material.kind, plan.view
        if material.left_out:
            left_out.append(f"{material.left_out} pseudo-views whose boxes are not of the majority kind, {kind}")
    manifest = write_dataset(folder / DATASET, samples, classes, plan.val_share, plan.seed, kind)
    out = folder / run_name(manifest, config)
    report = None if progress is None else (lambda step: progress(role, step))
    result = train_detector(folder / DATASET, out, config, report, role, stop)
    model_manifest = out / MANIFEST_NAME
    # the next training overwrites the dataset; the model keeps the list of its labels
    shutil.copyfile(folder / DATASET / MANIFEST_NAME, model_manifest)
    detector = load_detector(result.weights)
    write_validation_pictures(folder / DATASET, manifest, detector, out)
    model = _registered(project, role, result, kind, model_manifest, detector.fingerprint)
    return Trained(role, model, result, manifest, time.perf_counter() - begin, tuple(left_out))


def _registered(
    project: Project, role: DetectorKind, result: TrainedModel, kind: BoxKind, manifest: Path, fingerprint: str
) -> StoredModel:
    """Registers and activates the model; a model that is registered already is only activated."""
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
    """Returns the folder name of a training, which depends on the labels and settings only."""
    return f"{manifest.sha256[:12]}-{_settings_hash(config)}"


def _settings_hash(config: TrainingConfig) -> str:
    return hashlib.sha256(config.model_dump_json().encode()).hexdigest()[:8]
