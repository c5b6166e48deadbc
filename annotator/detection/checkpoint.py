"""Checkpoints of a training run: the averaged weights, the optimiser's state, and what resuming needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.detection.network_file import (
    DESCRIPTION,
    describe,
    filled,
    half,
    read_facts,
    read_tensors,
    write_tensors,
)
from annotator.types.errors import DetectionError

LAST, BEST = "last.safetensors", "best.safetensors"
STATE = "training"
WEIGHTS, OPTIMISER = "weights/", "optimiser/"
REMEDY = "train again"


class TrainingState(BaseModel):
    """Numbers of a checkpoint.

    Attributes:
        epoch: the finished epoch, from 0.
        updates: number of updates of the averaged weights.
        best_fitness: of the best epoch; None before the first validation.
        stopper: state of early stopping.
        metrics: of this epoch's validation; None without one.
        groups: the optimiser's parameter groups without their parameters, which are listed by number.
        plain: the optimiser's state that is not a tensor, by parameter number and name.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    epoch: int
    updates: int
    best_fitness: float | None
    stopper: dict[str, float | None]
    metrics: dict[str, float | None]
    groups: list[dict[str, Any]]
    plain: dict[str, dict[str, float]]


def write_checkpoint(path: Path, trainer: Any, with_optimiser: bool = True) -> None:
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
    """A checkpoint in the form from which ultralytics' trainer resumes; "ema" is a model.

    Raises:
        DetectionError: the file is missing or damaged.
    """
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
    """The model of a checkpoint, and the metrics of its validation.

    Raises:
        DetectionError: the file is missing or damaged.
    """
    tensors, facts = read_tensors(path, REMEDY)
    return _weights(path, tensors, facts), _state(path, facts).metrics


def epochs_done(path: Path) -> int:
    """Number of finished epochs of a checkpoint; 0 if a run cannot be resumed from it."""
    if not path.is_file():
        return 0
    try:
        state = _state(path, read_facts(path))
    except DetectionError:  # a damaged checkpoint: the run starts again
        return 0
    return state.epoch + 1 if state.groups else 0


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
