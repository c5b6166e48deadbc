"""Files of a training run: checkpoints, and `model.json` when it is finished."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from annotator.detection.config import EdgeErrors, TrainingConfig
from annotator.detection.dataset import Split, read_record
from annotator.detection.weights import DESCRIPTION, describe, filled, half, read_facts, read_tensors, write_tensors
from annotator.files import write_atomic
from annotator.types import BoxKind, DetectorKind
from annotator.types.bases import Strict
from annotator.types.errors import DetectionError, FormatError

MODEL_NAME = "model.json"


class TrainingMetrics(Strict):
    """Accuracy of the kept weights on the validation images.

    Attributes:
        map50, map50_95: mean average precision at IoU 0.5, and over IoU 0.5 to 0.95.
        precision, recall: at the confidence with the best F1.
        measured_on: "train" if there were no validation images; such figures are too optimistic.
    """

    map50: float
    map50_95: float
    precision: float
    recall: float
    measured_on: Split


class TrainedModel(Strict):
    """A trained detector and its origin.

    Attributes:
        classes: class names, in the order of the class numbers.
        image_size_px: training size, longer side, pixels.
        seconds: training time, over all parts of an interrupted run.
        edge_errors: expected errors of its edges, by class; empty for image detectors, and where the network does
            not tell them.
    """

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
    edge_errors: dict[str, EdgeErrors] = Field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Writes `model.json`. It names the weights relative to itself, so the folder can be moved."""
        relative = self.model_copy(update={"weights": Path(self.weights.name)})
        write_atomic(folder / MODEL_NAME, relative.model_dump_json(indent=1).encode())


class RunRecord(Strict):
    """What a checkpoint tells of its run.

    Attributes:
        fingerprint: hash of training set, settings and detector kind; only a run with the same hash is resumed.
        pretrained, note: what the run started from.
        seconds: training time so far.
    """

    fingerprint: str
    pretrained: bool
    note: str
    seconds: float


def read_trained(folder: Path) -> TrainedModel:
    path, remedy = folder / MODEL_NAME, "train the detector again"
    missing = "the detector is not trained, or its training was interrupted"
    stored = read_record(path, TrainedModel, missing, remedy)
    if stored.weights.name != str(stored.weights):
        raise FormatError(path, f"names weights outside its folder ({stored.weights}); {remedy}")
    return stored.model_copy(update={"weights": folder / stored.weights})


LAST, BEST = "last.safetensors", "best.safetensors"
STATE = "training"
WEIGHTS, OPTIMISER = "weights/", "optimiser/"
REMEDY = "train again"


class TrainingState(Strict):
    """Numbers of a checkpoint.

    Attributes:
        epoch: the last finished one, from 0.
        updates: number of updates of the averaged weights.
        metrics: of this epoch's validation; None without one.
        groups: the optimiser's parameter groups without their parameters, which are listed by number.
        plain: the optimiser's state that is not a tensor, by parameter number and name.
    """

    run: RunRecord
    epoch: int
    updates: int
    best_fitness: float | None
    stopper: dict[str, float | None]
    metrics: dict[str, float | None]
    groups: list[dict[str, Any]]
    plain: dict[str, dict[str, float]]


def write_checkpoint(path: Path, trainer: Any, run: RunRecord, with_optimiser: bool) -> None:
    """Writes a checkpoint of ultralytics' trainer, atomically.

    Args:
        with_optimiser: False for weights from which no training is resumed.
    """
    ema = trainer.ema.ema
    tensors = {WEIGHTS + name: value for name, value in half(ema.state_dict()).items()}
    optimiser = trainer.optimizer.state_dict() if with_optimiser else {"state": {}, "param_groups": []}
    plain: dict[str, dict[str, float]] = {}
    for number, state in optimiser["state"].items():
        for name, value in state.items():
            if hasattr(value, "is_floating_point") and value.ndim:
                tensors[f"{OPTIMISER}{number}/{name}"] = value.detach().contiguous().clone()
            else:
                plain.setdefault(str(number), {})[name] = float(value)
    state = TrainingState(
        run=run,
        epoch=trainer.epoch,
        updates=trainer.ema.updates,
        best_fitness=_number(trainer.best_fitness),
        stopper={
            "best_fitness": _number(trainer.stopper.best_fitness),
            "best_epoch": _number(trainer.stopper.best_epoch),
        },
        metrics={name: _number(value) for name, value in {**trainer.metrics, "fitness": trainer.fitness}.items()},
        groups=[dict(group) for group in optimiser["param_groups"]],
        plain=plain,
    )
    facts = {DESCRIPTION: describe(ema).model_dump_json(), STATE: state.model_dump_json()}
    write_tensors(path, tensors, facts)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint in the form from which ultralytics' trainer resumes; "ema" is a model."""
    tensors, facts = read_tensors(path, REMEDY)
    state = _state(path, facts)
    optimiser: dict[int, dict[str, Any]] = {int(k): dict(values) for k, values in state.plain.items()}
    for name, value in tensors.items():
        if name.startswith(OPTIMISER):
            number, key = name.removeprefix(OPTIMISER).split("/")
            optimiser.setdefault(int(number), {})[key] = value
    return {
        "epoch": state.epoch,
        "ema": _weights(path, tensors, facts),
        "updates": state.updates,
        "best_fitness": state.best_fitness,
        "stopper": state.stopper,
        "optimizer": {"state": optimiser, "param_groups": state.groups},
        "train_metrics": state.metrics,
    }


def read_weights(path: Path) -> tuple[Any, dict[str, float | None]]:
    """The model of a checkpoint, and the metrics of its validation."""
    tensors, facts = read_tensors(path, REMEDY)
    return _weights(path, tensors, facts), _state(path, facts).metrics


def read_state(path: Path) -> TrainingState:
    return _state(path, read_facts(path))


def resumable(path: Path) -> TrainingState | None:
    """The numbers of a checkpoint from which a run can be resumed; None if there is none, or a damaged one."""
    try:
        state = read_state(path)
    except DetectionError:
        return None
    return state if state.groups else None


def _weights(path: Path, tensors: dict[str, Any], facts: dict[str, str]) -> Any:
    weights = {name.removeprefix(WEIGHTS): value for name, value in tensors.items() if name.startswith(WEIGHTS)}
    return filled(path, weights, facts, REMEDY)


def _state(path: Path, facts: dict[str, str]) -> TrainingState:
    try:
        return TrainingState.model_validate_json(facts.get(STATE, ""))
    except ValidationError as error:
        raise DetectionError(f"{path}: is not a checkpoint of a training; {REMEDY}") from error


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
