"""The report on a trained detector: number of training boxes, training curves, and its boxes on validation images."""

from __future__ import annotations

import csv
import logging
import math
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from annotator.detection.dataset import GENERATED, MANIFEST_NAME, DatasetManifest, read_manifest, read_picture
from annotator.detection.edge_errors import read_boxes
from annotator.files import DOCUMENT_BYTES, open_text_file
from annotator.formats.reading import read_model
from annotator.image_bytes import encoded_image
from annotator.project import StoredModel
from annotator.types import Box2D, Detector, Frame, OrientedBox
from annotator.types.errors import DetectionError, FormatError
from annotator.workflows.drawn_boxes import Canvas
from annotator.workflows.training.held_out import DECISION_NAME, Decision, Found

FOLDER = "validation"
PICTURES = 8
SHOWN_FROM = 0.25
# Smaller images are enlarged, so that lines and text do not cover the objects.
LONG_SIDE_PX = 448
WHITE = (255, 255, 255)
COLOURS = ((255, 200, 60), (80, 220, 120), (80, 140, 255), (255, 110, 200), (255, 120, 90))


def write_validation_pictures(dataset: Path, manifest: DatasetManifest, detector: Detector, model: Path) -> list[Path]:
    """Draws the given boxes, white, and a detector's on validation images, and writes these beside the model."""
    names = _chosen(manifest)
    pictures = [read_picture(dataset / name) for name in names]
    drawn = []
    for name, picture, boxes in zip(names, pictures, detector.detect(pictures), strict=True):
        height, width = picture.rgb.shape[:2]
        truths = read_boxes(dataset, dataset / name, manifest.classes, width, height)
        drawn.append(_drawn(picture.rgb, boxes, manifest.classes, truths))
    return _write(drawn, model)


def write_found_boxes(found: Sequence[Found], model: Path) -> None:
    """Draws the boxes that a view detector finds on held-out frames in place of the validation images.

    Reviewed boxes are white. Without such frames, the validation images stay.
    """
    if found:
        _write((_with_boxes(*each) for each in found[:PICTURES]), model)


def _write(drawn: Iterable[np.ndarray], model: Path) -> list[Path]:
    """Writes images beside a model, in place of those that are there."""
    folder = model / FOLDER
    temporary = Path(tempfile.mkdtemp(prefix=f".{FOLDER}.", dir=model))
    try:
        for number, rgb in enumerate(drawn):
            (temporary / f"{number}.jpg").write_bytes(encoded_image(rgb, "jpg"))
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
    rgb: UInt8[np.ndarray, "h w 3"], boxes: Sequence[Box2D], classes: Sequence[str], truths: Sequence[Box2D]
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Returns the image, enlarged, with true boxes in white, and boxes with their scores."""
    canvas = Canvas(rgb, max(LONG_SIDE_PX / max(rgb.shape[:2]), 1.0))
    for box in truths:
        canvas.box(box, WHITE)
    for box in boxes:
        if box.score >= SHOWN_FROM:
            colour = COLOURS[classes.index(box.label) % len(COLOURS) if box.label in classes else 0]
            canvas.box(box, colour, f"{box.label} {box.score:.2f}", thickness_px=2)
    return canvas.rgb


def _with_boxes(
    frame: Frame, boxes: Sequence[OrientedBox | None], truths: Sequence[OrientedBox]
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the image of a frame, enlarged, with true boxes in white and those that were found."""
    canvas = Canvas(frame.rgb, max(LONG_SIDE_PX / max(frame.rgb.shape[:2]), 1.0))
    for truth in truths:
        canvas.solid(frame.camera, truth, WHITE, thickness_px=1)
    for box in boxes:
        if box is not None:
            canvas.solid(frame.camera, box, COLOURS[0])
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
