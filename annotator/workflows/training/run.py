"""One run of a training: its dataset, its network, and the registered model."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import MANIFEST_NAME, DatasetManifest, TrainingSample, write_dataset
from annotator.detection.trained import RUN_NAME, TrainedModel, read_run
from annotator.detection.training import TrainingProgress, TrainingStoppedError, train_detector
from annotator.project import Project, StoredFrame, StoredModel
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import FormatError, FrameError
from annotator.workflows.detectors import load_detector
from annotator.workflows.training.held_out import held_out_groups
from annotator.workflows.training.validation_pictures import write_validation_pictures

DATASET = "dataset"

Report = Callable[[TrainingProgress], None]
Stop = Callable[[], bool]


@dataclass(frozen=True)
class Ran:
    """A finished run: the registered model, which may be inactive, the trained network and its training set."""

    model: StoredModel
    result: TrainedModel
    manifest: DatasetManifest


@dataclass(frozen=True, eq=False)
class Run:
    """A run of one detector's training.

    Attributes:
        classes: of the detector.
        kind: what its boxes measure.
        holds_out: whether held-out frames only validate; False: all frames train.
    """

    project: Project
    role: DetectorKind
    classes: tuple[str, ...]
    kind: BoxKind
    holds_out: bool = True
    _since_ns: int = field(init=False)

    def __post_init__(self) -> None:
        # classes that are renamed from now on are translated
        object.__setattr__(self, "_since_ns", self.project.store.clock())

    @property
    def _folder(self) -> Path:
        return self.project.models_folder / self.role.value

    def write(self, samples: Iterable[TrainingSample]) -> DatasetManifest:
        """Writes the training set, which replaces the last one of this role.

        Raises:
            ConfigError, DetectionError, FormatError: as `write_dataset`.
        """
        held_out = held_out_groups(self.project) if self.holds_out else frozenset()
        return write_dataset(self._folder / DATASET, samples, self.classes, held_out.__contains__, self.kind)

    def train(self, manifest: DatasetManifest, config: TrainingConfig, report: Report | None, stop: Stop | None) -> Ran:
        """Trains on the written set, and registers the model without activating it.

        Raises:
            ConfigError, DetectionError, TrainingStoppedError: as `train_detector`.
        """
        dataset, out = self._folder / DATASET, self._folder / run_name(manifest, config)
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
        return Ran(self._registered(result, model_manifest, detector.fingerprint), result, manifest)

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


@dataclass(eq=False)
class LeftOut:
    """Collects messages on data left out."""

    lines: list[str] = field(default_factory=list)

    def skip(self, stored: StoredFrame, error: FrameError) -> None:
        """Adds a frame that cannot be read, once."""
        line = f"frame {stored.key}: {error}"
        if line not in self.lines:
            self.lines.append(line)


def unless_stopped(samples: Iterable[TrainingSample], check_stop: Callable[[], None]) -> Iterator[TrainingSample]:
    """Yields the samples; `check_stop` is called after each and may raise to end that."""
    for sample in samples:
        yield sample
        check_stop()


def remove_leftovers(project: Project, role: DetectorKind) -> None:
    """Removes what killed trainings of a role left: incomplete training sets, and timed runs without a model."""
    folder = project.models_folder / role.value
    registered = {model.path.parent.resolve() for model in project.models.all(role)}
    leftovers = list(folder.glob(f".{DATASET}.part-*"))
    for run in (path.parent for path in folder.glob(f"*/{RUN_NAME}")):
        if run.resolve() not in registered and _is_timed(run):
            leftovers.append(run)
    for path in leftovers:
        shutil.rmtree(path, ignore_errors=True)


def _is_timed(folder: Path) -> bool:
    try:
        run = read_run(folder)
    except FormatError:  # reported by a training that would continue it
        return False
    return run is not None and run.is_timed


def run_name(manifest: DatasetManifest, config: TrainingConfig) -> str:
    """Returns the folder name of a training, which depends on the labels and settings only."""
    return f"{manifest.sha256[:12]}-{settings_hash(config)}"


def settings_hash(config: TrainingConfig) -> str:
    """Hash of the settings of a run."""
    return hashlib.sha256(config.model_dump_json().encode()).hexdigest()[:8]
