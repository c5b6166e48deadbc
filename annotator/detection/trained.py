"""Files of a training run: `run.json` from its start, `model.json` when it is finished."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.detection.config import EdgeErrors, TrainingConfig
from annotator.detection.dataset import Split
from annotator.files import read_file, write_atomic
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import FormatError

MODEL_NAME, RUN_NAME = "model.json", "run.json"


class TrainingMetrics(BaseModel):
    """Accuracy of the kept weights on the validation images.

    Attributes:
        map50, map50_95: mean average precision at IoU 0.5, and over IoU 0.5 to 0.95.
        precision, recall: at the confidence with the best F1.
        measured_on: "train" if there were no validation images; such figures are too optimistic.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    map50: float
    map50_95: float
    precision: float
    recall: float
    measured_on: Split


class TrainedModel(BaseModel):
    """A trained detector and its origin.

    Attributes:
        role: image or pseudo-view detector.
        weights: the weights file.
        classes: class names, in the order of the class numbers.
        kind: what the boxes of its training set measure.
        image_size_px: training size, longer side, pixels.
        metrics: of the best epoch, whose weights are kept.
        epochs: number of epochs that were run.
        seconds: training time, over all parts of an interrupted run.
        pretrained: whether it started from pretrained weights.
        note: what it started from, in words.
        dataset_sha256: hash of the training set's manifest.
        config: the training settings.
        edge_errors: expected errors of its edges, by class; empty for image detectors, and where the network does
            not tell them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    role: DetectorKind
    weights: Path
    classes: tuple[str, ...]
    kind: BoxKind | None
    image_size_px: int
    metrics: TrainingMetrics
    epochs: int
    seconds: float
    pretrained: bool
    note: str
    dataset_sha256: str
    config: TrainingConfig
    edge_errors: dict[str, EdgeErrors] = {}

    def write(self, folder: Path) -> None:
        """Writes `model.json`. It names the weights relative to itself, so the folder can be moved."""
        relative = self.model_copy(update={"weights": Path(self.weights.name)})
        write_atomic(folder / MODEL_NAME, relative.model_dump_json(indent=1).encode())


class RunRecord(BaseModel):
    """A training run that has started.

    Attributes:
        fingerprint: hash of training set, settings and detector kind; only a run with the same hash is resumed.
        pretrained, note: what the run started from.
        seconds: time spent up to the last complete epoch.
        is_timed: whether it has a fixed duration; `annotator train` never resumes such a run, because its settings
            depend on the clock.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    fingerprint: str
    pretrained: bool
    note: str
    seconds: float
    is_timed: bool = False

    def write(self, folder: Path) -> None:
        """Writes `run.json`."""
        write_atomic(folder / RUN_NAME, self.model_dump_json(indent=1).encode())


def read_trained(folder: Path) -> TrainedModel:
    """Reads a finished run.

    Raises:
        FormatError: the folder has no finished run, or it cannot be read.
    """
    path = folder / MODEL_NAME
    try:
        stored = TrainedModel.model_validate_json(read_file(path))
    except FileNotFoundError as error:
        raise FormatError(path, "no such file; the detector is not trained, or its training was interrupted") from error
    except (OSError, ValidationError) as error:
        raise FormatError(path, f"not a trained model ({error}); train the detector again") from error
    if stored.weights.name != str(stored.weights):
        raise FormatError(path, f"names weights outside its folder ({stored.weights}); train the detector again")
    return stored.model_copy(update={"weights": folder / stored.weights})


def read_run(folder: Path) -> RunRecord | None:
    """Reads the run in a folder; None if the folder has no run.

    Raises:
        FormatError: the record cannot be read.
    """
    path = folder / RUN_NAME
    if not path.is_file():
        return None
    try:
        return RunRecord.model_validate_json(read_file(path))
    except (OSError, ValidationError) as error:
        raise FormatError(path, f"not a training run ({error}); remove the folder and train again") from error
