"""The report on a trained detector: number of training boxes, training curves, validation images."""

from __future__ import annotations

import csv
import logging
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from annotator.detection.dataset import GENERATED, MANIFEST_NAME, read_manifest
from annotator.files import DOCUMENT_BYTES, open_text_file
from annotator.project import StoredModel
from annotator.types.errors import FormatError
from annotator.workflows.training.held_out import Decision, read_decision
from annotator.workflows.training.validation_pictures import validation_pictures

LOG = logging.getLogger(__name__)
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
    """The measurements of an epoch; precision, recall and mAP are not measured after every epoch."""

    epoch: int
    metrics: dict[str, float]


@dataclass(frozen=True)
class ModelFacts:
    """The report on a model.

    Attributes:
        boxes: number of boxes it was trained on; None if unknown.
        pictures: validation images with its detections.
        curves: measurements by epoch.
        decision: how held-out frames decided about it; None if they did not.
    """

    boxes: int | None
    pictures: tuple[Path, ...]
    curves: tuple[Epoch, ...]
    decision: Decision | None = None


def model_facts(model: StoredModel) -> ModelFacts:
    """Returns the report on a model; missing or damaged files are left out."""
    folder = model.path.parent
    return ModelFacts(_boxes(model), tuple(validation_pictures(folder)), _curves(folder / CURVES), decision_of(model))


def decision_of(model: StoredModel) -> Decision | None:
    """Returns how held-out frames decided about a model; a damaged file is left out."""
    try:
        return read_decision(model.path.parent)
    except FormatError as error:
        LOG.warning("%s", error)
        return None


def _boxes(model: StoredModel) -> int | None:
    if model.manifest is None or model.manifest.name != MANIFEST_NAME or not model.manifest.is_file():
        return None
    return _boxes_of(model.manifest.parent, model.manifest.stat().st_mtime_ns)


@lru_cache(maxsize=256)
def _boxes_of(folder: Path, changed_ns: int) -> int | None:
    """Counts the training boxes of a manifest, without those of generated frames; cached until the file changes."""
    try:
        entries = read_manifest(folder).entries
        return sum(len(entry.boxes) for entry in entries if entry.split == "train" and entry.origin != GENERATED)
    except FormatError:  # only the number is lost: the model works without its manifest
        return None


def _curves(path: Path) -> tuple[Epoch, ...]:
    if not path.is_file():
        return ()
    try:
        with open_text_file(path, DOCUMENT_BYTES, newline="") as file:
            return tuple(_epoch(row) for row in csv.DictReader(file))
    # a short row lacks values (TypeError), a damaged header lacks column names (KeyError)
    except (OSError, ValueError, TypeError, KeyError, csv.Error) as error:
        LOG.warning("%s: cannot be read, the curves are left out: %s", path, error)
        return ()


def _epoch(row: dict[str, str]) -> Epoch:
    values = {name: float(row[column]) for column, name in MEASURED.items() if row.get(column)}
    return Epoch(int(row["epoch"]), {name: value for name, value in values.items() if math.isfinite(value)})
