"""What is kept of a training run: `model.json` of a finished one, `run.json` from the start on."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.detection.config import Role, TrainingConfig
from annotator.detection.manifest import Split
from annotator.files import write_atomic
from annotator.types import BoxKind
from annotator.types.errors import FormatError

MODEL_NAME, RUN_NAME = "model.json", "run.json"


class TrainingMetrics(BaseModel):
    """How good the kept weights are on the pictures that were held back.

    Attributes:
        map50, map50_95: mean average precision at IoU 0.5, and over IoU 0.5 to 0.95.
        precision, recall: at the confidence with the best F1.
        measured_on: "train" where no pictures could be held back; such figures flatter.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    map50: float
    map50_95: float
    precision: float
    recall: float
    measured_on: Split


class TrainedModel(BaseModel):
    """A trained detector and where it comes from.

    Attributes:
        role: image or pseudo-view detector.
        weights: its weights file.
        classes: in the order of the class numbers.
        kind: what the boxes it was taught measure.
        image_size_px: the picture size that it was trained at.
        metrics: of the best epoch, whose weights are kept.
        epochs: epochs that were run.
        seconds: over all parts of an interrupted run.
        pretrained: whether it started from weights that had learnt something before.
        note: what it started from, in words.
        dataset_sha256: of its training set's manifest.
        config: its settings.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    role: Role
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

    def write(self, folder: Path) -> None:
        """Writes `model.json`; the weights are named relative to it, so that the folder can be moved."""
        relative = self.model_copy(update={"weights": Path(self.weights.name)})
        write_atomic(folder / MODEL_NAME, relative.model_dump_json(indent=1).encode())


class RunRecord(BaseModel):
    """A run that has begun.

    Attributes:
        fingerprint: of training set, settings and role; only a run with the same can be gone on with.
        pretrained, note: what it started from.
        seconds: spent up to the last whole epoch.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    fingerprint: str
    pretrained: bool
    note: str
    seconds: float

    def write(self, folder: Path) -> None:
        """Writes `run.json`."""
        write_atomic(folder / RUN_NAME, self.model_dump_json(indent=1).encode())


def read_trained(folder: Path) -> TrainedModel:
    """A finished run.

    Raises:
        FormatError: the folder holds none, or one that cannot be read.
    """
    path = folder / MODEL_NAME
    try:
        stored = TrainedModel.model_validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise FormatError(path, "no such file; the detector is not trained, or its training was interrupted") from error
    except (OSError, ValidationError) as error:
        raise FormatError(path, f"not a trained model ({error}); train the detector again") from error
    return stored.model_copy(update={"weights": folder / stored.weights})


def read_run(folder: Path) -> RunRecord | None:
    """The run that a folder holds, or None where it holds none.

    Raises:
        FormatError: its record cannot be read.
    """
    path = folder / RUN_NAME
    if not path.is_file():
        return None
    try:
        return RunRecord.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise FormatError(path, f"not a training run ({error}); remove the folder and train again") from error
