"""What is known of a trained detector beside its weights: what it learned from, its curves, its pictures."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from annotator.detection.manifest import MANIFEST_NAME, read_manifest
from annotator.project import StoredModel
from annotator.types.errors import FormatError
from annotator.workflows.validation_pictures import validation_pictures

CURVES = "curves.csv"
# column of the trainer's table -> name here
MEASURED = {
    "train/box_loss": "box_loss",
    "train/cls_loss": "cls_loss",
    "train/dfl_loss": "dfl_loss",
    "metrics/precision(B)": "precision",
    "metrics/recall(B)": "recall",
    "metrics/mAP50(B)": "map50",
    "metrics/mAP50-95(B)": "map50_95",
}


@dataclass(frozen=True)
class Epoch:
    """What was measured after an epoch; not every epoch is measured on pictures."""

    epoch: int
    metrics: dict[str, float]


@dataclass(frozen=True)
class ModelFacts:
    """What is known of a model.

    Attributes:
        boxes: how many boxes it learned from; None where that is not known (any more).
        pictures: pictures with the boxes that it finds.
        curves: its training, epoch by epoch.
    """

    boxes: int | None
    pictures: tuple[Path, ...]
    curves: tuple[Epoch, ...]


def model_facts(model: StoredModel) -> ModelFacts:
    """What is known of a model; what is missing on the disk is left out."""
    folder = model.path.parent
    return ModelFacts(_boxes(model), tuple(validation_pictures(folder)), _curves(folder / CURVES))


def _boxes(model: StoredModel) -> int | None:
    if model.manifest is None or model.manifest.name != MANIFEST_NAME or not model.manifest.is_file():
        return None
    return _boxes_of(model.manifest.parent, model.manifest.stat().st_mtime_ns)


@lru_cache(maxsize=256)
def _boxes_of(folder: Path, changed_ns: int) -> int | None:
    """Of a manifest that is read once, as long as it does not change."""
    try:
        return sum(read_manifest(folder).boxes_by_class["train"].values())
    except FormatError:  # its number is not known any more; the model works all the same
        return None


def _curves(path: Path) -> tuple[Epoch, ...]:
    if not path.is_file():
        return ()
    with path.open(newline="", encoding="utf-8") as file:
        return tuple(_epoch(row) for row in csv.DictReader(file))


def _epoch(row: dict[str, str]) -> Epoch:
    values = {name: float(row[column]) for column, name in MEASURED.items() if row.get(column)}
    return Epoch(int(row["epoch"]), {name: value for name, value in values.items() if math.isfinite(value)})
