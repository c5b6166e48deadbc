"""The report on a trained detector: number of training boxes, training curves, and its boxes on validation images."""

from __future__ import annotations

import csv
import logging
import math
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from annotator.detection.dataset import GENERATED, MANIFEST_NAME, DatasetManifest, read_manifest, read_picture
from annotator.files import DOCUMENT_BYTES, open_text_file
from annotator.formats.reading import read_model
from annotator.image_bytes import encoded_image
from annotator.project import StoredModel
from annotator.types import Box2D, Detector
from annotator.types.errors import DetectionError, FormatError
from annotator.workflows.drawn_boxes import Canvas
from annotator.workflows.training.held_out import DECISION_NAME, Decision

FOLDER = "validation"
PICTURES = 8
SHOWN_FROM = 0.25
# Smaller images are enlarged, so that lines and text do not cover the objects.
LONG_SIDE_PX = 448
COLOURS = ((255, 200, 60), (80, 220, 120), (80, 140, 255), (255, 110, 200), (255, 120, 90))


def write_validation_pictures(dataset: Path, manifest: DatasetManifest, detector: Detector, model: Path) -> list[Path]:
    """Draws a detector's boxes on validation images, and writes these beside the model."""
    pictures = [read_picture(dataset / name) for name in _chosen(manifest)]
    detections = detector.detect(pictures)
    folder = model / FOLDER
    temporary = Path(tempfile.mkdtemp(prefix=f".{FOLDER}.", dir=model))
    try:
        for number, (picture, boxes) in enumerate(zip(pictures, detections, strict=True)):
            drawn = encoded_image(_drawn(picture.rgb, boxes, manifest.classes), "jpg")
            (temporary / f"{number}.jpg").write_bytes(drawn)
        shutil.rmtree(folder, ignore_errors=True)
        temporary.rename(folder)
    except OSError as error:
        raise DetectionError(f"{folder}: cannot be written ({error.strerror or error}); is the disk full?") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return validation_pictures(model)


def validation_pictures(model: Path) -> list[Path]:
    """Returns the validation images beside a model, in order; a model that was not trained here has none."""
    pictures = (path for path in (model / FOLDER).glob("*.jpg") if path.stem.isdecimal() and not path.is_symlink())
    return sorted(pictures, key=lambda path: int(path.stem))


def _chosen(manifest: DatasetManifest) -> list[str]:
    labelled = [entry.image for entry in manifest.entries if entry.split == manifest.measured_on and entry.boxes]
    if len(labelled) <= PICTURES:
        return labelled
    return [labelled[round(index)] for index in np.linspace(0, len(labelled) - 1, PICTURES)]


def _drawn(
    rgb: UInt8[np.ndarray, "h w 3"], boxes: Sequence[Box2D], classes: Sequence[str]
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Returns the image, enlarged, with boxes and scores."""
    canvas = Canvas(rgb, max(LONG_SIDE_PX / max(rgb.shape[:2]), 1.0))
    for box in boxes:
        if box.score >= SHOWN_FROM:
            colour = COLOURS[classes.index(box.label) % len(COLOURS) if box.label in classes else 0]
            canvas.box(box, colour, f"{box.label} {box.score:.2f}", thickness_px=2)
    return canvas.rgb


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
    path = model.path.parent / DECISION_NAME
    try:
        return read_model(path, Decision) if path.is_file() else None
    except FormatError as error:
        LOG.warning("%s", error)
        return None


def _boxes(model: StoredModel) -> int | None:
    """The number of training boxes, without those of generated frames."""
    if model.manifest is None or model.manifest.name != MANIFEST_NAME or not model.manifest.is_file():
        return None
    try:
        entries = read_manifest(model.manifest.parent).entries
        return sum(len(entry.boxes) for entry in entries if entry.split == "train" and entry.origin != GENERATED)
    except FormatError:  # only the number is lost: the model works without its manifest
        return None


def _curves(path: Path) -> tuple[Epoch, ...]:
    if not path.is_file():
        return ()
    try:
        with open_text_file(path, DOCUMENT_BYTES, newline="") as file:
            rows = list(csv.DictReader(file))
        values = [{name: float(row[column]) for column, name in MEASURED.items() if row.get(column)} for row in rows]
        return tuple(
            Epoch(int(row["epoch"]), {name: value for name, value in measured.items() if math.isfinite(value)})
            for row, measured in zip(rows, values, strict=True)
        )
    # a short row lacks values (TypeError), a damaged header lacks column names (KeyError)
    except (OSError, ValueError, TypeError, KeyError, csv.Error) as error:
        LOG.warning("%s: cannot be read, the curves are left out: %s", path, error)
        return ()
